#include "splat_blend.h"

#include <cstring>
#include <memory>

#include "processor.h"

namespace jaxcloseup {

const Passes& best_passes() { return OF_THIS_PROCESSOR(passes); }

namespace {

// Cotangents of a row of the table from sums over all pixels, see `splat_math.row_bar`.
void row_bar(const float* row, const float* sums, int features, float* bar) {
  const float *low = sums + offside_sums(features), *h = row + HOMOGRAPHY;
  for (int axis = 0; axis < 2; axis++) {
    float moved = row[LOW_PASS] * low[1 + axis];
    for (int i = 0; i < 3; i++) moved -= sums[3 * i] * h[3 * i + 1 + axis];
    bar[ANCHOR + axis] = moved;
  }
  std::memcpy(bar + HOMOGRAPHY, sums, 9 * sizeof(float));
  // A clipped depth moves with the anchor's depth.
  if (h[6] * h[6] != 0) bar[HOMOGRAPHY + 6] += low[3] / (h[6] * h[6]);
  bar[OPACITY] = row[OPACITY] != 0 ? sums[SCALED] / row[OPACITY] : 0;
  for (int i = LOW_PASS; i < PAYLOAD; i++) bar[i] = 0;
  std::memcpy(bar + PAYLOAD, sums + PAYLOAD_SUMS, features * sizeof(float));
}

// Sums over the pixels of one band, for each of its splats.
using BandSums = std::unique_ptr<float[]>;

}  // namespace

void blend(xla::ffi::ThreadPool& pool, const Image& image, const Planes& out) {
  const Passes& passes = best_passes();
  const Listing listing(pool, passes, image);
  parallel_for_with<BandLists>(pool, listing.bands, [&](BandLists& lists, int band) {
    lists.make(image, listing, band);
    passes.forward(lists.band, out);
  });
}

void pull_back(xla::ffi::ThreadPool& pool, const Image& image, const Listing& listing, const Cotangents& in, float* table_bar) {
  const Passes& passes = best_passes();
  const int features = image.features(), stride = sums_stride(features);
  std::vector<BandSums> sums(listing.bands);
  parallel_for_with<BandLists>(pool, listing.bands, [&](BandLists& lists, int band) {
    lists.make(image, listing, band);
    const size_t size = static_cast<size_t>(listing.band_starts[band + 1] - listing.band_starts[band]) * stride;
    sums[band].reset(new float[size]);
    std::memset(sums[band].get(), 0, size * sizeof(float));
    passes.backward(lists.band, in, sums[band].get());
  });
  // One order of sums: along a tile's list, then over tiles, then over bands.
  const int shown = static_cast<int>(listing.splats.size()), each = 1024;
  parallel_for_with<std::vector<float>>(pool, (shown + each - 1) / each, [&](std::vector<float>& total, int part) {
    for (int i = part * each; i < std::min(shown, (part + 1) * each); i++) {
      total.assign(stride, 0.f);
      const Range bands = listing.bands_of(i);
      for (int band = bands.first; band <= bands.last; band++) {
        const float* own = sums[band].get() + static_cast<size_t>(listing.places[listing.starts[i] + band - bands.first]) * stride;
        for (int f = 0; f < stride; f++) total[f] += own[f];
      }
      const size_t place = static_cast<size_t>(listing.splats[i]) * image.columns;
      row_bar(image.table + place, total.data(), features, table_bar + place);
    }
  });
}

}  // namespace jaxcloseup
