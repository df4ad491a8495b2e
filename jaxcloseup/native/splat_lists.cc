#include "splat_lists.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

namespace jaxcloseup {
namespace {

constexpr int FEWEST_BANDS = 24;  // enough for several cores to end at the same time
constexpr double MARGIN = .01;    // pixels; with the factor below, more than rounding
constexpr double WIDER = 1.001;

struct Range {
  int first, last;  // empty where last < first

  bool empty() const { return last < first; }
};

// Numbers of tiles that hold centers of pixels between two bounds, of `size` pixels in all.
Range tiles_between(double low, double high, int size) {
  // Clipped before the cast: bounds may be infinite. NaN is an empty range.
  const double first = std::max(std::ceil(low - .5), 0.), last = std::min(std::floor(high - .5), size - 1.);
  if (!(first <= last)) return {0, -1};
  return {static_cast<int>(first) / TILE, static_cast<int>(last) / TILE};
}

// Where a splat is at least ALPHA_MIN: an ellipse about a center, or more than that.
//
// With the homography H, cutoff c and d = (1, q - anchor), it is where
// |(H[0].d, H[1].d)| <= c H[2].d, a quadratic form in q - anchor. See `tile_test.py`.
class Reach {
 public:
  Reach(const float* row, float near) : x_(row[ANCHOR]), y_(row[ANCHOR + 1]) {
    const double cutoff = WIDER * std::sqrt(2 * std::log(std::max(row[OPACITY] / double(ALPHA_MIN), 1.)));
    const float* h = row + HOMOGRAPHY;
    const auto form = [&](int i, int k) {
      return double(h[i]) * h[k] + double(h[3 + i]) * h[3 + k] - cutoff * cutoff * h[6 + i] * h[6 + k];
    };
    a_ = form(1, 1), b_ = form(1, 2), c_ = form(2, 2), d_ = form(0, 1), e_ = form(0, 2), f_ = form(0, 0);
    const double area = a_ * c_ - b_ * b_;
    // One that reaches the near plane, or whose image has no bound, is listed wherever its box is.
    unbounded_ = !(a_ > 0 && area > 0) || !(row[INVERSE_DEPTH + 1] * near < 1 / WIDER);
    if (!unbounded_) {
      const double center_x = (b_ * e_ - c_ * d_) / area;
      center_y_ = (b_ * d_ - a_ * e_) / area;
      const double depth = -(f_ + d_ * center_x + e_ * center_y_);
      empty_ = !(depth >= 0);
      half_y_ = std::sqrt(std::max(depth, 0.) * a_ / area);
      rightmost_ = -b_ / c_ * std::sqrt(std::max(depth, 0.) * c_ / area);
    }
    radius_ = cutoff / std::sqrt(double(row[LOW_PASS]));
  }

  // Bounds x0, x1 of the splat between two values of y.
  std::pair<double, double> between(double low, double high) const {
    low += -MARGIN - y_;
    high += MARGIN - y_;
    double x0 = INFINITY, x1 = -INFINITY;
    if (unbounded_) return {-INFINITY, INFINITY};
    const double from = std::max(low, center_y_ - half_y_), to = std::min(high, center_y_ + half_y_);
    if (!empty_ && from <= to) {
      // The set is convex, so its sides are farthest out as near to their extremes as can be.
      x0 = side(std::clamp(center_y_ - rightmost_, from, to), -1);
      x1 = side(std::clamp(center_y_ + rightmost_, from, to), 1);
    }
    // The low-pass: a circle about the anchor.
    const double off = std::clamp(0., low, high), squared = radius_ * radius_ - off * off;
    if (squared >= 0) {
      x0 = std::min(x0, -std::sqrt(squared));
      x1 = std::max(x1, std::sqrt(squared));
    }
    return {x_ + x0 - MARGIN, x_ + x1 + MARGIN};
  }

 private:
  double side(double y, int sign) const {
    const double slope = b_ * y + d_;
    const double root = slope * slope - a_ * (c_ * y * y + 2 * e_ * y + f_);
    return (-slope + sign * std::sqrt(std::max(root, 0.))) / a_;
  }

