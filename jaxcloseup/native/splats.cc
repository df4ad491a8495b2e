// The native compositor as functions that XLA calls.
#include <algorithm>
#include <cstring>
#include <vector>

#include "splat_blend.h"
#include "splat_lists.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;
template <typename Buffer>
using Result = ffi::Result<Buffer>;

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
  for (int64_t i = 0; i < batch.images && pixels > 0; i++) {
    blend(pool, batch.at(i), {sums->typed_data() + i * batch.channels() * pixels, median->typed_data() + i * pixels,
                              transmittance->typed_data() + i * pixels, stop->typed_data() + i * pixels,
                              reference->typed_data() + i * pixels});
  }
  return ffi::Error::Success();
}

ffi::Error backward(ffi::ThreadPool pool, Floats table, Floats box, Floats order, Floats transmittance, Integers stop,
                    Floats reference, Floats sums_bar, Floats median_bar, int64_t height, int64_t width, float near,
                    Result<Floats> table_bar) {
  Batch batch;
  if (auto error = read_batch(table, box, order, height, width, near, batch); error.failure()) return error;
  const int64_t pixels = batch.pixels();
  std::memset(table_bar->typed_data(), 0, table_bar->size_bytes());
  for (int64_t i = 0; i < batch.images && pixels > 0; i++) {
    const Cotangents in = {sums_bar.typed_data() + i * batch.channels() * pixels, median_bar.typed_data() + i * pixels,
                           transmittance.typed_data() + i * pixels, stop.typed_data() + i * pixels,
                           reference.typed_data() + i * pixels};
    const Image image = batch.at(i);
    const Listing listing(pool, best_passes(), image);
    pull_back(pool, image, listing, in, table_bar->typed_data() + i * image.count * image.columns);
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
      for (int tile = 0; tile < own; tile++) out[first + tile] = static_cast<int32_t>(lists.starts[tile + 1] - lists.starts[tile]);
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
