// Matches patches of a row of pixels with those of neighbors: the arithmetic of `stereo/matching.py`.
//
// Compiled once for each instruction set; ISA names the result. Nothing of the standard library
// may be instantiated here: the linker would keep one copy for all processors.
#include "isa.h"
#include "stereo.h"
#include "vectors.h"

namespace jaxcloseup {
namespace {

inline I gather(const uint32_t* from, I at) {
#if defined(__AVX512F__)
  return (I)_mm512_mask_i32gather_epi32((__m512i)I{}, -1, (__m512i)at, from, 4);
#else
  int32_t places[WIDTH], values[WIDTH];
  std::memcpy(places, &at, sizeof at);
  for (int i = 0; i < WIDTH; i++) std::memcpy(values + i, from + places[i], sizeof *values);
  I to;
  std::memcpy(&to, values, sizeof to);
  return to;
#endif
}

inline V to_float(I x) { return __builtin_convertvector(x, V); }
inline I truncate(V x) { return __builtin_convertvector(x, I); }

inline void store_some(float* to, V from, int count) { std::memcpy(to, &from, sizeof(float) * (count < WIDTH ? count : WIDTH)); }

inline V clamp(V x, float most) { return lesser(greater(x, V{}), broadcast(most)); }

// Patches of WIDTH neighboring pixels of the photograph.
struct Patches {
  int side;
  V weight[MOST_SAMPLES * MOST_SAMPLES];    // of the samples, sum 1
  V centered[MOST_SAMPLES * MOST_SAMPLES];  // weight times the difference from the mean
  V variance;
};

void read_patches(const Match& job, int row, int column, Patches& to) {
  const size_t image = size_t(job.reference) * job.height * job.width;
  const uint32_t* quads = job.quads + image;
  const float* weights = job.weight + image;
  int32_t columns[WIDTH];
  for (int i = 0; i < WIDTH; i++) columns[i] = column + i;
  I x;
  std::memcpy(&x, columns, sizeof x);
  to.side = 2 * job.radius / job.stride + 1;
  const I own = x < job.width - 1 ? x : I{} + (job.width - 1);
  const V center = to_float(gather(quads, own + row * job.width) & 255);
  V total = V{}, mean = V{};
  for (int j = 0, s = 0; j < to.side; j++) {
    const int dy = j * job.stride - job.radius, y = row + dy;
    const int inner = y < 0 ? 0 : y >= job.height ? job.height - 1 : y;
    for (int i = 0; i < to.side; i++, s++) {
      const int dx = i * job.stride - job.radius;
      const I moved = x + dx;
      I at = moved < 0 ? I{} : moved;
      at = (at < job.width - 1 ? at : I{} + (job.width - 1)) + inner * job.width;
      const V gray = to_float(gather(quads, at) & 255);
      const V counts = (V)gather(reinterpret_cast<const uint32_t*>(weights), at);
      const V apart = (gray - center) * job.gray_scale;
      const float far = float(dx * dx + dy * dy) * job.pixel_scale;
      const V weight = select(less(V{}, counts), exponential(-(apart * apart) - far));
      to.weight[s] = weight;
      to.centered[s] = gray;
      total = total + weight;
      mean = mad(weight, gray, mean);
    }
  }
  const V scale = 1.f / greater(total, broadcast(1e-12f));
  mean = mean * scale;
  to.variance = V{};
  for (int s = 0; s < to.side * to.side; s++) {
    const V apart = to.centered[s] - mean;
    to.weight[s] = to.weight[s] * scale;
    to.centered[s] = to.weight[s] * apart;
    to.variance = mad(to.centered[s], apart, to.variance);
  }
}

// 1 - NCC with one neighbor under planes w + wx dx + wy dy of inverse depth.
V compare(const Match& job, const Patches& patches, int which, const V* plane, V x, float y) {
  const float* t = job.transforms + 12 * which;
  int neighbor = job.neighbor[which];
  if (neighbor < 0 || neighbor >= job.photographs) return broadcast(1);
  const size_t image = size_t(neighbor) * job.height * job.width;
  const uint32_t* quads = job.quads + image;
  V at[3], along_x[3], along_y[3];
  for (int i = 0; i < 3; i++) {
    const float* row = t + 4 * i;
    at[i] = mad(plane[0], broadcast(row[3]), mad(x, broadcast(row[0]), broadcast(row[1] * y + row[2])));
    along_x[i] = mad(plane[1], broadcast(row[3]), broadcast(row[0]));
    along_y[i] = mad(plane[2], broadcast(row[3]), broadcast(row[1]));
  }
  const float last_x = job.width - 1, last_y = job.height - 1;
  const V scale = 1.f / at[2], u = at[0] * scale, v = at[1] * scale;
  const M seen = less(V{}, plane[0]) & less(broadcast(1e-6f), at[2]) & at_most(V{}, u) & less(u, broadcast(job.width)) &
                 at_most(V{}, v) & less(v, broadcast(job.height));
  if (!any(seen)) return broadcast(1);
  const I own = truncate(clamp(v, last_y)) * job.width + truncate(clamp(u, last_x));
  const V counts = (V)gather(reinterpret_cast<const uint32_t*>(job.weight + image), own);
  V covariance = V{}, mean = V{}, square = V{};
  for (int j = 0, s = 0; j < patches.side; j++) {
    V start[3];
    for (int i = 0; i < 3; i++) start[i] = mad(along_y[i], broadcast(j * job.stride - job.radius), at[i]);
    for (int i = 0; i < patches.side; i++, s++) {
      const V dx = broadcast(i * job.stride - job.radius);
      const V near = 1.f / mad(along_x[2], dx, start[2]);
      const V px = clamp(mad(mad(along_x[0], dx, start[0]), near, broadcast(-.5f)), last_x);
      const V py = clamp(mad(mad(along_x[1], dx, start[1]), near, broadcast(-.5f)), last_y);
      const I column = truncate(px), line = truncate(py);
      const V wx = px - to_float(column), wy = py - to_float(line);
      const I quad = gather(quads, line * job.width + column);
      const V a = to_float(quad & 255), b = to_float((quad >> 8) & 255);
      const V c = to_float((quad >> 16) & 255), d = to_float((quad >> 24) & 255);
      const V top = mad(wx, b - a, a), bottom = mad(wx, d - c, c);
      const V gray = mad(wy, bottom - top, top);
      const V weighted = patches.weight[s] * gray;
      covariance = mad(patches.centered[s], gray, covariance);
      mean = mean + weighted;
      square = mad(weighted, gray, square);
    }
  }
  const V variance = greater(square - mean * mean, V{});
  const V ncc = covariance / root((patches.variance + job.noise) * (variance + job.noise));
  const V cost = lesser(1.f - ncc, broadcast(1));
  return select(seen & less(V{}, counts), greater(cost, V{}), broadcast(1));
}

void match_row(const Match& job, int row) {
  const size_t pixels = size_t(job.height) * job.width;
  for (int column = 0; column < job.width; column += WIDTH) {
    Patches patches;
    read_patches(job, row, column, patches);
    const size_t pixel = size_t(row) * job.width + column;
    const int count = job.width - column;
    V x;
    for (int i = 0; i < WIDTH; i++) x[i] = column + i + .5f;
    for (int k = 0; k < job.planes; k++) {
      V plane[3], best[MOST_NEIGHBORS];
      for (int i = 0; i < 3; i++) plane[i] = load_some(job.plane + (3 * k + i) * pixels + pixel, count);
      for (int i = 0; i < job.best; i++) best[i] = broadcast(1);
      for (int n = 0; n < job.neighbors; n++) {
        V cost = compare(job, patches, n, plane, x, row + .5f);
        for (int i = 0; i < job.best; i++) {
          const V more = greater(cost, best[i]);
          best[i] = lesser(cost, best[i]);
          cost = more;
        }
      }
      V total = V{};
      for (int i = 0; i < job.best; i++) total = total + best[i];
      store_some(job.cost + k * pixels + pixel, total / broadcast(job.best), count);
    }
  }
}

}  // namespace

extern const Matcher OF_ISA(matcher_, ISA) = {NAME(ISA), match_row};

}  // namespace jaxcloseup
