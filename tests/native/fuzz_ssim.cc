// Compares images natively by SSIM, with drawn input, sensible and not.
#include "fuzz.h"
#include "ssim.h"

extern "C" XLA_FFI_Error* ssim(XLA_FFI_CallFrame*);

#if defined(__x86_64__)
namespace jaxcloseup {
extern const Comparer comparer_avx512{}, comparer_avx2{};
}  // namespace jaxcloseup
#endif

void fuzz_comparing() {
  using jaxcloseup::REACH;
  const int64_t height = any_of({11, 12, 17}), width = any_of({11, 13, 20, 138, 139, 150});
  const bool wanted = generator() % 3;
  const int rarity = any_of({0, 200, 20, 2});
  Floats image({height, width, 3}), target({height, width, 3}), share({height - REACH, width - REACH});
  Floats map({height - REACH, width - REACH}), gradient(wanted ? image.dims : Dims{0});
  Floats pulls(wanted ? Dims{3, height + REACH, width + REACH, 3} : Dims{0});
  for (Floats* array : {&image, &target, &share}) fill(*array, rarity, [](size_t) { return uniform(0, 1); });
  call_twice("ssim", ssim, [&] {
    Call call;
    call.arg(image).arg(target).arg(share);
    const std::vector<float> taps(jaxcloseup::TAPS, 1.f / jaxcloseup::TAPS), constants{1e-4f, 9e-4f};
    return std::move(call.attr("taps", taps).attr("constants", constants));
  }, map, gradient, pulls);
}
