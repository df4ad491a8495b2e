// Calls native gathering with drawn input, sensible and not.
#include "fuzz.h"
#include "gather.h"

extern "C" XLA_FFI_Error* gather(XLA_FFI_CallFrame*);

#if defined(__x86_64__)
namespace jaxcloseup {
extern const Gatherer gatherer_avx512{}, gatherer_avx2{};
}  // namespace jaxcloseup
#endif

namespace {

// Poses near the origin that look along z.
float draw_pose(size_t i) { return i % 12 % 5 == 0 ? 1.f : uniform(-.2f, .2f); }

template <typename T>
void fuzz_values() {
  const int64_t photographs = any_of({1, 2, 3, 9}), parts = any_of({1, 2, 3, 4});
  const int64_t channels = parts * any_of({1, 2, 3, 5, 8, 20});
  const int64_t height = any_of({1, 2, 7, 20}), width = any_of({1, 3, 8, 33});
  const int rarity = any_of({0, 200, 20, 2}), levels = any_of({1, 2, 4, 16});
  const bool sane_cameras = generator() % 4;
  Integers sizes({photographs, levels, 2});
  int64_t pixels = 0;
  for (int i = 0; i < photographs * levels; i++) {
    // Every other photograph is turned.
    const int64_t turned = i / levels % 2, level = i % levels, size[2] = {height, width};
    for (int axis = 0; axis < 2; axis++)
      sizes.data[2 * i + axis] = std::max<int64_t>(2 * size[axis ^ turned] >> level, 1);
    pixels += int64_t(sizes.data[2 * i]) * sizes.data[2 * i + 1];
  }
  std::vector<float> settings;
  for (int k = 0; k < parts; k++) {
    const float some[] = {any_of({.08f, .02f, 1.f}), any_of({.05f, .5f}), any_of({.3f, .3f, 0.f}), any_of({0.f, 1.f})};
    for (float value : some) settings.push_back(rarity == 2 && generator() % 8 == 0 ? nonsense() : value);
  }
  const Dims image = any_of<Dims>({{}, {0}, {1}, {70}, {1, 1}, {3, 50}, {17, 9}, {0, 4}, {4, 0}, {2, 5, 40}});
  Floats pose({3, 4}), intrinsics({4}), view(with(image, {2})), depth(image), poses({photographs, 3, 4});
  Floats of_maps({photographs, 4}), maps({photographs, height + 2, width + 2, 2});
  Floats of_levels({photographs, levels, 4});
  Array<T> values({pixels, channels});
  Integers finest({}), exclude({});
  const int odd_cameras = sane_cameras ? 0 : rarity;
  const auto draw_intrinsics = [&](size_t i) {
    const float scale = std::exp2(-float(i / 4 % levels)) * (i % 2 ? height : width);
    return i % 4 < 2 ? scale : scale / 2;
  };
  fill(pose, odd_cameras, draw_pose);
  fill(poses, odd_cameras, draw_pose);
  fill(intrinsics, odd_cameras, [](size_t i) { return i < 2 ? 30.f : 15.f; });
  fill(of_maps, odd_cameras, [&](size_t i) { return draw_intrinsics(i % 4); });
  fill(of_levels, odd_cameras, [&](size_t i) { return 2 * draw_intrinsics(i % (4 * levels)); });
  fill(view, rarity, [](size_t) { return uniform(0, 30); });
  fill(depth, rarity, [](size_t) { return uniform(1.8f, 2.2f); });
  fill(maps, rarity, [](size_t i) { return i % 2 ? uniform(0, 1) : .5f; });
  for (size_t i = 0; i < values.size; i++)
    values.data[i] = sizeof(T) > 1 && rarity && generator() % rarity == 0 ? T(1e38) : T(generator() % 100);
  finest.data[0] = any_of({0, 0, 0, 1, levels, -3, 2147483647});
  exclude.data[0] = any_of({-1, -1, 0, 1, 2147483647, -2147483647 - 1});
  std::vector<std::unique_ptr<Floats>> results[2];
  for (int some = 0; some < 2; some++) {
    Call call;
    call.arg(pose).arg(intrinsics).arg(view).arg(depth).arg(poses).arg(of_maps).arg(maps).arg(values);
    call.arg(of_levels).arg(sizes).arg(finest).arg(exclude).attr("settings", settings);
    for (int i = 0; i < 7 * parts; i++) {
      results[some].emplace_back(new Floats(i % 7 ? image : with(image, {channels / parts})));
      call.ret(*results[some].back());
    }
    const std::string error = call.run(gather, some ? 4 : 1);
    if (!error.empty()) fail("gather", error);
  }
  for (int i = 0; i < 7 * parts; i++)
    if (std::memcmp(results[0][i]->data.get(), results[1][i]->data.get(), results[0][i]->size * sizeof(float)))
      fail("gather", "threads change results");
}

}  // namespace

void fuzz_gathering() {
  fuzz_values<int8_t>();
  fuzz_values<uint8_t>();
  fuzz_values<float>();
}
