// SSIM of two images and its derivative as a function that XLA calls, see `metrics/similarity.py`.
#include "ssim.h"

#include <algorithm>

#include "parallel.h"
#include "processor.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;

// Writes 0 around the part of a padded plane that windows fill.
void clear_border(const Similarity& job, float* plane) {
  const int64_t padded = (job.width + REACH) * CHANNELS, side = REACH * CHANNELS;
  std::fill_n(plane, REACH * padded, 0.f);
  std::fill_n(plane + job.height * padded, REACH * padded, 0.f);
  for (int64_t row = REACH; row < job.height; row++) {
    std::fill_n(plane + row * padded, side, 0.f);
    std::fill_n(plane + row * padded + padded - side, side, 0.f);
  }
}

ffi::Error ssim(ffi::ThreadPool pool, Floats image, Floats target, Floats share, ffi::Result<Floats> map,
                ffi::Result<Floats> gradient, ffi::Result<Floats> pulls, ffi::Span<const float> taps,
                ffi::Span<const float> constants) {
  const auto size = image.dimensions(), other = target.dimensions(), windows = share.dimensions();
  if (size.size() != 3 || size[2] != CHANNELS || size[0] < TAPS || size[1] < TAPS || size[0] > INT32_MAX)
    return ffi::Error::InvalidArgument("the image must be [H, W, 3], at least 11 pixels a side");
  if (!std::equal(size.begin(), size.end(), other.begin(), other.end()) || windows.size() != 2 ||
      windows[0] != size[0] - REACH || windows[1] != size[1] - REACH ||
      map->element_count() != share.element_count() || taps.size() != TAPS || constants.size() != 2)
    return ffi::Error::InvalidArgument("arguments have different sizes");
  const bool wanted = gradient->element_count() > 0;
  const size_t padded = size_t(size[0] + REACH) * size_t(size[1] + REACH) * CHANNELS;
  if (wanted && (gradient->element_count() != image.element_count() || pulls->element_count() != PULLS * padded))
    return ffi::Error::InvalidArgument("the derivative has another size");
  Similarity job{size[0], size[1], image.typed_data(), target.typed_data(), share.typed_data()};
  std::copy(taps.begin(), taps.end(), job.taps);
  job.c1 = constants[0], job.c2 = constants[1];
  job.map = map->typed_data();
  job.pulls = wanted ? pulls->typed_data() : nullptr;
  job.gradient = gradient->typed_data();
  const Comparer& comparer = OF_THIS_PROCESSOR(comparer);
  parallel_for(pool, int(job.height - REACH), [&](int row) { comparer.compare_row(job, row); });
  if (!wanted) return ffi::Error::Success();
  for (int k = 0; k < PULLS; k++) clear_border(job, job.pulls + k * padded);
  parallel_for(pool, int(job.height), [&](int row) { comparer.pull_row(job, row); });
  return ffi::Error::Success();
}

}  // namespace
}  // namespace jaxcloseup

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(ssim, jaxcloseup::ssim,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Attr<xla::ffi::Span<const float>>("taps")
                                  .Attr<xla::ffi::Span<const float>>("constants"));

#pragma GCC visibility pop
