// Surfels rendered natively, from parameters to images, as functions that XLA calls.
#include <cstring>
#include <memory>

#include "processor.h"
#include "splat_blend.h"
#include "splat_surfels.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;
template <typename Buffer>
using Result = ffi::Result<Buffer>;

constexpr int PIECE = 1024;  // surfels that a thread projects at once
constexpr int CHANNELS = FEATURES + MOMENTS;

// Surfels and cameras `[..., N, 3]` and so on, as all functions take them.
struct Inputs {
  Floats means, log_scales, quaternions, opacity, sh, camtoworld, intrinsics;
  View view;
  int64_t images = 1;

  Inputs(Floats means, Floats log_scales, Floats quaternions, Floats opacity, Floats sh, Floats camtoworld,
         Floats intrinsics, int64_t height, int64_t width, float near, bool antialias)
      : means(means), log_scales(log_scales), quaternions(quaternions), opacity(opacity), sh(sh),
        camtoworld(camtoworld), intrinsics(intrinsics),
        view{static_cast<int>(width), static_cast<int>(height), near, antialias, nullptr, nullptr} {
    const auto dims = means.dimensions();
    for (size_t i = 0; i + 2 < dims.size(); i++) images *= dims[i];
  }

  int64_t count() const { return means.dimensions()[means.dimensions().size() - 2]; }
  int64_t harmonics() const { return sh.dimensions()[sh.dimensions().size() - 2]; }
  int64_t pixels() const { return int64_t(view.width) * view.height; }

  ffi::Error check() const {
    const int64_t n = images * count();
    const bool fit = means.element_count() == size_t(3 * n) && log_scales.element_count() == size_t(2 * n) &&
                     quaternions.element_count() == size_t(4 * n) && opacity.element_count() == size_t(n) &&
                     sh.element_count() == size_t(3 * n * harmonics()) && harmonics() <= MOST_HARMONICS &&
                     camtoworld.element_count() == size_t(12 * images) && intrinsics.element_count() == size_t(4 * images);
    if (!fit) return ffi::Error::InvalidArgument("arrays of surfels and cameras do not fit one another");
    if (std::max(view.width, view.height) > MOST_TILES * TILE || count() > INT32_MAX / 64)
      return ffi::Error::InvalidArgument("an image is too large, or has too many surfels");
    return ffi::Error::Success();
  }

  Surfels surfels(int64_t image) {
    const int64_t first = image * count();
    return {static_cast<int>(count()), static_cast<int>(harmonics()), means.typed_data() + 3 * first,
            log_scales.typed_data() + 2 * first, quaternions.typed_data() + 4 * first, opacity.typed_data() + first,
            sh.typed_data() + 3 * harmonics() * first};
  }

  View view_of(int64_t image) {
    View own = view;
    own.camtoworld = camtoworld.typed_data() + 12 * image;
    own.intrinsics = intrinsics.typed_data() + 4 * image;
    return own;
  }
};

// The table of an image's surfels. Its memory is left as it is, for most may not show.
struct Table {
  std::unique_ptr<float[]> table, box, order;
  Image image;

  Table(ffi::ThreadPool& pool, const Surfels& surfels, const View& view)
      : table(new float[size_t(surfels.count) * COLUMNS]), box(new float[size_t(surfels.count) * 4]),
        order(new float[surfels.count]),
        image{view.width, view.height, view.near, surfels.count, COLUMNS, table.get(), box.get(), order.get()} {
    const Projected out = {table.get(), box.get(), order.get()};
    parallel_for(pool, pieces(surfels.count), [&](int i) {
      OF_THIS_PROCESSOR(projection).project(surfels, view, i * PIECE, end_of(i, surfels.count), out);
    });
  }

  static int pieces(int count) { return (count + PIECE - 1) / PIECE; }
  static int end_of(int piece, int count) { return std::min(count, (piece + 1) * PIECE); }
};

ffi::Error forward(ffi::ThreadPool pool, Floats means, Floats log_scales, Floats quaternions, Floats opacity, Floats sh,
                   Floats camtoworld, Floats intrinsics, int64_t height, int64_t width, float near, bool antialias,
                   Result<Floats> sums, Result<Floats> median, Result<Floats> transmittance, Result<Integers> stop,
                   Result<Floats> reference) {
  Inputs inputs(means, log_scales, quaternions, opacity, sh, camtoworld, intrinsics, height, width, near, antialias);
  if (auto error = inputs.check(); error.failure()) return error;
  const int64_t pixels = inputs.pixels();
  for (int64_t i = 0; i < inputs.images && pixels > 0; i++) {
    const Table table(pool, inputs.surfels(i), inputs.view_of(i));
    blend(pool, table.image, {sums->typed_data() + i * CHANNELS * pixels, median->typed_data() + i * pixels,
                              transmittance->typed_data() + i * pixels, stop->typed_data() + i * pixels,
                              reference->typed_data() + i * pixels});
  }
  return ffi::Error::Success();
}

