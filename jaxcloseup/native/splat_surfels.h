// Surfels and cameras as the parts that project them share them; plain data.
#pragma once

#include "splat_layout.h"

namespace jaxcloseup {

constexpr int FEATURES = 6;          // of a surfel's payload: color, and normal
constexpr int COLUMNS = PAYLOAD + FEATURES;
constexpr int MOST_HARMONICS = 16;   // to degree 3
constexpr int CAMERA = 16;           // numbers of a camera: camtoworld, intrinsics

struct Surfels {
  int count, harmonics;
  const float *means, *log_scales, *quaternions;  // [N, 3], [N, 2], [N, 4]
  const float *opacity, *sh;                      // [N], [N, harmonics, 3]
};

struct View {
  int width, height;
  float near;
  bool antialias;
  const float *camtoworld, *intrinsics;  // [3, 4], [4]
};

// Tables, boxes and orders of surfels, as `Image` takes them. Rows of surfels that do not show are
// not written, and their boxes are empty.
struct Projected {
  float *table, *box, *order;
};

struct SurfelBars {
  float *means, *log_scales, *quaternions, *opacity, *sh;
};

// Project the surfels `begin` to `end`.
using Project = void (*)(const Surfels&, const View&, int begin, int end, const Projected&);

// Pull the cotangents of rows of the table back to surfels; those of surfels that do not show
// become 0. Adds the camera's, if `camera_bar` is not null.
using PullBack = void (*)(const Surfels&, const View&, int begin, int end, const float* table_bar, const float* box,
                          const SurfelBars&, float* camera_bar);

struct Projection {
  Project project;
  PullBack pull_back;
};
#if defined(__x86_64__)
extern const Projection projection_avx512, projection_avx2;
#endif
extern const Projection projection_baseline;

}  // namespace jaxcloseup
