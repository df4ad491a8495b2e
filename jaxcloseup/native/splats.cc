// The native compositor as functions that XLA calls.
#include <algorithm>
#include <cstring>
#include <vector>

#include "parallel.h"
#include "splat_layout.h"
#include "splat_lists.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;
template <typename Buffer>
using Result = ffi::Result<Buffer>;

const Passes& best_passes() {
#if defined(__x86_64__)
  static const bool avx512 = __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
                             __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw");
  static const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (avx512) return passes_avx512;
  if (avx2) return passes_avx2;
#endif
  return passes_baseline;
}

// The images of a batch, `[..., N, C]` and so on.
struct Batch {
  int64_t images = 1;
  Scene scene;

  Scene at(int64_t image) const {
    Scene one = scene;
    one.table += image * scene.count * scene.columns;
    one.box += image * scene.count * 4;
    one.order += image * scene.count;
    return one;
  }
};

ffi::Error read_batch(Floats& table, Floats& box, Floats& order, int64_t height, int64_t width, float near, Batch& batch) {
  const auto dims = table.dimensions();
  if (dims.size() < 2) return ffi::Error::InvalidArgument("a table must be [..., N, C]");
  const int64_t count = dims[dims.size() - 2], columns = dims.back();
  for (size_t i = 0; i + 2 < dims.size(); i++) batch.images *= dims[i];
  const int64_t features = columns - PAYLOAD;
  if (features < 0 || features > MOST_FEATURES) return ffi::Error::InvalidArgument("a payload has 0 to 54 values");
  if (box.element_count() != size_t(batch.images * count * 4) || order.element_count() != size_t(batch.images * count))
    return ffi::Error::InvalidArgument("boxes must be [..., N, 4] and orders [..., N]");
  if (height < 0 || width < 0 || height * width > INT32_MAX || count > INT32_MAX / 4)
    return ffi::Error::InvalidArgument("an image or its splats are too many");
  batch.scene = {static_cast<int>(width), static_cast<int>(height), near, static_cast<int>(count),
                 static_cast<int>(columns), table.typed_data(), box.typed_data(), order.typed_data()};
  return ffi::Error::Success();
}

ffi::Error forward(ffi::ThreadPool pool, Floats table, Floats box, Floats order, int64_t height, int64_t width,
                   float near, Result<Floats> sums, Result<Floats> median, Result<Floats> transmittance,
                   Result<Integers> stop, Result<Floats> reference) {
  Batch batch;
  if (auto error = read_batch(table, box, order, height, width, near, batch); error.failure()) return error;
  const int64_t pixels = height * width, channels = batch.scene.columns - PAYLOAD + MOMENTS;
  const Passes& passes = best_passes();
  for (int64_t image = 0; image < batch.images && pixels > 0; image++) {
    const Scene scene = batch.at(image);
    const Bands bands(scene);
    const Planes out = {sums->typed_data() + image * channels * pixels, median->typed_data() + image * pixels,
                        transmittance->typed_data() + image * pixels, stop->typed_data() + image * pixels,
                        reference->typed_data() + image * pixels};
    parallel_for(pool, bands.count, [&](int number) {
      const BandLists lists(scene, bands, number);
      passes.forward(lists.band, out);
    });
  }
  return ffi::Error::Success();
}

// Cotangents of a row of the table from sums over all pixels, see `splat_math.row_bar`.
void row_bar(const float* row, const double* sums, int features, float* bar) {
  const double *low = sums + offside_sums(features), clip = low[3];
  const float* h = row + HOMOGRAPHY;
  for (int axis = 0; axis < 2; axis++) {
    double moved = row[LOW_PASS] * low[1 + axis];
    for (int i = 0; i < 3; i++) moved -= sums[3 * i] * h[3 * i + 1 + axis];
    bar[ANCHOR + axis] = static_cast<float>(moved);
  }
  for (int i = 0; i < 9; i++) bar[HOMOGRAPHY + i] = static_cast<float>(sums[i]);
  // A clipped depth moves with the anchor's depth.
  if (clip != 0) bar[HOMOGRAPHY + 6] = static_cast<float>(sums[6] + clip / (double(h[6]) * h[6]));
  bar[OPACITY] = row[OPACITY] != 0 ? static_cast<float>(sums[SCALED] / row[OPACITY]) : 0;
  for (int f = 0; f < features; f++) bar[PAYLOAD + f] = static_cast<float>(sums[PAYLOAD_SUMS + f]);
}

