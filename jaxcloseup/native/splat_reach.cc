// Which tiles splats draw in: the exact test of `tile_test.py`, for whole rows of tiles.
//
// Compiled once for each instruction set, see `splat_tiles.cc`.
#include <cmath>

#include "splat_layout.h"
#include "isa.h"
#include "vectors.h"

namespace jaxcloseup {
namespace {

constexpr double MARGIN = .01;  // pixels; with the factor below, more than rounding
constexpr float WIDER = 1.001f;
constexpr int LANES = WIDTH / 2;  // doubles of a vector

typedef double D __attribute__((vector_size(8 * LANES)));
typedef int64_t L __attribute__((vector_size(8 * LANES)));

inline D pick(L mask, D a, D b) { return (D)((mask & (L)a) | (~mask & (L)b)); }
inline D smaller(D a, D b) { return pick(a < b, a, b); }
inline D larger(D a, D b) { return pick(a > b, a, b); }
inline D clamped(D x, D low, D high) { return smaller(larger(x, low), high); }
inline D root(D x) {
  x = larger(x, D{});
#if defined(__AVX512F__)
  return (D)_mm512_maskz_sqrt_pd(-1, (__m512d)x);
#elif defined(__AVX__)
  return (D)_mm256_sqrt_pd((__m256d)x);
#elif defined(__SSE2__)
  return (D)_mm_sqrt_pd((__m128d)x);
#else
  for (int i = 0; i < LANES; i++) x[i] = std::sqrt(x[i]);
  return x;
#endif
}

// Tiles with centers of pixels between two bounds, of `size` pixels in all; none if one is NaN.
inline Range tiles_between(float low, float high, int size) {
  // Clipped before the cast: bounds may be infinite.
  float first = std::ceil(low - .5f), last = std::floor(high - .5f);
  first = first > 0 ? first : 0;
  last = last < size - 1 ? last : size - 1;
  if (!(first <= last && low <= high)) return {0, -1};
  return {static_cast<int16_t>(static_cast<int>(first) / TILE), static_cast<int16_t>(static_cast<int>(last) / TILE)};
}

void find_tiles(const Image& image, int begin, int end, TileBox* boxes) {
  for (int i = begin; i < end; i++) {
    const float* box = image.box + 4L * i;
    TileBox tiles = {tiles_between(box[0], box[2], image.width), tiles_between(box[1], box[3], image.height)};
    if (tiles.across.last < tiles.across.first || tiles.down.last < tiles.down.first) tiles = {{0, -1}, {0, -1}};
    boxes[i] = tiles;
  }
}

// With the homography H, cutoff c and d = (1, q - anchor), a splat is at least ALPHA_MIN where
// |(H[0].d, H[1].d)| <= c H[2].d, a quadratic form in q - anchor: within an ellipse. In a row of
// tiles, its sides are farthest out as near to its leftmost and rightmost points as can be.
void find_reach(const Image& image, int count, const int32_t* splats, const TileBox* boxes, const int64_t* starts,
                Range* ranges) {
  for (int begin = 0; begin < count; begin += LANES) {
    const int lanes = count - begin < LANES ? count - begin : LANES;
    D at[HOMOGRAPHY + 9], cutoff{}, radius{};
    L unbounded{};
    int most_rows = 0;
    for (int k = 0; k < LANES; k++) {
      const int lane = k < lanes ? k : 0;
      if (begin + LANES + k < count) {
        const int32_t later = splats[begin + LANES + k];
        __builtin_prefetch(boxes + later);
        __builtin_prefetch(image.table + static_cast<long>(later) * image.columns);
        __builtin_prefetch(image.table + static_cast<long>(later) * image.columns + LOW_PASS);
      }
      const float* row = image.table + static_cast<long>(splats[begin + lane]) * image.columns;
      for (int i = 0; i < HOMOGRAPHY + 9; i++) at[i][k] = row[i];
      const float opacity = row[OPACITY] / ALPHA_MIN;
      cutoff[k] = WIDER * std::sqrt(2 * std::log(opacity > 1 ? opacity : 1.f));
      radius[k] = cutoff[k] * cutoff[k] / row[LOW_PASS];
      // One that reaches the near plane is kept wherever its box is.
      unbounded[k] = row[INVERSE_DEPTH + 1] * image.near < 1 / WIDER ? 0 : -1;
      const Range down = boxes[splats[begin + lane]].down;
      const int rows = down.last - down.first + 1;
      most_rows = rows > most_rows ? rows : most_rows;
    }
    const D* h = at + HOMOGRAPHY;
    const auto form = [&](int i, int k) {
      return h[i] * h[k] + h[3 + i] * h[3 + k] - cutoff * cutoff * (h[6 + i] * h[6 + k]);
    };
    const D a = form(1, 1), b = form(1, 2), c = form(2, 2), d = form(0, 1), e = form(0, 2), f = form(0, 0);
    const D area = a * c - b * b;
    // An image without a bound is kept too.
    unbounded |= ~((a > 0) & (area > 0));
    const D center_x = (b * e - c * d) / area, center_y = (b * d - a * e) / area;
    const D depth = -(f + d * center_x + e * center_y);
    const L empty = depth < 0;
    const D half_y = root(depth * a / area), rightmost = -b / c * root(depth * c / area);
    for (int r = 0; r < most_rows; r++) {
      D top{};
      for (int k = 0; k < LANES; k++) top[k] = (boxes[splats[begin + (k < lanes ? k : 0)]].down.first + r) * TILE + .5;
      const D low = top - MARGIN - at[ANCHOR + 1], high = top + (TILE - 1 + MARGIN) - at[ANCHOR + 1];
      const D from = larger(low, center_y - half_y), to = smaller(high, center_y + half_y);
      const L missed = empty | (from > to);
      const auto side = [&](D y, int sign) {
        const D slope = b * y + d;
        const D from_middle = root(slope * slope - a * (c * y * y + 2. * e * y + f));
        return (static_cast<double>(sign) * from_middle - slope) / a;
      };
      D x0 = side(clamped(center_y - rightmost, from, to), -1), x1 = side(clamped(center_y + rightmost, from, to), 1);
      const D infinite = D{} + INFINITY;
      x0 = pick(missed, infinite, x0);
      x1 = pick(missed, -infinite, x1);
      // The low-pass: a circle about the anchor.
      const D off = clamped(D{}, low, high), squared = radius - off * off, half = root(squared);
      x0 = pick(squared >= 0, smaller(x0, -half), x0);
      x1 = pick(squared >= 0, larger(x1, half), x1);
      x0 = pick(unbounded, -infinite, x0 + at[ANCHOR] - MARGIN);
      x1 = pick(unbounded, infinite, x1 + at[ANCHOR] + MARGIN);
      for (int k = 0; k < lanes; k++) {
        const TileBox& tiles = boxes[splats[begin + k]];
        if (r > tiles.down.last - tiles.down.first) continue;
        Range range = tiles_between(static_cast<float>(x0[k]), static_cast<float>(x1[k]), image.width);
        range.first = range.first > tiles.across.first ? range.first : tiles.across.first;
        range.last = range.last < tiles.across.last ? range.last : tiles.across.last;
        const bool drawn = image.table[static_cast<long>(splats[begin + k]) * image.columns + OPACITY] >= ALPHA_MIN;
        ranges[starts[begin + k] + r] = drawn ? range : Range{0, -1};
      }
    }
  }
}

}  // namespace

void OF_ISA(find_tiles_, ISA)(const Image& image, int begin, int end, TileBox* boxes) {
  find_tiles(image, begin, end, boxes);
}

void OF_ISA(find_reach_, ISA)(const Image& image, int count, const int32_t* splats, const TileBox* boxes,
                              const int64_t* starts, Range* ranges) {
  find_reach(image, count, splats, boxes, starts, ranges);
}

}  // namespace jaxcloseup
