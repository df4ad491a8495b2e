// Blends the splats of tiles, and its derivative: the arithmetic of `splat_math.py`.
//
// Compiled once for each instruction set; ISA names the result. Nothing of the standard library
// may be instantiated here: the linker would keep one copy for all processors.
#include "splat_layout.h"
#include "isa.h"
#include "vectors.h"

namespace jaxcloseup {
namespace {

constexpr int PARTS = PIXELS / WIDTH;  // vectors of a tile's pixels

struct Pixels {
  V x[PARTS], y[PARTS];  // centers within a tile

  Pixels() {
    float xs[PIXELS], ys[PIXELS];
    for (int p = 0; p < PIXELS; p++) {
      xs[p] = p % TILE + .5f;
      ys[p] = p / TILE + .5f;
    }
    for (int j = 0; j < PARTS; j++) {
      x[j] = load(xs + j * WIDTH);
      y[j] = load(ys + j * WIDTH);
    }
  }
};

// Adds what a part of a tile contributes; where a tile has one part, that is all.
inline void add(V& sum, V part) { sum = PARTS == 1 ? part : sum + part; }

// Fetches what the loops reach some splats later.
inline void fetch(const float* base, int32_t splat, int stride) {
  __builtin_prefetch(base + static_cast<long>(splat) * stride);
  __builtin_prefetch(base + static_cast<long>(splat) * stride + 16);
}

// A splat at pixels, see `splat_math.shade`.
struct Shade {
  V dx, dy, u, v, w, inverse, z, rho, alpha;
  M on_plane, drawn;
};

inline Shade shade(const float* row, float ox, float oy, V x, V y, float near) {
  const float *h = row + HOMOGRAPHY;
  Shade s;
  s.dx = x - (row[ANCHOR] - ox);
  s.dy = y - (row[ANCHOR + 1] - oy);
  s.u = mad(broadcast(h[2]), s.dy, mad(broadcast(h[1]), s.dx, broadcast(h[0])));
  s.v = mad(broadcast(h[5]), s.dy, mad(broadcast(h[4]), s.dx, broadcast(h[3])));
  s.w = mad(broadcast(h[8]), s.dy, mad(broadcast(h[7]), s.dx, broadcast(h[6])));
  const V squared = mad(s.u, s.u, s.v * s.v);
  const V low = row[LOW_PASS] * mad(s.dx, s.dx, s.dy * s.dy);
  s.on_plane = less(V{}, s.w) & at_most(squared, low * (s.w * s.w));
  const V clipped = lesser(greater(s.w, broadcast(row[INVERSE_DEPTH])), broadcast(row[INVERSE_DEPTH + 1]));
  s.inverse = select(s.on_plane, s.w, clipped);
  s.z = 1.f / s.inverse;
  s.rho = select(s.on_plane, squared * (s.z * s.z), low);
  // In this order, so that NaN stays and is not drawn.
  s.alpha = lesser(broadcast(ALPHA_MAX), row[OPACITY] * exponential(-.5f * s.rho));
  s.drawn = at_most(broadcast(ALPHA_MIN), s.alpha) & at_most(s.w * near, broadcast(1));
  return s;
}

// Splats are evaluated in batches before they are blended one by one: evaluations of a batch depend
// on nothing, so a processor overlaps them.
constexpr int BATCH = 8;

// Where a tile lies in images.
struct Place {
  int x, y, width, height;  // of the part inside the image, in pixels
  float ox, oy;             // its first pixel
  long first;               // its offset in an image of rows
  int row;                  // pixels of an image's row

  Place(const Band& band, int tile) {
    x = tile % band.columns * TILE;
    y = (band.first_row + tile / band.columns) * TILE;
    width = band.width - x < TILE ? band.width - x : TILE;
    height = band.height - y < TILE ? band.height - y : TILE;
    ox = x;
    oy = y;
    row = band.width;
    first = static_cast<long>(y) * row + x;
  }

  template <typename T>
  void write(T* image, const T* pixels) const {
    for (int i = 0; i < height; i++)
      for (int k = 0; k < width; k++) image[first + i * static_cast<long>(row) + k] = pixels[i * TILE + k];
  }

