// What matching patches shares between the file that XLA calls and those compiled for each processor.
#pragma once

#include <cstddef>
#include <cstdint>

namespace jaxcloseup {

constexpr int MOST_NEIGHBORS = 32;
constexpr int MOST_SAMPLES = 13;  // along a side of a patch

// One photograph, its neighbors and planes at each of its pixels: see `stereo/matching.py`.
struct Match {
  int photographs, height, width, planes, neighbors, best;
  // Four pixels' grays each, from the lowest byte: at (x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1).
  const uint32_t* quads;  // [photographs, height, width]
  const float* weight;    // [photographs, height, width]
  int reference;
  const int32_t* neighbor;  // [neighbors]
  const float* transforms;  // [neighbors, 3, 4]
  const float* plane;       // [planes, 3, height, width]
  int radius, stride;
  float gray_scale, pixel_scale, noise;
  float* cost;  // [planes, height, width]
};

struct Matcher {
  const char* isa;
  void (*match_row)(const Match&, int row);
};
extern const Matcher matcher_baseline, matcher_avx2, matcher_avx512;

}  // namespace jaxcloseup