ffi::Error backward(ffi::ThreadPool pool, Floats means, Floats log_scales, Floats quaternions, Floats opacity, Floats sh,
                    Floats camtoworld, Floats intrinsics, Floats transmittance, Integers stop, Floats reference,
                    Floats sums_bar, Floats median_bar, int64_t height, int64_t width, float near, bool antialias,
                    bool of_camera, Result<Floats> means_bar, Result<Floats> log_scales_bar,
                    Result<Floats> quaternions_bar, Result<Floats> opacity_bar, Result<Floats> sh_bar,
                    Result<Floats> camera_bar) {
  Inputs inputs(means, log_scales, quaternions, opacity, sh, camtoworld, intrinsics, height, width, near, antialias);
  if (auto error = inputs.check(); error.failure()) return error;
  const int64_t pixels = inputs.pixels(), harmonics = inputs.harmonics();
  std::memset(camera_bar->typed_data(), 0, camera_bar->size_bytes());
  for (int64_t i = 0; i < inputs.images; i++) {
    const Surfels surfels = inputs.surfels(i);
    const View view = inputs.view_of(i);
    const Table table(pool, surfels, view);
    const Listing listing(pool, best_passes(), table.image);
    const Cotangents in = {sums_bar.typed_data() + i * CHANNELS * pixels, median_bar.typed_data() + i * pixels,
                           transmittance.typed_data() + i * pixels, stop.typed_data() + i * pixels,
                           reference.typed_data() + i * pixels};
    std::unique_ptr<float[]> table_bar(new float[size_t(surfels.count) * COLUMNS]);
    pull_back(pool, table.image, listing, in, table_bar.get());
    const int64_t first = i * surfels.count;
    const SurfelBars out = {means_bar->typed_data() + 3 * first, log_scales_bar->typed_data() + 2 * first,
                            quaternions_bar->typed_data() + 4 * first, opacity_bar->typed_data() + first,
                            sh_bar->typed_data() + 3 * harmonics * first};
    const int pieces = Table::pieces(surfels.count);
    std::vector<float> cameras(size_t(pieces) * CAMERA);
    parallel_for(pool, pieces, [&](int piece) {
      const int begin = piece * PIECE, end = Table::end_of(piece, surfels.count);
      // A box between the centers of pixels is in no list, so its row of cotangents is not written.
      for (int k = begin; k < end; k++)
        if (listing.boxes[k].down.last < listing.boxes[k].down.first) table.box[4 * size_t(k) + 2] = -1;
      OF_THIS_PROCESSOR(projection).pull_back(surfels, view, begin, end, table_bar.get(), table.box.get(), out,
                                              of_camera ? cameras.data() + size_t(piece) * CAMERA : nullptr);
    });
    for (int piece = 0; piece < pieces; piece++)
      for (int k = 0; k < CAMERA; k++) camera_bar->typed_data()[i * CAMERA + k] += cameras[size_t(piece) * CAMERA + k];
  }
  return ffi::Error::Success();
}

}  // namespace
}  // namespace jaxcloseup

#define SURFELS                    \
  xla::ffi::Ffi::Bind()            \
      .Ctx<xla::ffi::ThreadPool>() \
      .Arg<jaxcloseup::Floats>()   \
      .Arg<jaxcloseup::Floats>()   \
      .Arg<jaxcloseup::Floats>()   \
      .Arg<jaxcloseup::Floats>()   \
      .Arg<jaxcloseup::Floats>()   \
      .Arg<jaxcloseup::Floats>()   \
      .Arg<jaxcloseup::Floats>()
#define VIEW .Attr<int64_t>("height").Attr<int64_t>("width").Attr<float>("near").Attr<bool>("antialias")

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(surfels_forward, jaxcloseup::forward,
                              SURFELS VIEW.Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Integers>()
                                  .Ret<jaxcloseup::Floats>());

XLA_FFI_DEFINE_HANDLER_SYMBOL(surfels_backward, jaxcloseup::backward,
                              SURFELS.Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>() VIEW.Attr<bool>("of_camera")
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>());

#pragma GCC visibility pop
