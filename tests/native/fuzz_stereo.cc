// Matches patches natively with drawn input, sensible and not.
#include "fuzz.h"
#include "stereo.h"

extern "C" XLA_FFI_Error* stereo(XLA_FFI_CallFrame*);

#if defined(__x86_64__)
namespace jaxcloseup {
extern const Matcher matcher_avx512{}, matcher_avx2{};
}  // namespace jaxcloseup
#endif

void fuzz_matching() {
  const int64_t photographs = any_of({1, 2, 5}), neighbors = any_of({0, 1, 3, 9}), planes = any_of({0, 1, 4});
  const int64_t height = any_of({1, 2, 9}), width = any_of({1, 3, 16, 37});
  const int rarity = any_of({0, 200, 20, 2});
  Array<uint32_t> quads({photographs, height, width});
  Floats weight({photographs, height, width}), transforms({neighbors, 3, 4}), plane({planes, 3, height, width});
  Floats cost({planes, height, width});
  Integers reference({}), neighbor({neighbors});
  for (size_t i = 0; i < quads.size; i++) quads.data[i] = generator();
  fill(weight, rarity, [](size_t) { return any_of({0.f, 1.f, 1.f}); });
  fill(transforms, rarity, [](size_t i) { return i % 12 % 5 == 0 ? 1.f : uniform(-.2f, .2f); });
  fill(plane, rarity, [](size_t) { return uniform(-1, 1); });
  for (size_t i = 0; i < neighbor.size; i++)
    neighbor.data[i] = rarity && generator() % 4 == 0 ? any_of({-1, 2147483647, -2147483647 - 1}) : generator() % photographs;
  reference.data[0] = generator() % photographs;
  const std::vector<int64_t> patch = any_of<std::vector<int64_t>>({{4, 2, 3}, {0, 1, 1}, {6, 1, 32}, {12, 2, 2}});
  const float noise = any_of({0.f, 2.f});
  const auto make = [&] {
    Call call;
    call.arg(quads).arg(weight).arg(reference).arg(neighbor).arg(transforms).arg(plane);
    return std::move(call.attr("patch", patch).attr("scales", std::vector<float>{.05f, .03f, noise}));
  };
  call_twice("stereo", stereo, make, cost);
}
