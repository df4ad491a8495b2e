// Calls the native library's functions with drawn input, sensible and not: built with sanitizers,
// it ends at the first access out of bounds and at the first undefined operation.
//
// Usage: fuzz_splats CASES
#include <cmath>

#include "fuzz.h"
#include "splat_blend.h"
#include "splat_surfels.h"

extern "C" {
XLA_FFI_Error* splats_forward(XLA_FFI_CallFrame*);
XLA_FFI_Error* splats_backward(XLA_FFI_CallFrame*);
XLA_FFI_Error* splats_count(XLA_FFI_CallFrame*);
XLA_FFI_Error* surfels_forward(XLA_FFI_CallFrame*);
XLA_FFI_Error* surfels_backward(XLA_FFI_CallFrame*);
}

#if defined(__x86_64__)
namespace jaxcloseup {
// Only the baseline is here, compiled for the instructions that are tested.
extern const Passes passes_avx512{}, passes_avx2{};
extern const Projection projection_avx512{}, projection_avx2{};
}  // namespace jaxcloseup
#endif

namespace {

// What both kinds of functions return of an image, and the cotangents of it.
struct Outputs {
  Floats sums, median, transmittance, reference, sums_bar, median_bar;
  Integers stop;

  Outputs(const Dims& batch, int64_t channels, int64_t height, int64_t width)
      : sums(with(batch, {channels, height, width})), median(with(batch, {height, width})), transmittance(median.dims),
        reference(median.dims), sums_bar(sums.dims), median_bar(median.dims), stop(median.dims) {}

  template <typename Make>
  void forward(const char* name, XLA_FFI_Handler* handler, const Make& make) {
    call_twice(name, handler, make, sums, median, transmittance, stop, reference);
  }

  // Also with a trace that no forward pass leaves.
  void draw_cotangents(int rarity, bool bad_trace) {
    const auto normal = [](size_t) { return uniform(-1, 1); };
    fill(sums_bar, rarity, normal);
    fill(median_bar, rarity, normal);
    if (!bad_trace) return;
    fill(transmittance, 2, normal);
    fill(reference, 2, normal);
    for (size_t i = 0; i < stop.size; i++) stop.data[i] = any_of({-2147483647 - 1, -1, 0, 1, 5, 1000000, 2147483647});
  }

  Call& add_trace(Call& call) {
    return call.arg(transmittance).arg(stop).arg(reference).arg(sums_bar).arg(median_bar);
  }
};

struct Size {
  Dims batch;
  int64_t height, width, count;
  int rarity;  // of nonsense; 0 has none
  float near;

  static Size draw() {
    Size size;
    size.batch = any_of<Dims>({{}, {}, {2}, {1, 3}, {0}});
    size.height = any_of({0, 1, 2, 3, 4, 5, 9, 17, 64, 130});
    size.width = any_of({0, 1, 2, 3, 4, 5, 8, 13, 31, 70});
    size.count = any_of({0, 1, 2, 5, 17, 60, 200});
    size.rarity = any_of({0, 200, 20, 2});
    size.near = any_of({.01f, .2f, .2f, 0.f, 1e30f, std::nanf("")});
    return size;
  }

