// Weighted sums of rows of a table, and their derivative, as functions that XLA calls: features
// between the vertices of grids. The rows of a grid lie together, and those of another grid elsewhere,
// so grids are shared out over threads and every sum has one order.
#include <algorithm>
#include <type_traits>
#include <vector>

#include "parallel.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Integers = ffi::Buffer<ffi::S32>;

constexpr int64_t BLOCK = 2048;  // positions that a thread takes at once

// One grid of one batch: `table` is its features or their derivative, `between` the features of the
// positions between its vertices, `[features, positions]`, or their cotangents.
template <typename Table, typename Between>
struct Grid {
  Table* table;  // first of all rows of the batch
  int32_t first, last;  // row
  int64_t features, corners, corner_stride, positions;
  const int32_t* rows;  // [corners, positions] of this grid
  const float* weights;
  Between* between;

  // A row that is none of this grid's is taken for its nearest.
  Table* row(int64_t corner, int64_t i) const {
    return table + std::clamp(rows[corner * corner_stride + i], first, last) * features;
  }
  float weight(int64_t corner, int64_t i) const { return weights[corner * corner_stride + i]; }
};

// Calls work with the number of features as a constant, piece after piece, the largest first.
template <typename Work>
void by_pieces(int64_t features, const Work& work) {
  int64_t at = 0;
  for (; features - at >= 8; at += 8) work(std::integral_constant<int, 8>(), at);
  for (; features - at >= 2; at += 2) work(std::integral_constant<int, 2>(), at);
  if (at < features) work(std::integral_constant<int, 1>(), at);
}

void sum_rows(const Grid<const float, float>& grid, int64_t begin, int64_t end) {
  by_pieces(grid.features, [&](auto constant, int64_t at) {
    constexpr int COUNT = decltype(constant)::value;
    for (int64_t i = begin; i < end; i++) {
      float sum[COUNT] = {};
      for (int64_t c = 0; c < grid.corners; c++) {
        const float* row = grid.row(c, i) + at;
        const float weight = grid.weight(c, i);
        for (int k = 0; k < COUNT; k++) sum[k] += weight * row[k];
      }
      for (int k = 0; k < COUNT; k++) grid.between[(at + k) * grid.positions + i] = sum[k];
    }
  });
}

void add_to_rows(const Grid<float, const float>& grid) {
  std::fill(grid.table + grid.first * grid.features, grid.table + (grid.last + 1) * grid.features, 0.f);
  by_pieces(grid.features, [&](auto constant, int64_t at) {
    constexpr int COUNT = decltype(constant)::value;
    for (int64_t i = 0; i < grid.positions; i++) {
      float each[COUNT];
      for (int k = 0; k < COUNT; k++) each[k] = grid.between[(at + k) * grid.positions + i];
      for (int64_t c = 0; c < grid.corners; c++) {
        float* row = grid.row(c, i) + at;
        const float weight = grid.weight(c, i);
        for (int k = 0; k < COUNT; k++) row[k] += weight * each[k];
      }
    }
  });
}

// Sizes of all arguments, which may have further dimensions before those that are named here.
struct Sizes {
  int64_t batches, entries, features, corners, levels, positions;
  std::vector<int64_t> starts;  // first row of each grid, and the end

  template <typename Table, typename Between>
  Grid<Table, Between> grid(int64_t batch, int64_t level, Table* table, const int32_t* rows, const float* weights,
                            Between* between) const {
    const int64_t at = batch * corners * levels * positions + level * positions;
    return {table + batch * entries * features,
            int32_t(starts[level]),
            int32_t(starts[level + 1] - 1),
            features,
            corners,
            levels * positions,
            positions,
            rows + at,
            weights + at,
            between + (batch * levels + level) * features * positions};
  }
};

// `table` is [.., E, F], `rows` and `weights` [.., C, L, M], `between` [.., L, F, M].
template <typename Table, typename Between>
ffi::Error read_sizes(const Table& table, const Integers& rows, const Floats& weights, const Between& between,
                      ffi::Span<const int64_t> of_grids, Sizes& sizes) {
  const auto t = table.dimensions(), r = rows.dimensions();
  if (t.size() < 2 || r.size() != t.size() + 1) return ffi::Error::InvalidArgument("arguments have other dimensions");
  sizes.entries = t[t.size() - 2], sizes.features = t[t.size() - 1];
  sizes.corners = r[r.size() - 3], sizes.levels = r[r.size() - 2], sizes.positions = r[r.size() - 1];
  sizes.batches = 1;
  for (size_t i = 0; i + 2 < t.size(); i++) sizes.batches *= t[i];
  sizes.starts = {0};
  for (const int64_t size : of_grids) {
    if (size < 1) return ffi::Error::InvalidArgument("each grid must have a row");
    sizes.starts.push_back(sizes.starts.back() + size);
  }
  const int64_t positions = sizes.batches * sizes.levels * sizes.positions;
  if (int64_t(of_grids.size()) != sizes.levels || sizes.starts.back() != sizes.entries || sizes.entries > INT32_MAX ||
      int64_t(rows.element_count()) != sizes.corners * positions ||
      weights.element_count() != rows.element_count() || int64_t(between.element_count()) != sizes.features * positions)
    return ffi::Error::InvalidArgument("arguments have different sizes");
  return ffi::Error::Success();
}

ffi::Error rows_sum(ffi::ThreadPool pool, Floats table, Integers rows, Floats weights, ffi::Result<Floats> between,
                    ffi::Span<const int64_t> of_grids) {
  Sizes sizes;
  if (auto error = read_sizes(table, rows, weights, *between, of_grids, sizes); error.failure()) return error;
  const int64_t blocks = (sizes.positions + BLOCK - 1) / BLOCK, grids = sizes.batches * sizes.levels;
  parallel_for(pool, int(grids * blocks), [&](int i) {
    const int64_t grid = i / blocks, begin = i % blocks * BLOCK;
    const auto one = sizes.grid<const float, float>(grid / sizes.levels, grid % sizes.levels, table.typed_data(),
                                                    rows.typed_data(), weights.typed_data(), between->typed_data());
    sum_rows(one, begin, std::min(begin + BLOCK, sizes.positions));
  });
  return ffi::Error::Success();
}

ffi::Error rows_add(ffi::ThreadPool pool, Integers rows, Floats weights, Floats between, ffi::Result<Floats> table,
                    ffi::Span<const int64_t> of_grids) {
  Sizes sizes;
  if (auto error = read_sizes(*table, rows, weights, between, of_grids, sizes); error.failure()) return error;
  parallel_for(pool, int(sizes.batches * sizes.levels), [&](int i) {
    add_to_rows(sizes.grid<float, const float>(i / sizes.levels, i % sizes.levels, table->typed_data(),
                                               rows.typed_data(), weights.typed_data(), between.typed_data()));
  });
  return ffi::Error::Success();
}

}  // namespace
}  // namespace jaxcloseup

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(rows_sum, jaxcloseup::rows_sum,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Attr<xla::ffi::Span<const int64_t>>("of_grids"));

XLA_FFI_DEFINE_HANDLER_SYMBOL(rows_add, jaxcloseup::rows_add,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<jaxcloseup::Integers>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Arg<jaxcloseup::Floats>()
                                  .Ret<jaxcloseup::Floats>()
                                  .Attr<xla::ffi::Span<const int64_t>>("of_grids"));

#pragma GCC visibility pop