ffi::Error backward(ffi::ThreadPool pool, Floats table, Floats box, Floats order, Floats transmittance, Integers stop,
                    Floats reference, Floats sums_bar, Floats median_bar, int64_t height, int64_t width, float near,
                    Result<Floats> table_bar) {
  Batch batch;
  if (auto error = read_batch(table, box, order, height, width, near, batch); error.failure()) return error;
  const int features = batch.scene.columns - PAYLOAD, stride = sums_stride(features);
  const int64_t pixels = height * width, channels = features + MOMENTS;
  const Passes& passes = best_passes();
  std::memset(table_bar->typed_data(), 0, table_bar->size_bytes());
  for (int64_t image = 0; image < batch.images && pixels > 0; image++) {
    const Scene scene = batch.at(image);
    const Bands bands(scene);
    const Cotangents in = {sums_bar.typed_data() + image * channels * pixels, median_bar.typed_data() + image * pixels,
                           transmittance.typed_data() + image * pixels, stop.typed_data() + image * pixels,
                           reference.typed_data() + image * pixels};
    std::vector<float> sums(bands.members.size() * stride);
    parallel_for(pool, bands.count, [&](int number) {
      const BandLists lists(scene, bands, number);
      passes.backward(lists.band, in, sums.data() + static_cast<size_t>(bands.starts[number]) * stride);
    });
    // One order of sums: along a tile's list, then over tiles, then over bands.
    float* bars = table_bar->typed_data() + image * scene.count * scene.columns;
    const int shown = static_cast<int>(bands.splats.size()), each = 1024;
    parallel_for(pool, (shown + each - 1) / each, [&](int part) {
      std::vector<double> total(stride);
      for (int i = part * each; i < std::min(shown, (part + 1) * each); i++) {
        std::fill(total.begin(), total.end(), 0.);
        for (int slot = bands.slots[i]; slot < bands.slots[i + 1]; slot++) {
          const float* own = sums.data() + static_cast<size_t>(bands.entries[slot]) * stride;
          for (int f = 0; f < stride; f++) total[f] += own[f];
        }
        const size_t place = static_cast<size_t>(bands.splats[i]) * scene.columns;
        row_bar(scene.table + place, total.data(), features, bars + place);
      }
    });
  }
  return ffi::Error::Success();
}

// Lengths of the lists of all tiles, `[rows, columns]`.
ffi::Error count_splats(ffi::ThreadPool pool, Floats table, Floats box, Floats order, int64_t height, int64_t width,
                        float near, Result<Integers> counts) {
  Batch batch;
  if (auto error = read_batch(table, box, order, height, width, near, batch); error.failure()) return error;
  const int64_t tiles = int64_t(batch.scene.tile_rows()) * batch.scene.tile_columns();
  for (int64_t image = 0; image < batch.images && tiles > 0; image++) {
    const Scene scene = batch.at(image);
    const Bands bands(scene);
    int32_t* out = counts->typed_data() + image * tiles;
    parallel_for(pool, bands.count, [&](int number) {
      const BandLists lists(scene, bands, number);
      const int own = lists.band.rows * lists.band.columns;
      for (int tile = 0; tile < own; tile++)
        out[lists.band.first_row * lists.band.columns + tile] = lists.starts[tile + 1] - lists.starts[tile];
    });
  }
  return ffi::Error::Success();
}

}  // namespace
}  // namespace jaxcloseup

#define INPUTS                                                                       \
  xla::ffi::Ffi::Bind()                                                              \
      .Ctx<xla::ffi::ThreadPool>()                                                   \
      .Arg<jaxcloseup::Floats>()                                                     \
      .Arg<jaxcloseup::Floats>()                                                     \
      .Arg<jaxcloseup::Floats>()
#define SIZE .Attr<int64_t>("height").Attr<int64_t>("width").Attr<float>("near")

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(splats_forward, jaxcloseup::forward,
                              INPUTS SIZE.Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Integers>()
                                  .Ret<jaxcloseup::Floats>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(splats_backward, jaxcloseup::backward,
                              INPUTS.Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>() SIZE.Ret<jaxcloseup::Floats>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(splats_count, jaxcloseup::count_splats, INPUTS SIZE.Ret<jaxcloseup::Integers>());

#pragma GCC visibility pop
