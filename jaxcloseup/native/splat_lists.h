// Lists of the splats that draw in each tile, nearest first.
#pragma once

#include <cstdint>
#include <vector>

#include "parallel.h"
#include "splat_layout.h"

namespace jaxcloseup {

// Splats that show, nearest first, and the tiles of each. An image is cut into bands of rows of
// tiles, by its size alone, so that every sum has one order on any number of threads.
struct Listing {
  int rows_each, bands;
  std::vector<TileBox> boxes;    // [N]
  std::vector<int32_t> splats;   // [S] indices, of equal depth by index
  std::vector<int64_t> starts;   // [S + 1] where the rows of each start in `ranges`
  std::vector<Range> ranges;     // tiles in which a splat draws, for each row of its box
  std::vector<Range> down;       // [S] rows of tiles of each
  std::vector<int64_t> band_starts;  // [bands + 1] where each band starts in `members`
  std::vector<int32_t> members;  // numbers of splats in `splats`, band after band
  // Place of each splat in its bands' members, at `starts`, one band behind the other.
  std::vector<int32_t> places;

  Listing(xla::ffi::ThreadPool& pool, const Passes& passes, const Image& image);

  // First and last band of a splat.
  Range bands_of(size_t i) const {
    return {static_cast<int16_t>(down[i].first / rows_each), static_cast<int16_t>(down[i].last / rows_each)};
  }

 private:
  void deal_out();
};

// The rows of a band's splats, and its tiles' lists. Its arrays are used again for the next band.
struct BandLists {
  Band band;
  std::vector<float> rows;
  std::vector<int32_t> list;
  std::vector<int64_t> starts, next;

  void make(const Image& image, const Listing& listing, int number);
};

}  // namespace jaxcloseup
