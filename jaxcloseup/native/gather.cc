// Gathering as a function that XLA calls.
#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

#include "gather.h"
#include "parallel.h"
#include "processor.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;

float mean_focal(const float* intrinsics) { return std::sqrt(intrinsics[0] * intrinsics[1]); }

Photograph describe(const float* pose, const float* intrinsics, const float* of_levels, const Job& job) {
  Photograph to;
  for (int i = 0; i < 3; i++) {
    std::memcpy(to.rotation + 3 * i, pose + 4 * i, 3 * sizeof(float));
    to.position[i] = pose[4 * i + 3];
  }
  const int sizes[2] = {job.width, job.height};
  for (int axis = 0; axis < 2; axis++) {
    const float focal = intrinsics[axis], center = intrinsics[2 + axis];
    to.focal[axis] = focal;
    to.center[axis] = center;
    to.lengths[2 * axis] = std::hypot(focal, center);
    to.lengths[2 * axis + 1] = std::hypot(focal, sizes[axis] - center);
  }
  const float finest = mean_focal(of_levels);
  to.log_focal = std::log2(finest);
  for (int level = 0; level < job.levels; level++)
    to.coarseness[level] = std::log2(finest / mean_focal(of_levels + 4 * level));
  to.footprint = 1 / mean_focal(of_levels + 4 * job.finest);
  return to;
}

// `sizes` are (height, width) of a photograph's levels, and `starts` their first pixels.
LevelPair pair_levels(const float* of_levels, const int32_t* sizes, const int32_t* starts, int levels, int level) {
  LevelPair pair;
  for (int i = 0; i < 2; i++) {
    const int own = std::min(level + i, levels - 1);
    for (int axis = 0; axis < 2; axis++) {
      pair.focal[2 * i + axis] = of_levels[4 * own + axis];
      pair.center[2 * i + axis] = of_levels[4 * own + 2 + axis];
      pair.most[2 * i + axis] = sizes[2 * own + 1 - axis] - 1;
    }
    pair.start[i] = starts[own];
    pair.width[i] = sizes[2 * own + 1];
  }
  return pair;
}

// The view's camera, and its pixels in rows.
struct View {
  const float *pose, *intrinsics, *pixels, *depth;
  int64_t rows, columns;

  // A block is square if the rows allow it.
  int64_t high() const { return std::min<int64_t>(rows, 8); }
  int64_t wide() const { return BLOCK / high(); }
  int64_t across() const { return (columns + wide() - 1) / wide(); }
  int64_t blocks() const { return (rows + high() - 1) / high() * across(); }
};

// Finds the points of a block, and writes the index of each one's pixel; false if there are none.
bool find_points(const View& view, int64_t block, Points& points, int64_t* pixels) {
  const int64_t top = block / view.across() * view.high(), left = block % view.across() * view.wide();
  const float *r = view.pose, focal = mean_focal(view.intrinsics);
  double center[3] = {};
  int known = 0, count = 0;
  std::memset(points.side, 0, sizeof points.side);
  std::memset(points.at, 0, sizeof points.at);
  std::memset(points.ray, 0, sizeof points.ray);
  for (int64_t y = top; y < std::min(top + view.high(), view.rows); y++)
    for (int64_t x = left; x < std::min(left + view.wide(), view.columns); x++, count++) {
      const int64_t pixel = pixels[count] = y * view.columns + x;
      const float depth = view.depth[pixel];
      const float u = (view.pixels[2 * pixel] - view.intrinsics[2]) / view.intrinsics[0];
      const float v = (view.pixels[2 * pixel + 1] - view.intrinsics[3]) / view.intrinsics[1];
      float at[3], ray[3], squared = 0;
      for (int i = 0; i < 3; i++) {
        ray[i] = depth * (u * r[4 * i] + v * r[4 * i + 1] + r[4 * i + 2]);
        at[i] = r[4 * i + 3] + ray[i];
        squared += ray[i] * ray[i];
      }
      if (!(depth > 0) || !std::isfinite(squared) || !std::isfinite(at[0] + at[1] + at[2])) continue;
      points.side[count] = depth / focal;
      const float scale = squared > 0 ? 1 / std::sqrt(squared) : 0;
      for (int i = 0; i < 3; i++) {
        points.at[i][count] = at[i];
        points.ray[i][count] = ray[i] * scale;
        center[i] += at[i];
      }
      known++;
    }
  points.count = count;
  double radius = 0;
  for (int i = 0; i < 3; i++) center[i] /= std::max(known, 1);
  for (int p = 0; p < count; p++) {
    double squared = 0;
    for (int i = 0; i < 3; i++) squared += (points.at[i][p] - center[i]) * (points.at[i][p] - center[i]);
    if (points.side[p] > 0) radius = std::max(radius, squared);
  }
  double far = 0;
  for (int i = 0; i < 3; i++) {
    points.center[i] = center[i];
    far = std::max(far, std::abs(center[i]));
  }
  points.radius = std::sqrt(radius) * 1.001 + far * 1e-6;  // what is rounded must not leave it
  return known > 0;
}