  // Pixels outside the image are 0.
  template <typename T>
  void read(const T* image, T* pixels) const {
    std::memset(pixels, 0, PIXELS * sizeof(T));
    for (int i = 0; i < height; i++)
      for (int k = 0; k < width; k++) pixels[i * TILE + k] = image[first + i * static_cast<long>(row) + k];
  }
};

inline void read_parts(const Place& place, const float* image, V* parts) {
  float pixels[PIXELS];
  place.read(image, pixels);
  for (int j = 0; j < PARTS; j++) parts[j] = load(pixels + j * WIDTH);
}

inline void write_parts(const Place& place, float* image, const V* parts) {
  float pixels[PIXELS];
  for (int j = 0; j < PARTS; j++) store(pixels + j * WIDTH, parts[j]);
  place.write(image, pixels);
}

// FEATURES is the number of values of a payload, or 0 for any.
template <int FEATURES>
void forward_tile(const Band& band, const Planes& out, int tile, const Pixels& pixels) {
  const int features = FEATURES ? FEATURES : band.features;
  const Place place(band, tile);
  const V least = broadcast(TRANSMITTANCE_MIN);
  V product[PARTS], remaining[PARTS], median[PARTS], reference[PARTS], stop[PARTS];
  V sums[FEATURES ? FEATURES + MOMENTS : MOST_FEATURES + MOMENTS][PARTS];
  for (int j = 0; j < PARTS; j++) {
    product[j] = remaining[j] = broadcast(1);
    median[j] = reference[j] = stop[j] = V{};
    for (int f = 0; f < features + MOMENTS; f++) sums[f][j] = V{};
  }
  const int32_t* list = band.list + band.starts[tile];
  const int count = static_cast<int>(band.starts[tile + 1] - band.starts[tile]);
  Shade batch[BATCH][PARTS];
  for (int i = 0; i < count; i++) {
    if (i % BATCH == 0) {
      for (int k = i; k < count && k < i + BATCH; k++) {
        if (k + BATCH < count) fetch(band.splats, list[k + BATCH], band.stride);
        const float* row = band.splats + static_cast<long>(list[k]) * band.stride;
        for (int j = 0; j < PARTS; j++)
          batch[k - i][j] = shade(row, place.ox, place.oy, pixels.x[j], pixels.y[j], band.near);
      }
    }
    const float* row = band.splats + static_cast<long>(list[i]) * band.stride;
    M open{};
    for (int j = 0; j < PARTS; j++) {
      const Shade& s = batch[i % BATCH][j];
      if (!any(s.drawn)) {
        open = open | at_most(least, product[j]);
        continue;
      }
      const V alpha = select(s.drawn, s.alpha);
      const V before = product[j], after = before - alpha * before;
      // The splat that would take the transmittance below the limit is not drawn itself.
      const M unfinished = at_most(least, after);
      const V weight = select(unfinished, alpha * before);
      // Only in front of the first drawn splat is the product exactly 1.
      reference[j] = select(s.drawn & equal(before, broadcast(1)), s.inverse, reference[j]);
      median[j] = select(s.drawn & less(broadcast(.5f), before), s.z, median[j]);
      stop[j] = select(unfinished & s.drawn, broadcast(i + 1), stop[j]);
      remaining[j] = select(unfinished, after, remaining[j]);
      product[j] = after;  // it keeps falling, so that a finished pixel stays finished
      open = open | unfinished;
      for (int f = 0; f < features; f++) sums[f][j] = mad(weight, broadcast(row[PAYLOAD + f]), sums[f][j]);
      // Pixels that draw nothing may have no depth.
      const V z = select(s.drawn, s.z), shifted = select(s.drawn, s.inverse - reference[j]);
      const V first = weight * shifted;
      sums[features][j] = mad(weight, z, sums[features][j]);
      sums[features + 1][j] += weight;
      sums[features + 2][j] += first;
      sums[features + 3][j] = mad(first, shifted, sums[features + 3][j]);
    }
    if (!any(open)) break;
  }
  const long image = static_cast<long>(band.height) * band.width;
  for (int f = 0; f < features + MOMENTS; f++) write_parts(place, out.sums + f * image, sums[f]);
  write_parts(place, out.median, median);
  write_parts(place, out.transmittance, remaining);
  write_parts(place, out.reference, reference);
  int32_t stops[PIXELS];
  for (int j = 0; j < PARTS; j++) {
    const I whole = __builtin_convertvector(stop[j], I);
    std::memcpy(stops + j * WIDTH, &whole, sizeof whole);
  }
  place.write(out.stop, stops);
}

// What a pixel is pulled back from: the cotangents of its sums, and its trace.
template <int CHANNELS>
struct Pulled {
  V sums[CHANNELS][PARTS], median[PARTS], remaining[PARTS], reference[PARTS], stop[PARTS];
};

template <int FEATURES>
void backward_tile(const Band& band, const Cotangents& in, float* all_sums, int tile, const Pixels& pixels) {
  const int features = FEATURES ? FEATURES : band.features;
  const Place place(band, tile);
  const long image = static_cast<long>(band.height) * band.width;
  Pulled<FEATURES ? FEATURES + MOMENTS : MOST_FEATURES + MOMENTS> at;
  for (int f = 0; f < features + MOMENTS; f++) read_parts(place, in.sums + f * image, at.sums[f]);
  read_parts(place, in.median, at.median);
  read_parts(place, in.transmittance, at.remaining);
  read_parts(place, in.reference, at.reference);
  int32_t stops[PIXELS], last = 0;
  place.read(in.stop, stops);
  for (int p = 0; p < PIXELS; p++) last = stops[p] > last ? stops[p] : last;
  V after[PARTS], behind[PARTS];
  for (int j = 0; j < PARTS; j++) {
    I whole;
    std::memcpy(&whole, stops + j * WIDTH, sizeof whole);
    at.stop[j] = __builtin_convertvector(whole, V);
    after[j] = at.remaining[j];
    behind[j] = V{};
  }
  constexpr int SUMS = FEATURES ? (PAYLOAD_SUMS + FEATURES + 15) / 16 * 16 : MOST_FEATURES + PAYLOAD_SUMS;
  const int count = FEATURES ? SUMS : offside_sums(features), stride = sums_stride(features);
  const int32_t* list = band.list + band.starts[tile];
  const int listed = static_cast<int>(band.starts[tile + 1] - band.starts[tile]);
  Shade batch[BATCH][PARTS];
  V passing[BATCH][PARTS];  // what each lets pass, inverted
  const int behind_all = last < listed ? last : listed;
  for (int i = behind_all - 1; i >= 0; i--) {
    const int turn = (behind_all - 1 - i) % BATCH;
    if (turn == 0) {
      for (int k = i; k >= 0 && k > i - BATCH; k--) {
        if (k >= BATCH) fetch(band.splats, list[k - BATCH], band.stride);
        fetch(all_sums, list[k], stride);
        const float* row = band.splats + static_cast<long>(list[k]) * band.stride;
        for (int j = 0; j < PARTS; j++) {
          Shade& s = batch[i - k][j];
          s = shade(row, place.ox, place.oy, pixels.x[j], pixels.y[j], band.near);
          s.drawn = s.drawn & less(broadcast(k), at.stop[j]);
          s.alpha = select(s.drawn, s.alpha);
          passing[i - k][j] = 1.f / (1.f - s.alpha);
        }
      }
    }
    const float* row = band.splats + static_cast<long>(list[i]) * band.stride;
    V total[SUMS], aside[4];
    for (int f = 0; f < count; f++) total[f] = V{};
    for (int f = 0; f < 4; f++) aside[f] = V{};
    bool draws = false, has_aside = false;
    for (int j = 0; j < PARTS; j++) {
      const Shade& s = batch[turn][j];
      const M drawn = s.drawn;
      if (!any(drawn)) continue;
      draws = true;
      // Pixels that draw nothing may have no depth.
      const V alpha = s.alpha, z = select(drawn, s.z), inverse = select(drawn, s.inverse);
      const V before = after[j] * passing[turn][j];
      const V shifted = select(drawn, inverse - at.reference[j]);
      const V depth_bar = at.sums[features][j], alpha_bar = at.sums[features + 1][j];
      const V first_bar = at.sums[features + 2][j], second_bar = at.sums[features + 3][j];
      V value = mad(z, depth_bar, alpha_bar);
      value = mad(shifted, mad(shifted, second_bar, first_bar), value);
      const V weight = alpha * before;
      for (int f = 0; f < features; f++) {
        value = mad(broadcast(row[PAYLOAD + f]), at.sums[f][j], value);
        add(total[PAYLOAD_SUMS + f], weight * at.sums[f][j]);
      }
      // The splat adds its own worth and dims all splats behind it.
      V scaled = alpha * (before * value - behind[j] * passing[turn][j]);
      scaled = select(less(alpha, broadcast(ALPHA_MAX)), scaled);
      // The median splat takes transmittance to 1/2, else it is the last drawn one.
      const M last = at_most(after[j], broadcast(.5f)) | equal(after[j], at.remaining[j]);
      const M median = drawn & less(broadcast(.5f), before) & last;
      const V z_bar = mad(weight, depth_bar, select(median, at.median[j]));
      const V inverse_bar = weight * mad(2.f * shifted, second_bar, first_bar) - z * z * z_bar;
      behind[j] = mad(weight, value, behind[j]);
      after[j] = before;
      const V plane = select(s.on_plane, scaled * z);
      const V u = -plane * z * s.u, v = -plane * z * s.v;
      const M off = drawn & ~s.on_plane;
      V w = mad(plane, s.rho, inverse_bar);
      if (any(off)) {
        has_aside = true;
        const M outside = less(s.w, broadcast(row[INVERSE_DEPTH])) | less(broadcast(row[INVERSE_DEPTH + 1]), s.w);
        const M clipped = off & outside;
        w = select(s.on_plane, w, select(~clipped, inverse_bar));
        const V low = select(~s.on_plane, scaled);
        add(aside[0], low);
        add(aside[1], low * s.dx);
        add(aside[2], low * s.dy);
        add(aside[3], select(clipped, inverse_bar * inverse * inverse));
      }
      add(total[0], u);
      add(total[1], u * s.dx);
      add(total[2], u * s.dy);
      add(total[3], v);
      add(total[4], v * s.dx);
      add(total[5], v * s.dy);
      add(total[6], w);
      add(total[7], w * s.dx);
      add(total[8], w * s.dy);
      add(total[SCALED], scaled);
    }
    if (!draws) continue;
    float* sums = all_sums + static_cast<long>(list[i]) * stride;
    for (int f = 0; f < count; f += WIDTH) store(sums + f, load(sums + f) + sum_each(total + f));
    if (has_aside) {
      V four[WIDTH];
      for (int f = 0; f < WIDTH; f++) four[f] = f < 4 ? aside[f] : V{};
      store(sums + count, load(sums + count) + sum_each(four));
    }
  }
}

template <int FEATURES>
void forward_tiles(const Band& band, const Planes& out) {
  const Pixels pixels;
  for (int tile = 0; tile < band.rows * band.columns; tile++) forward_tile<FEATURES>(band, out, tile, pixels);
}

template <int FEATURES>
void backward_tiles(const Band& band, const Cotangents& in, float* sums) {
  const Pixels pixels;
  for (int tile = 0; tile < band.rows * band.columns; tile++) backward_tile<FEATURES>(band, in, sums, tile, pixels);
}

// Surfels carry colors and normals, volumetric Gaussians colors.
void forward(const Band& band, const Planes& out) {
  if (band.features == 6) return forward_tiles<6>(band, out);
  if (band.features == 3) return forward_tiles<3>(band, out);
  forward_tiles<0>(band, out);
}

void backward(const Band& band, const Cotangents& in, float* sums) {
  if (band.features == 6) return backward_tiles<6>(band, in, sums);
  if (band.features == 3) return backward_tiles<3>(band, in, sums);
  backward_tiles<0>(band, in, sums);
}

}  // namespace

void OF_ISA(find_tiles_, ISA)(const Image&, int, int, TileBox*);
void OF_ISA(find_reach_, ISA)(const Image&, int, const int32_t*, const TileBox*, const int64_t*, Range*);

extern const Passes OF_ISA(passes_, ISA) = {NAME(ISA), OF_ISA(find_tiles_, ISA), OF_ISA(find_reach_, ISA),
                                            forward, backward};

}  // namespace jaxcloseup
