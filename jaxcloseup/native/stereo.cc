// Matching patches under planes as a function that XLA calls.
#include "parallel.h"
#include "processor.h"
#include "stereo.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;
using Quads = ffi::Buffer<ffi::U32>;

ffi::Error stereo(ffi::ThreadPool pool, Quads quads, Floats weight, Integers reference, Integers neighbors,
                  Floats transforms, Floats planes, ffi::Result<Floats> cost, ffi::Span<const int64_t> patch,
                  ffi::Span<const float> scales) {
  const auto image = quads.dimensions(), plane = planes.dimensions();
  if (image.size() != 3 || plane.size() != 4 || plane[1] != 3 || plane[2] != image[1] || plane[3] != image[2])
    return ffi::Error::InvalidArgument("quads must be [V, H, W] and planes [K, 3, H, W]");
  const int64_t count = neighbors.element_count();
  if (weight.element_count() != quads.element_count() || reference.element_count() != 1 ||
      transforms.element_count() != size_t(12 * count) || 3 * cost->element_count() != planes.element_count())
    return ffi::Error::InvalidArgument("arguments have different sizes");
  if (patch.size() != 3 || scales.size() != 3 || patch[0] < 0 || patch[1] < 1 || patch[0] > 1000 ||
      2 * patch[0] / patch[1] + 1 > MOST_SAMPLES || 2 * patch[0] % patch[1] || patch[2] < 1 || patch[2] > MOST_NEIGHBORS ||
      image[1] * image[2] > INT32_MAX || plane[0] > INT32_MAX || count > INT32_MAX || image[0] > INT32_MAX)
    return ffi::Error::InvalidArgument("the patch has no such size");
  Match job;
  job.photographs = static_cast<int>(image[0]);
  job.height = static_cast<int>(image[1]);
  job.width = static_cast<int>(image[2]);
  job.planes = static_cast<int>(plane[0]);
  job.neighbors = static_cast<int>(count);
  job.quads = quads.typed_data();
  job.weight = weight.typed_data();
  job.reference = reference.typed_data()[0];
  job.neighbor = neighbors.typed_data();
  job.transforms = transforms.typed_data();
  job.plane = planes.typed_data();
  job.radius = static_cast<int>(patch[0]);
  job.stride = static_cast<int>(patch[1]);
  job.best = static_cast<int>(patch[2]);
  job.gray_scale = scales[0];
  job.pixel_scale = scales[1];
  job.noise = scales[2];
  job.cost = cost->typed_data();
  if (job.reference < 0 || job.reference >= job.photographs)
    return ffi::Error::InvalidArgument("there is no such photograph");
  const Matcher& matcher = OF_THIS_PROCESSOR(matcher);
  if (job.width) parallel_for(pool, job.height, [&](int row) { matcher.match_row(job, row); });
  return ffi::Error::Success();
}

}  // namespace
}  // namespace jaxcloseup

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(stereo, jaxcloseup::stereo,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<jaxcloseup::Quads>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Attr<xla::ffi::Span<const int64_t>>("patch")
                                  .Attr<xla::ffi::Span<const float>>("scales"));

#pragma GCC visibility pop