struct Scratch {
  Workspace work;
  Points points;
  std::vector<Record> records;
  std::vector<float> sums;
  int64_t pixels[BLOCK];

  void fit(const Job& job) {
    if (!records.empty()) return;
    records.resize(std::max(job.photographs, 1));
    const size_t size = size_t(BLOCK) * job.vectors() * LANES;
    sums.resize(3 * size);
    work.records = records.data();
    work.values = sums.data();
    work.squares = work.values + size;
    work.robust = work.squares + size;
  }
};

// What a part's fields are written to, in the order of `Gathered`.
struct Fields {
  float *mean, *others[6];
};

void write_block(const Job& job, const Scratch& scratch, bool gathered, const Fields* fields) {
  const int each = job.part_channels(), stride = job.vectors() * LANES;
  for (int k = 0; k < job.parts; k++) {
    const PartSums& part = scratch.work.parts[k];
    const float* found[6] = {part.weight, part.variance, part.count, part.footprint, part.detail, part.angle};
    for (int p = 0; p < scratch.points.count; p++) {
      const int64_t pixel = scratch.pixels[p];
      for (int c = 0; c < each; c++)
        fields[k].mean[pixel * each + c] = gathered ? scratch.work.values[p * stride + k * each + c] : 0;
      for (int i = 0; i < 6; i++) fields[k].others[i][pixel] = gathered ? found[i][p] : i == 3 ? INFINITY : 0;
    }
  }
}

// Checks the shapes that memory accesses rely on, and describes the photographs.
ffi::Error prepare(ffi::ThreadPool& pool, Floats& poses, Floats& intrinsics, Floats& maps,
                   ffi::AnyBuffer& values, Floats& of_levels, Integers& sizes,
                   ffi::Span<const float>& settings, int finest, Job& job, std::vector<Photograph>& photographs,
                   std::vector<LevelPair>& pairs) {
  const auto map = maps.dimensions(), shape = values.dimensions();
  const auto extents = sizes.dimensions();
  if (map.size() != 4 || map[3] != 2 || shape.size() != 2 || extents.size() != 3 || extents[2] != 2)
    return ffi::Error::InvalidArgument("maps must be [V, H + 2, W + 2, 2], values [P, C] and sizes [V, L, 2]");
  const int64_t count = map[0], levels = extents[1], parts = settings.size() / 4;
  const bool fit = count <= INT32_MAX && map[1] > 2 && map[2] > 2 && map[1] < 32768 && map[2] < 32768;
  if (!fit || extents[0] != count || poses.element_count() != size_t(12 * count) || intrinsics.element_count() != size_t(4 * count) ||
      of_levels.element_count() != size_t(4 * count * levels))
    return ffi::Error::InvalidArgument("photographs have different numbers, or maps a wrong size");
  if (levels < 1 || levels > MOST_LEVELS || parts < 1 || parts > MOST_PARTS || shape[1] > MOST_CHANNELS ||
      shape[1] < parts || shape[1] % parts)
    return ffi::Error::InvalidArgument("too many levels, parts or channels, or too few");
  std::vector<int32_t> starts;
  int64_t pixels = 0;
  for (int64_t i = 0; i < count * levels; i++) {
    const int64_t height = sizes.typed_data()[2 * i], width = sizes.typed_data()[2 * i + 1];
    starts.push_back(static_cast<int32_t>(pixels));
    if (height < 1 || width < 1) return ffi::Error::InvalidArgument("a level is empty");
    pixels += height * width;
    if (pixels > INT32_MAX) return ffi::Error::InvalidArgument("photographs are too large");
  }
  if (pixels != shape[0]) return ffi::Error::InvalidArgument("levels have another number of pixels");
  switch (values.element_type()) {
    case ffi::S8: job.kind = Kind::INT8; break;
    case ffi::U8: job.kind = Kind::UINT8; break;
    case ffi::F32: job.kind = Kind::FLOAT; break;
    default: return ffi::Error::InvalidArgument("values must be int8, uint8 or float32");
  }
  job.photographs = static_cast<int>(count);
  job.height = static_cast<int>(map[1]) - 2;
  job.width = static_cast<int>(map[2]) - 2;
  job.levels = static_cast<int>(levels);
  job.finest = std::clamp(finest, 0, job.levels - 1);
  job.values = values.untyped_data();
  job.pixels = pixels;
  job.channels = static_cast<int>(shape[1]);
  job.parts = static_cast<int>(parts);
  std::memcpy(job.settings, settings.begin(), settings.size() * sizeof(float));
  photographs.resize(count);
  pairs.resize(count * levels);
  parallel_for(pool, job.photographs, [&](int i) {
    const float* own = of_levels.typed_data() + 4 * levels * i;
    photographs[i] = describe(poses.typed_data() + 12 * i, intrinsics.typed_data() + 4 * i, own, job);
    for (int level = 0; level < job.levels; level++)
      pairs[i * levels + level] =
          pair_levels(own, sizes.typed_data() + 2 * levels * i, starts.data() + levels * i, job.levels, level);
  });
  job.photograph = photographs.data();
  job.pairs = pairs.data();
  job.maps = maps.typed_data();
  return ffi::Error::Success();
}