  Call& add_to(Call& call) const { return call.attr("height", height).attr("width", width).attr("near", near); }
};

void fuzz_tables(const Size& size) {
  using namespace jaxcloseup;
  const int features = any_of({0, 1, 3, 6, 17, 54});
  const int columns = PAYLOAD + features;
  Floats table(with(size.batch, {size.count, columns})), box(with(size.batch, {size.count, 4}));
  Floats order(with(size.batch, {size.count}));
  const int kind = generator() % 4;  // of homographies: discs, tiny, wild, all at one place
  fill(table, size.rarity, [&](size_t i) {
    const int column = i % columns;
    if (column < HOMOGRAPHY) return kind == 3 ? 3.5f : uniform(-20, 90);
    if (column < OPACITY) {
      if (kind == 2) return uniform(-1, 1) * std::exp(uniform(-20, 20));
      if (column == HOMOGRAPHY + 6) return uniform(.1f, 2);
      if (column >= HOMOGRAPHY + 6) return uniform(-.01f, .01f);
      return column % 3 == HOMOGRAPHY % 3 ? 0 : uniform(-1, 1) * (kind == 1 ? 1e4f : .5f);
    }
    if (column == OPACITY) return uniform(-.1f, 1);
    if (column == LOW_PASS) return any_of({2.f, 1e9f});
    return uniform(-1, 1) + (column < PAYLOAD ? 1 : 0);
  });
  fill(box, size.rarity, [&](size_t i) { return i % 4 < 2 ? uniform(-30, 60) : uniform(20, 120); });
  fill(order, size.rarity, [&](size_t) { return kind == 3 ? 1 : uniform(0, 5); });
  const auto inputs = [&] {
    Call call;
    call.arg(table).arg(box).arg(order);
    return size.add_to(call);
  };
  Integers counts(with(size.batch, {(size.height + TILE - 1) / TILE, (size.width + TILE - 1) / TILE}));
  call_twice("splats_count", splats_count, inputs, counts);
  Outputs out(size.batch, features + MOMENTS, size.height, size.width);
  out.forward("splats_forward", splats_forward, inputs);
  Floats table_bar(table.dims);
  for (bool bad_trace : {false, true}) {
    out.draw_cotangents(size.rarity, bad_trace);
    call_twice("splats_backward", splats_backward, [&] {
      Call call = inputs();
      return out.add_trace(call);
    }, table_bar);
  }
}

void fuzz_surfels(const Size& size) {
  using namespace jaxcloseup;
  const int harmonics = any_of({1, 4, 9, 16});
  const auto& n = size.count;
  Floats means(with(size.batch, {n, 3})), scales(with(size.batch, {n, 2})), quaternions(with(size.batch, {n, 4}));
  Floats opacity(with(size.batch, {n})), sh(with(size.batch, {n, harmonics, 3}));
  Floats camtoworld(with(size.batch, {3, 4})), intrinsics(with(size.batch, {4}));
  const bool together = generator() % 4 == 0, sane_camera = generator() % 4;
  const float small = uniform(-6, 0);
  fill(means, size.rarity, [&](size_t i) { return together ? 1.5f : i % 3 < 2 ? uniform(-2, 2) : uniform(-.5f, 3); });
  fill(scales, size.rarity, [&](size_t) { return uniform(small - 2, small); });
  fill(quaternions, size.rarity, [&](size_t) { return uniform(-1, 1); });
  fill(opacity, size.rarity, [&](size_t) { return uniform(0, 1); });
  fill(sh, size.rarity, [&](size_t) { return uniform(-1, 1); });
  fill(camtoworld, sane_camera ? 0 : size.rarity, [&](size_t i) { return i % 12 % 5 == 0 ? 1.f : uniform(-.1f, .1f); });
  fill(intrinsics, sane_camera ? 0 : size.rarity, [&](size_t i) {
    return (i % 4 < 2 ? 1.f : .5f) * (i % 2 ? size.height : size.width) + uniform(0, 1);
  });
  const bool antialias = generator() % 2, of_camera = generator() % 2;
  const auto inputs = [&] {
    Call call;
    call.arg(means).arg(scales).arg(quaternions).arg(opacity).arg(sh).arg(camtoworld).arg(intrinsics);
    return size.add_to(call).attr("antialias", antialias);
  };
  Outputs out(size.batch, FEATURES + MOMENTS, size.height, size.width);
  out.forward("surfels_forward", surfels_forward, inputs);
  Floats means_bar(means.dims), scales_bar(scales.dims), quaternions_bar(quaternions.dims), opacity_bar(opacity.dims);
  Floats sh_bar(sh.dims), camera_bar(with(size.batch, {16}));
  for (bool bad_trace : {false, true}) {
    out.draw_cotangents(size.rarity, bad_trace);
    call_twice("surfels_backward", surfels_backward, [&] {
      Call call = inputs();
      return out.add_trace(call).attr("of_camera", of_camera);
    }, means_bar, scales_bar, quaternions_bar, opacity_bar, sh_bar, camera_bar);
  }
}

// Images as wide and as high as they may be, and arguments that are refused.
void check_limits() {
  using namespace jaxcloseup;
  const int64_t most = int64_t(MOST_TILES) * TILE;
  for (bool wide : {true, false}) {
    Size size{{}, wide ? 1 : most, wide ? most : 1, 3, 2, .2f};
    fuzz_tables(size);
  }
  const auto refuses = [](int64_t columns, int64_t boxes, int64_t width) {
    Floats table({2, columns}), box({boxes, 4}), order({2});
    Integers counts({1, 1});
    Call call;
    call.arg(table).arg(box).arg(order).ret(counts);
    call.attr("height", int64_t(1)).attr("width", width).attr("near", .2f);
    if (call.run(splats_count, 1).empty()) fail("splats_count", "takes what does not fit");
  };
  refuses(PAYLOAD - 1, 2, 4);
  refuses(PAYLOAD + MOST_FEATURES + 1, 2, 4);
  refuses(PAYLOAD, 3, 4);
  refuses(PAYLOAD, 2, most + 1);
}

}  // namespace

int main(int, char** arguments) {
  const int cases = std::atoi(arguments[1]);
  for (int number = 0; number < cases; number++) {
    generator.seed(number);
    const Size size = Size::draw();
    number % 2 ? fuzz_surfels(size) : fuzz_tables(size);
    fuzz_gathering();
    fuzz_matching();
    fuzz_hash_grid();
    fuzz_comparing();
  }
  check_limits();
  std::printf("%d cases\n", cases);
}
