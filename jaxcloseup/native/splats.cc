// The native compositor as functions that XLA calls.
#include <algorithm>
#include <cstring>
#include <memory>
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
  Image first;

  int64_t pixels() const { return int64_t(first.width) * first.height; }
  int channels() const { return first.features() + MOMENTS; }
  Image at(int64_t number) const {
    Image image = first;
    image.table += number * image.count * image.columns;
    image.box += number * image.count * 4;
    image.order += number * image.count;
    return image;
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
  if (std::max(height, width) > int64_t(MOST_TILES) * TILE || count > INT32_MAX / 4)
    return ffi::Error::InvalidArgument("an image is too large, or has too many splats");
  batch.first = {static_cast<int>(width), static_cast<int>(height), near, static_cast<int>(count),
                 static_cast<int>(columns), table.typed_data(), box.typed_data(), order.typed_data()};
  return ffi::Error::Success();
}

ffi::Error forward(ffi::ThreadPool pool, Floats table, Floats box, Floats order, int64_t height, int64_t width,
                   float near, Result<Floats> sums, Result<Floats> median, Result<Floats> transmittance,
                   Result<Integers> stop, Result<Floats> reference) {
  Batch batch;
  if (auto error = read_batch(table, box, order, height, width, near, batch); error.failure()) return error;
  const int64_t pixels = batch.pixels();
  const Passes& passes = best_passes();
  for (int64_t number = 0; number < batch.images && pixels > 0; number++) {
    const Image image = batch.at(number);
    const Listing listing(pool, passes, image);
    const Planes out = {sums->typed_data() + number * batch.channels() * pixels,
                        median->typed_data() + number * pixels, transmittance->typed_data() + number * pixels,
                        stop->typed_data() + number * pixels, reference->typed_data() + number * pixels};
    parallel_for_with<BandLists>(pool, listing.bands, [&](BandLists& lists, int band) {
      lists.make(image, listing, band);
      passes.forward(lists.band, out);
    });
  }
  return ffi::Error::Success();
}

// Cotangents of a row of the table from sums over all pixels, see `splat_math.row_bar`.
void row_bar(const float* row, const float* sums, int features, float* bar) {
  const float *low = sums + offside_sums(features), clip = low[3], *h = row + HOMOGRAPHY;
  for (int axis = 0; axis < 2; axis++) {
    float moved = row[LOW_PASS] * low[1 + axis];
    for (int i = 0; i < 3; i++) moved -= sums[3 * i] * h[3 * i + 1 + axis];
    bar[ANCHOR + axis] = moved;
  }
  std::memcpy(bar + HOMOGRAPHY, sums, 9 * sizeof(float));
  // A clipped depth moves with the anchor's depth.
  if (clip != 0) bar[HOMOGRAPHY + 6] += clip / (h[6] * h[6]);
  bar[OPACITY] = row[OPACITY] != 0 ? sums[SCALED] / row[OPACITY] : 0;
  for (int i = LOW_PASS; i < PAYLOAD; i++) bar[i] = 0;
  std::memcpy(bar + PAYLOAD, sums + PAYLOAD_SUMS, features * sizeof(float));
}

// Sums over the pixels of one band, for each of its splats.
using BandSums = std::unique_ptr<float[]>;

ffi::Error backward(ffi::ThreadPool pool, Floats table, Floats box, Floats order, Floats transmittance, Integers stop,
                    Floats reference, Floats sums_bar, Floats median_bar, int64_t height, int64_t width, float near,
                    Result<Floats> table_bar) {
  Batch batch;
  if (auto error = read_batch(table, box, order, height, width, near, batch); error.failure()) return error;
  const int64_t pixels = batch.pixels();
  const Passes& passes = best_passes();
  std::memset(table_bar->typed_data(), 0, table_bar->size_bytes());
  for (int64_t number = 0; number < batch.images && pixels > 0; number++) {
    const Image image = batch.at(number);
    const Listing listing(pool, passes, image);
    const Cotangents in = {sums_bar.typed_data() + number * batch.channels() * pixels,
                           median_bar.typed_data() + number * pixels, transmittance.typed_data() + number * pixels,
                           stop.typed_data() + number * pixels, reference.typed_data() + number * pixels};
    const int features = image.features(), stride = sums_stride(features);
    std::vector<BandSums> sums(listing.bands);
    std::vector<int32_t> places(listing.ranges.size());  // of each splat in its bands, one by one
    parallel_for_with<BandLists>(pool, listing.bands, [&](BandLists& lists, int band) {
      lists.make(image, listing, band);
      const size_t size = lists.members.size() * stride;
      sums[band].reset(new float[size]);
      std::memset(sums[band].get(), 0, size * sizeof(float));
      passes.backward(lists.band, in, sums[band].get());
      for (size_t k = 0; k < lists.members.size(); k++) {
        const int splat = lists.members[k];
        places[listing.starts[splat] + band - listing.of_bands[splat].first] = static_cast<int32_t>(k);
      }
    });
    // One order of sums: along a tile's list, then over tiles, then over bands.
    float* bars = table_bar->typed_data() + int64_t(number) * image.count * image.columns;
    const int shown = static_cast<int>(listing.splats.size()), each = 1024;
    parallel_for_with<std::vector<float>>(pool, (shown + each - 1) / each, [&](std::vector<float>& total, int part) {
      for (int i = part * each; i < std::min(shown, (part + 1) * each); i++) {
        total.assign(stride, 0.f);
        const Range bands = listing.of_bands[i];
        for (int band = bands.first; band <= bands.last; band++) {
          const float* own = sums[band].get() + static_cast<size_t>(places[listing.starts[i] + band - bands.first]) * stride;
          for (int f = 0; f < stride; f++) total[f] += own[f];
        }
        const size_t place = static_cast<size_t>(listing.splats[i]) * image.columns;
        row_bar(image.table + place, total.data(), features, bars + place);
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
  const int64_t tiles = int64_t(batch.first.tile_rows()) * batch.first.tile_columns();
  for (int64_t number = 0; number < batch.images && tiles > 0; number++) {
    const Image image = batch.at(number);
    const Listing listing(pool, best_passes(), image);
    int32_t* out = counts->typed_data() + number * tiles;
    parallel_for_with<BandLists>(pool, listing.bands, [&](BandLists& lists, int band) {
      lists.make(image, listing, band);
      const int first = lists.band.first_row * lists.band.columns, own = lists.band.rows * lists.band.columns;
      for (int tile = 0; tile < own; tile++) out[first + tile] = lists.starts[tile + 1] - lists.starts[tile];
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
