// Lists of the splats that draw in each tile, nearest first.
#pragma once

#include <cstdint>
#include <vector>

#include "splat_layout.h"

namespace jaxcloseup {

// An image, and the splats that are blended into it.
struct Scene {
  int width, height;   // pixels
  float near;          // z-depth before which nothing is drawn
  int count, columns;  // rows and columns of the table
  const float* table;  // [count, columns]
  const float* box;    // [count, 4] bounds x0, y0, x1, y1 in pixels
  const float* order;  // [count] depths that are not negative

  int tile_columns() const { return (width + TILE - 1) / TILE; }
  int tile_rows() const { return (height + TILE - 1) / TILE; }
};

// Splats that show, sorted by depth and dealt out to bands of rows of tiles. The image's size alone
// determines the bands, so that every sum has one order on any number of threads.
struct Bands {
  int rows_each, count;
  std::vector<int32_t> splats;  // [S] indices, nearest first, of equal ones by index
  std::vector<int32_t> first;   // [S] first band of each
  std::vector<int32_t> slots;   // [S + 1] where the slots of each splat start in `entries`
  std::vector<int32_t> entries; // places of splats in bands, a splat's bands one behind the other
  std::vector<int32_t> starts;  // [count + 1] where each band starts in `members`
  std::vector<int32_t> members; // indices of splats, band after band

  explicit Bands(const Scene& scene);
};

// The rows of a band's splats, and its tiles' lists.
struct BandLists {
  Band band;
  std::vector<float> rows;
  std::vector<int32_t> list, starts;

  BandLists(const Scene& scene, const Bands& bands, int number);
};

}  // namespace jaxcloseup
