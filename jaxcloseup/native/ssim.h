// What SSIM shares between the file that XLA calls and those compiled for each processor.
#pragma once

#include <cstddef>
#include <cstdint>

namespace jaxcloseup {

constexpr int TAPS = 11, REACH = TAPS - 1;
constexpr int CHANNELS = 3;
constexpr int PULLS = 3;  // blurred images that the pixels of `image` move, see `compare_row`

// Two images of height x width pixels, and their windows, each named by its first pixel: see
// `metrics/similarity.py`.
struct Similarity {
  int64_t height, width;
  const float* image;   // [height, width, 3]
  const float* target;  // [height, width, 3]
  const float* share;   // [height - 10, width - 10]
  float taps[TAPS];
  float c1, c2;
  float* map;  // [height - 10, width - 10]
  // Where the derivative is wanted; else null.
  float* pulls;     // [3, height + 10, width + 10, 3], 0 in a border of 10 pixels
  float* gradient;  // [height, width, 3]
};

struct Comparer {
  const char* isa;
  void (*compare_row)(const Similarity&, int64_t row);  // of the map
  void (*pull_row)(const Similarity&, int64_t row);     // of the gradient
};
extern const Comparer comparer_baseline, comparer_avx2, comparer_avx512;

}  // namespace jaxcloseup
