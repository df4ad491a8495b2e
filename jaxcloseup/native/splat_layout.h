// Layouts that the parts of the native compositor share; plain data, for every instruction set.
#pragma once

#include <cstdint>

namespace jaxcloseup {

constexpr int TILE = 4;               // side of a tile in pixels
constexpr int PIXELS = TILE * TILE;   // of a tile
constexpr int MOST_FEATURES = 54;     // values of a payload: all of a row in 64 sums

// First columns of a row of the table, as in `layout.py`.
enum Column { ANCHOR = 0, HOMOGRAPHY = 2, OPACITY = 11, LOW_PASS = 12, INVERSE_DEPTH = 13, PAYLOAD = 15 };
constexpr int MOMENTS = 4;  // channels behind the payload: z, 1, and two powers of 1 / z

// As published for 3-D Gaussian splatting; `splat_math.py` has the same.
constexpr float ALPHA_MIN = 1.f / 255, ALPHA_MAX = .99f, TRANSMITTANCE_MIN = 1e-4f;

// Sums over pixels of a splat's cotangents, in order: the three rows of the homography, each times
// 1, dx and dy; that of log(alpha); the payload's; and, from `offside` on, of what only pixels
// beside the disc's plane have: the low-pass times 1, dx and dy, and the clipped depth.
constexpr int SCALED = 9, PAYLOAD_SUMS = 10;
inline int offside_sums(int features) { return (PAYLOAD_SUMS + features + 15) / 16 * 16; }
inline int sums_stride(int features) { return offside_sums(features) + 16; }

// An image, and the splats that are blended into it.
struct Image {
  int width, height;   // pixels
  float near;          // z-depth before which nothing is drawn
  int count, columns;  // rows and columns of the table
  const float* table;  // [count, columns]
  const float* box;    // [count, 4] bounds x0, y0, x1, y1 in pixels
  const float* order;  // [count] depths that are not negative

  int tile_columns() const { return (width + TILE - 1) / TILE; }
  int tile_rows() const { return (height + TILE - 1) / TILE; }
  int features() const { return columns - PAYLOAD; }
};

// Numbers of tiles, the last included; empty where last < first.
struct Range {
  int16_t first, last;
};
constexpr int MOST_TILES = INT16_MAX;  // in a row or column

// Tiles with a center of a pixel in a splat's box.
struct TileBox {
  Range across, down;
};

// Rows of tiles whose splats are listed, nearest first.
struct Band {
  int width, height;   // of the image in pixels
  int columns;         // tiles in a row
  int first_row;       // number of the first row of tiles
  int rows;            // number of rows of tiles
  int features;        // values of a payload
  int stride;          // floats from one splat to the next
  float near;          // z-depth before which nothing is drawn
  const float* splats; // rows of the table of the band's splats
  const int32_t* list; // numbers of splats, tile after tile
  const int64_t* starts;  // where each tile's list starts, and the end
};

// Images of `height` x `width`, one behind the other.
struct Planes {
  float* sums;           // features + MOMENTS images
  float* median;
  float* transmittance;  // behind the last drawn splat
  int32_t* stop;         // position in a tile's list at which the pixel was finished
  float* reference;      // inverse depth of the first drawn splat
};

struct Cotangents {
  const float* sums;
  const float* median;
  const float* transmittance;  // of the forward pass, like `stop` and `reference`
  const int32_t* stop;
  const float* reference;
};

// The passes over all tiles of a band. `sums` has a row of `sums_stride` for each splat of the
// band, to which the derivative adds in the order of tiles.
using Forward = void (*)(const Band&, const Planes&);
using Backward = void (*)(const Band&, const Cotangents&, float* sums);

// Tiles of the boxes of splats `begin` to `end`; both ranges of an empty one are empty.
using FindTiles = void (*)(const Image&, int begin, int end, TileBox* boxes);

// Of `count` splats, in each row of tiles of its box, the tiles in which a splat draws. A splat's
// rows start at `starts` in `ranges`.
using FindReach = void (*)(const Image&, int count, const int32_t* splats, const TileBox* boxes,
                           const int64_t* starts, Range* ranges);

// The functions, compiled for one instruction set.
struct Passes {
  const char* name;
  FindTiles find_tiles;
  FindReach find_reach;
  Forward forward;
  Backward backward;
};
#if defined(__x86_64__)
extern const Passes passes_avx512, passes_avx2;
#endif
extern const Passes passes_baseline;

}  // namespace jaxcloseup