ffi::Error gather(ffi::ThreadPool pool, Floats pose, Floats intrinsics, Floats pixels, Floats depth, Floats poses,
                  Floats of_maps, Floats maps, ffi::AnyBuffer values, Floats of_levels,
                  Integers sizes, Integers finest, Integers exclude, ffi::RemainingRets results,
                  ffi::Span<const float> settings) {
  Job job;
  std::vector<Photograph> photographs;
  std::vector<LevelPair> pairs;
  if (pose.element_count() != 12 || intrinsics.element_count() != 4 || finest.element_count() != 1 ||
      exclude.element_count() != 1 || pixels.element_count() != 2 * depth.element_count())
    return ffi::Error::InvalidArgument("one camera, [..., 2] pixels and [...] depths are needed");
  auto error = prepare(pool, poses, of_maps, maps, values, of_levels, sizes, settings, finest.typed_data()[0], job,
                       photographs, pairs);
  if (error.failure()) return error;
  job.exclude = exclude.typed_data()[0];
  const int64_t count = depth.element_count(), axes = depth.dimensions().size();
  Fields fields[MOST_PARTS];
  for (int i = 0; i < 7 * job.parts; i++) {
    auto result = results.get<Floats>(i);
    const int64_t each = i % 7 ? 1 : job.part_channels();
    if (!result.has_value() || (*result)->element_count() != size_t(count * each))
      return ffi::Error::InvalidArgument("a result has another size");
    (i % 7 ? fields[i / 7].others[i % 7 - 1] : fields[i / 7].mean) = (*result)->typed_data();
  }
  if (count == 0) return ffi::Error::Success();
  // Whatever lies before the last axis is rows; images of a batch may share blocks.
  const int64_t columns = axes ? depth.dimensions().back() : 1;
  const View view = {pose.typed_data(),  intrinsics.typed_data(), pixels.typed_data(),
                     depth.typed_data(), count / columns,         columns};
  const Gatherer& gatherer = OF_THIS_PROCESSOR(gatherer);
  const int64_t blocks = view.blocks(), each = 16;
  parallel_for_with<Scratch>(pool, (blocks + each - 1) / each, [&](Scratch& scratch, int piece) {
    scratch.fit(job);
    for (int64_t block = piece * each; block < std::min(blocks, (piece + 1) * each); block++) {
      const bool any = find_points(view, block, scratch.points, scratch.pixels);
      if (any) gatherer.gather(job, scratch.points, scratch.work);
      write_block(job, scratch, any, fields);
    }
  });
  return ffi::Error::Success();
}

}  // namespace
}  // namespace jaxcloseup

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(gather, jaxcloseup::gather,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<xla::ffi::AnyBuffer>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Integers>()
                                  .RemainingRets()
                                  .Attr<xla::ffi::Span<const float>>("settings"));

#pragma GCC visibility pop
