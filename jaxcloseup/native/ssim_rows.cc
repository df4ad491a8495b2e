// SSIM of a row of windows, and its derivative for a row of pixels: see `metrics/similarity.py`.
//
// Compiled once for each instruction set; ISA names the result. Nothing of the standard library
// may be instantiated here: the linker would keep one copy for all processors.
#include "isa.h"
#include "ssim.h"
#include "vectors.h"

namespace jaxcloseup {
namespace {

// Values of a row that are blurred at once: what the taps read stays in the first cache.
constexpr int BLOCK = 16 * 24;
constexpr int WIDE = BLOCK + 16 * ((REACH * CHANNELS + 15) / 16);  // with what the last windows cover

inline int64_t at_most(int64_t a, int64_t b) { return a < b ? a : b; }
// As many values as whole vectors have.
inline int64_t whole(int64_t count) { return (count + WIDTH - 1) / WIDTH * WIDTH; }

// Sums `values` along a row with the weights of the taps.
inline V along(const float* values, const float* taps) {
  V sum = load(values) * taps[0];
  for (int k = 1; k < TAPS; k++) sum = mad(load(values + k * CHANNELS), broadcast(taps[k]), sum);
  return sum;
}

// With means m, n of image and target in a window, d the mean of their squared difference and q of
// their product, SSIM is l s, l = 1 - (m - n)^2 / (m^2 + n^2 + c1) and s = 1 - e / (2 (q - m n) + e + c2),
// where e = d - (m - n)^2 is the variance of the difference: so rounding leaves 1 where images are equal.
// The derivatives of its weighted sum by m, d and q are kept.
void compare_row(const Similarity& job, int64_t row) {
  const int64_t stride = job.width * CHANNELS, count = stride - REACH * CHANNELS;
  const int64_t padded = (job.width + REACH) * CHANNELS, plane = (job.height + REACH) * padded;
  float rows[4][WIDE], values[BLOCK + WIDTH], shares[BLOCK + WIDTH], pulls[PULLS][BLOCK + WIDTH];
  for (int64_t begin = 0; begin < count; begin += BLOCK) {
    const int64_t size = at_most(BLOCK, count - begin), covered = size + REACH * CHANNELS;
    for (int64_t i = 0; i < whole(size) + REACH * CHANNELS; i += WIDTH) {
      V m{}, n{}, d{}, q{};
      for (int k = 0; k < TAPS; k++) {
        const int64_t from = (row + k) * stride + begin + i;
        const V a = load_some(job.image + from, covered - i), b = load_some(job.target + from, covered - i);
        const V tap = broadcast(job.taps[k]), tap_a = tap * a, tap_b = tap * b;
        m += tap_a;
        n += tap_b;
        d = mad(tap_a - tap_b, a - b, d);
        q = mad(tap_a, b, q);
      }
      store(rows[0] + i, m);
      store(rows[1] + i, n);
      store(rows[2] + i, d);
      store(rows[3] + i, q);
    }
    const float* share = job.share + row * (job.width - REACH) + begin / CHANNELS;
    for (int64_t i = 0; i < size; i += CHANNELS)
      for (int c = 0; c < CHANNELS; c++) shares[i + c] = share[i / CHANNELS] / CHANNELS;
    for (int64_t i = size; i < whole(size); i++) shares[i] = 0;
    for (int64_t i = 0; i < size; i += WIDTH) {
      const V m = along(rows[0] + i, job.taps), n = along(rows[1] + i, job.taps);
      const V d = along(rows[2] + i, job.taps), q = along(rows[3] + i, job.taps);
      const V apart = squared(m - n), below = mad(m, m, n * n) + job.c1, l = 1.f - apart / below;
      // Rounding makes variances of flat windows negative.
      const V e = greater(d - apart, V{}), under = greater(2.f * (q - m * n) + e, V{}) + job.c2;
      const V s = 1.f - e / under;
      store(values + i, l * s);
      if (!job.pulls) continue;
      const V weight = load(shares + i);
      store(pulls[0] + i, 2.f * weight * (s * (n - m * l) / below + l * (m * s - n) / under));
      store(pulls[1] + i, -weight * l * s / under);
      store(pulls[2] + i, 2.f * weight * l * (1.f - s) / under);
    }
    float* map = job.map + row * (job.width - REACH) + begin / CHANNELS;
    for (int64_t i = 0; i < size; i += CHANNELS)
      map[i / CHANNELS] = (values[i] + values[i + 1] + values[i + 2]) / CHANNELS;
    if (!job.pulls) continue;
    for (int k = 0; k < PULLS; k++)
      std::memcpy(job.pulls + k * plane + (row + REACH) * padded + REACH * CHANNELS + begin, pulls[k],
                  size * sizeof(float));
  }
}

// The taps are symmetric, so what the windows pull at is blurred as the images were.
void pull_row(const Similarity& job, int64_t row) {
  const int64_t stride = job.width * CHANNELS;
  const int64_t padded = (job.width + REACH) * CHANNELS, plane = (job.height + REACH) * padded;
  float rows[PULLS][WIDE], values[BLOCK + WIDTH];
  for (int64_t begin = 0; begin < stride; begin += BLOCK) {
    const int64_t size = at_most(BLOCK, stride - begin), covered = size + REACH * CHANNELS;
    for (int k = 0; k < PULLS; k++)
      for (int64_t i = 0; i < whole(size) + REACH * CHANNELS; i += WIDTH) {
        V sum{};
        for (int t = 0; t < TAPS; t++) {
          const float* from = job.pulls + k * plane + (row + t) * padded + begin + i;
          sum = mad(load_some(from, covered - i), broadcast(job.taps[t]), sum);
        }
        store(rows[k] + i, sum);
      }
    const int64_t from = row * stride + begin;
    for (int64_t i = 0; i < size; i += WIDTH) {
      const V a = load_some(job.image + from + i, size - i), b = load_some(job.target + from + i, size - i);
      const V by_mean = along(rows[0] + i, job.taps), by_difference = along(rows[1] + i, job.taps);
      const V by_product = along(rows[2] + i, job.taps);
      store(values + i, by_mean + mad(2.f * (a - b), by_difference, b * by_product));
    }
    std::memcpy(job.gradient + from, values, size * sizeof(float));
  }
}

}  // namespace

extern const Comparer OF_ISA(comparer_, ISA) = {NAME(ISA), compare_row, pull_row};

}  // namespace jaxcloseup
