#include "splat_lists.h"

#include <algorithm>
#include <cstring>
#include <utility>

namespace jaxcloseup {
namespace {

constexpr int FEWEST_BANDS = 24;  // enough for several cores to end at the same time
constexpr int PIECE = 2048;       // splats that a thread takes at once

// Sorts indices by the bits of depths, which rise with depths that are not negative; stable.
void sort_by_depth(const float* order, std::vector<int32_t>& indices) {
  constexpr int BITS = 11, BINS = 1 << BITS;
  struct Key {
    uint32_t depth;
    int32_t index;
  };
  const size_t size = indices.size();
  std::vector<Key> from(size), to(size);
  std::vector<uint32_t> bins(3 * BINS);
  for (size_t i = 0; i < size; i++) {
    const float depth = order[indices[i]] + 0.f;  // turns -0 into 0
    std::memcpy(&from[i].depth, &depth, sizeof depth);
    from[i].index = indices[i];
    for (int pass = 0; pass < 3; pass++) bins[pass * BINS + (from[i].depth >> pass * BITS) % BINS]++;
  }
  for (int pass = 0; pass < 3; pass++) {
    uint32_t *begin = bins.data() + pass * BINS, total = 0;
    for (int bin = 0; bin < BINS; bin++) total += std::exchange(begin[bin], total);
    for (const Key& key : from) to[begin[(key.depth >> pass * BITS) % BINS]++] = key;
    from.swap(to);
  }
  for (size_t i = 0; i < size; i++) indices[i] = from[i].index;
}

int pieces(size_t size) { return static_cast<int>((size + PIECE - 1) / PIECE); }

}  // namespace

Listing::Listing(xla::ffi::ThreadPool& pool, const Passes& passes, const Image& image) : boxes(image.count) {
  rows_each = std::clamp(image.tile_rows() / FEWEST_BANDS, 1, 4);
  bands = (image.tile_rows() + rows_each - 1) / rows_each;
  parallel_for(pool, pieces(image.count), [&](int piece) {
    passes.find_tiles(image, piece * PIECE, std::min(image.count, (piece + 1) * PIECE), boxes.data());
  });
  for (int i = 0; i < image.count; i++)
    if (boxes[i].down.first <= boxes[i].down.last) splats.push_back(i);
  sort_by_depth(image.order, splats);
  starts.resize(splats.size() + 1);
  down.resize(splats.size());
  for (size_t i = 0; i < splats.size(); i++) {
    down[i] = boxes[splats[i]].down;
    starts[i + 1] = starts[i] + down[i].last - down[i].first + 1;
  }
  deal_out();
  ranges.resize(starts.back());
  parallel_for(pool, pieces(splats.size()), [&](int piece) {
    const int begin = piece * PIECE, count = std::min<int>(splats.size() - begin, PIECE);
    passes.find_reach(image, count, splats.data() + begin, boxes.data(), starts.data() + begin, ranges.data());
  });
}

void Listing::deal_out() {
  band_starts.resize(bands + 1);
  for (size_t i = 0; i < splats.size(); i++) {
    const Range own = bands_of(i);
    for (int band = own.first; band <= own.last; band++) band_starts[band + 1]++;
  }
  for (int band = 0; band < bands; band++) band_starts[band + 1] += band_starts[band];
  members.resize(band_starts.back());
  places.resize(starts.back());
  std::vector<int64_t> next(band_starts.begin(), band_starts.end() - 1);
  for (size_t i = 0; i < splats.size(); i++) {
    const Range own = bands_of(i);
    for (int band = own.first; band <= own.last; band++) {
      const int64_t place = next[band]++;
      members[place] = static_cast<int32_t>(i);
      places[starts[i] + band - own.first] = static_cast<int32_t>(place - band_starts[band]);
    }
  }
}

void BandLists::make(const Image& image, const Listing& listing, int number) {
  const int first_row = number * listing.rows_each;
  const int band_rows = std::min(listing.rows_each, image.tile_rows() - first_row);
  const int columns = image.tile_columns(), tiles = band_rows * columns;
  const int32_t* members = listing.members.data() + listing.band_starts[number];
  const size_t count = listing.band_starts[number + 1] - listing.band_starts[number];
  starts.assign(tiles + 1, 0);
  // Calls work(member, row of the band, tiles) for all rows of the band's splats.
  const auto each_row = [&](const auto& work) {
    for (size_t k = 0; k < count; k++) {
      const int i = members[k];
      if (k + 16 < count) __builtin_prefetch(listing.ranges.data() + listing.starts[members[k + 16]]);
      const Range down = listing.down[i];
      const Range* ranges = listing.ranges.data() + listing.starts[i];
      const int last = std::min<int>(down.last, first_row + band_rows - 1);
      for (int row = std::max<int>(down.first, first_row); row <= last; row++)
        work(static_cast<int>(k), row - first_row, ranges[row - down.first]);
    }
  };
  // By how much each tile's list is longer than that of the tile before it, for now in `next`.
  next.assign(tiles + 1, 0);
  each_row([&](int, int row, Range range) {
    if (range.first > range.last) return;
    next[row * columns + range.first]++;
    next[row * columns + range.last + 1]--;
  });
  int64_t length = 0;
  for (int tile = 0; tile < tiles; tile++) starts[tile + 1] = starts[tile] + (length += next[tile]);
  list.resize(starts.back());
  next.assign(starts.begin(), starts.end() - 1);
  each_row([&](int member, int row, Range range) {
    for (int tile = range.first; tile <= range.last; tile++) list[next[row * columns + tile]++] = member;
  });
  const size_t size = image.columns;
  rows.resize(count * size);
  for (size_t k = 0; k < count; k++) {
    const auto row_of = [&](size_t member) { return image.table + listing.splats[members[member]] * size; };
    if (k + 8 < count) {
      __builtin_prefetch(row_of(k + 8));
      __builtin_prefetch(row_of(k + 8) + 16);
    }
    std::memcpy(rows.data() + k * size, row_of(k), size * sizeof(float));
  }
  band = {image.width,   image.height, columns,     first_row,    band_rows, image.features(),
          image.columns, image.near,   rows.data(), list.data(), starts.data()};
}

}  // namespace jaxcloseup