  double x_, y_, a_, b_, c_, d_, e_, f_, radius_;
  double center_y_ = 0, half_y_ = 0, rightmost_ = 0;
  bool unbounded_ = false, empty_ = false;
};

// Sorts indices by the bits of depths, which rise with depths that are not negative; stable.
void sort_by_depth(const float* order, std::vector<int32_t>& indices) {
  constexpr int BITS = 11, BINS = 1 << BITS;
  const size_t size = indices.size();
  std::vector<std::pair<uint32_t, int32_t>> from(size), to(size);
  std::vector<uint32_t> bins(3 * BINS);
  for (size_t i = 0; i < size; i++) {
    std::memcpy(&from[i].first, order + indices[i], sizeof(uint32_t));
    from[i].second = indices[i];
    for (int pass = 0; pass < 3; pass++) bins[pass * BINS + (from[i].first >> pass * BITS) % BINS]++;
  }
  for (int pass = 0; pass < 3; pass++) {
    uint32_t *begin = bins.data() + pass * BINS, total = 0;
    for (int bin = 0; bin < BINS; bin++) total += std::exchange(begin[bin], total);
    for (const auto& pair : from) to[begin[(pair.first >> pass * BITS) % BINS]++] = pair;
    from.swap(to);
  }
  for (size_t i = 0; i < size; i++) indices[i] = from[i].second;
}

}  // namespace

Bands::Bands(const Scene& scene) {
  const int rows = scene.tile_rows();
  rows_each = std::clamp(rows / FEWEST_BANDS, 1, 4);
  count = (rows + rows_each - 1) / rows_each;
  for (int i = 0; i < scene.count; i++) {
    const float* box = scene.box + 4L * i;
    if (!tiles_between(box[1], box[3], scene.height).empty() && !tiles_between(box[0], box[2], scene.width).empty())
      splats.push_back(i);
  }
  sort_by_depth(scene.order, splats);
  first.resize(splats.size());
  slots.resize(splats.size() + 1);
  starts.resize(count + 1);
  std::vector<int32_t> last(splats.size());
  for (size_t i = 0; i < splats.size(); i++) {
    const float* box = scene.box + 4L * splats[i];
    const Range tiles = tiles_between(box[1], box[3], scene.height);
    first[i] = tiles.first / rows_each;
    last[i] = tiles.last / rows_each;
    slots[i + 1] = slots[i] + last[i] - first[i] + 1;
    for (int band = first[i]; band <= last[i]; band++) starts[band + 1]++;
  }
  for (int band = 0; band < count; band++) starts[band + 1] += starts[band];
  entries.resize(slots.back());
  members.resize(slots.back());
  std::vector<int32_t> next(starts.begin(), starts.end() - 1);
  for (size_t i = 0; i < splats.size(); i++) {
    for (int band = first[i]; band <= last[i]; band++) {
      const int place = next[band]++;
      entries[slots[i] + band - first[i]] = place;
      members[place] = splats[i];
    }
  }
}

BandLists::BandLists(const Scene& scene, const Bands& bands, int number) {
  const int first_row = number * bands.rows_each;
  const int band_rows = std::min(bands.rows_each, scene.tile_rows() - first_row);
  const int columns = scene.tile_columns(), begin = bands.starts[number];
  const int size = bands.starts[number + 1] - begin;
  rows.resize(static_cast<size_t>(size) * scene.columns);
  starts.assign(band_rows * columns + 1, 0);
  std::vector<Range> ranges(static_cast<size_t>(size) * band_rows, Range{0, -1});
  for (int i = 0; i < size; i++) {
    const int splat = bands.members[begin + i];
    float* row = rows.data() + static_cast<size_t>(i) * scene.columns;
    std::memcpy(row, scene.table + static_cast<size_t>(splat) * scene.columns, scene.columns * sizeof(float));
    if (!(row[OPACITY] >= ALPHA_MIN)) continue;
    const float* box = scene.box + 4L * splat;
    const Range down = tiles_between(box[1], box[3], scene.height);
    const Reach reach(row, scene.near);
    for (int r = std::max(down.first - first_row, 0); r <= std::min(down.last - first_row, band_rows - 1); r++) {
      const double top = (first_row + r) * TILE + .5;
      const auto [x0, x1] = reach.between(top, top + TILE - 1);
      const Range across = tiles_between(std::max<double>(x0, box[0]), std::min<double>(x1, box[2]), scene.width);
      ranges[static_cast<size_t>(i) * band_rows + r] = across;
      for (int tile = across.first; tile <= across.last; tile++) starts[r * columns + tile + 1]++;
    }
  }
  for (int tile = 0; tile < band_rows * columns; tile++) starts[tile + 1] += starts[tile];
  list.resize(starts.back());
  std::vector<int32_t> next(starts.begin(), starts.end() - 1);
  for (int i = 0; i < size; i++) {
    for (int r = 0; r < band_rows; r++) {
      const Range across = ranges[static_cast<size_t>(i) * band_rows + r];
      for (int tile = across.first; tile <= across.last; tile++) list[next[r * columns + tile]++] = i;
    }
  }
  band = {scene.width, scene.height, columns, first_row, band_rows, scene.columns - PAYLOAD,
          scene.columns, scene.near, rows.data(), list.data(), starts.data()};
}

}  // namespace jaxcloseup
