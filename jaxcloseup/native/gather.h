// What gathering shares between the file that XLA calls and those compiled for each processor.
//
// A block is up to 64 neighboring points of a view: photographs that cannot see any of them are left
// out together, and the values that the others show there lie together in memory.
#pragma once

#include <cstddef>
#include <cstdint>

namespace jaxcloseup {

constexpr int BLOCK = 64;
constexpr int LANES = 8;  // channels that are read at once
constexpr int MOST_PARTS = 4;  // of a pyramid's channels
constexpr int MOST_CHANNELS = 512;
constexpr int MOST_LEVELS = 16;
constexpr float WIDEST = 20;    // angles in units of `angle_scale`, beyond which all weigh alike
constexpr float COARSEST = 64;  // footprints beyond which all weigh alike
// Photographs that weigh less than this share of all weights at a point are not read there: they
// would change the mean by less than float32 rounds.
constexpr float NEGLIGIBLE = 1e-7f;

enum class Kind { INT8, UINT8, FLOAT };

// See `GatherSettings`.
struct Settings {
  float tolerance, angle_scale, finer, robust;
};

// Two neighboring levels of a pyramid, the finer one first: (x, y) of each.
struct LevelPair {
  float focal[4], center[4], most[4];  // `most` is the last pixel
  int32_t start[2], width[2];  // in pixels of all photographs
};

struct Photograph {
  float rotation[9], position[3];  // camera to world, row by row
  float focal[2], center[2];       // of its depth map
  float lengths[4];                // of the normals of the planes through the image's edges
  float log_focal;                 // log2 of the mean focal length of the finest level
  float footprint;                 // 1 / the mean focal length of the finest level that is read
  float coarseness[MOST_LEVELS];   // see `Pyramid.coarseness`
};

struct Job {
  int photographs, exclude, width, height;  // size of the depth maps
  const Photograph* photograph;
  // Inverse depth and trust, interleaved, of maps whose borders are repeated once on each side.
  const float* maps;
  int levels, finest;
  const LevelPair* pairs;  // [photographs, levels]
  Kind kind;
  const void* values;  // [pixels, channels]
  int64_t pixels;      // of all photographs
  int channels, parts;
  Settings settings[MOST_PARTS];

  size_t map_size() const { return 2 * size_t(width + 2) * (height + 2); }
  int part_channels() const { return channels / parts; }
  int vectors() const { return (channels + LANES - 1) / LANES; }
};

// Points of a block; those behind `count` have side 0.
struct Points {
  int count;
  float at[3][BLOCK];   // world units
  float ray[3][BLOCK];  // unit vectors from the view
  float side[BLOCK];    // of the view's pixel, 0 where undefined
  float center[3], radius;
};

// Sums of one part over photographs, then the fields of `Gathered`.
struct PartSums {
  float weight[BLOCK], variance[BLOCK], count[BLOCK], footprint[BLOCK], detail[BLOCK], angle[BLOCK];
};

// What one photograph shows of a block.
struct Record {
  int photograph;
  float ray[2][BLOCK];  // x / z and y / z in its frame
  float size[BLOCK];    // log2 of the footprint of its finest pixel
  float weight[MOST_PARTS][BLOCK];
};

// Memory of one thread.
struct Workspace {
  Record* records;  // [photographs]
  PartSums parts[MOST_PARTS];
  // [BLOCK, vectors, LANES] sums over photographs, then means in `values`.
  float *values, *squares, *robust;
  float robust_weight[MOST_PARTS][BLOCK];
};

struct Gatherer {
  const char* isa;
  void (*gather)(const Job&, const Points&, Workspace&);
};
extern const Gatherer gatherer_baseline, gatherer_avx2, gatherer_avx512;

}  // namespace jaxcloseup
