// Hash encoding and its derivative as functions that XLA calls, see `fields/volume/hash_grid.py`.
//
// Rows of the table and weights of corners are never arrays: they take longer to write and to read
// than to compute. Levels share no rows, so they are shared out over threads, and every sum has one
// order.
#include <algorithm>
#include <cstring>
#include <type_traits>
#include <vector>

#include "parallel.h"
#include "xla/ffi/api/ffi.h"

namespace jaxcloseup {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;

constexpr int64_t BLOCK = 1024;  // positions that a thread takes at once
constexpr uint32_t PRIMES[2] = {2654435761u, 805459861u};
constexpr int64_t MOST_CELLS = 1 << 20;  // along a side

// A level of a grid: what tells which row of the table a vertex has.
struct Level {
  int64_t start, rows;  // in the table
  uint32_t cells;       // along each side
  bool in_order;        // else vertices share rows by a hash, and there is a power of two of them
};

// Rows of the corners of a position's cell, and their weights; the last coordinate changes first.
struct Corners {
  uint32_t row[8];
  float weight[8];
};

template <bool IN_ORDER>
inline Corners corners_of(const Level& level, const float* positions, int64_t count, int64_t i) {
  const uint32_t side = level.cells + 1, mask = uint32_t(level.rows - 1);
  const uint32_t factors[3] = {1, IN_ORDER ? side : PRIMES[0], IN_ORDER ? side * side : PRIMES[1]};
  uint32_t part[3][2];
  float share[3][2];
  for (int k = 0; k < 3; k++) {
    const float at = float(level.cells) * std::clamp(positions[k * count + i], 0.f, 1.f);
    // The lowest cell too if it is no number.
    const uint32_t low = at > 0 ? std::min(uint32_t(int32_t(at)), level.cells - 1) : 0;
    part[k][0] = low * factors[k];
    part[k][1] = part[k][0] + factors[k];
    share[k][1] = at - float(low);
    share[k][0] = 1 - share[k][1];
  }
  Corners corners;
  for (int x = 0; x < 2; x++)
    for (int y = 0; y < 2; y++) {
      const uint32_t both = IN_ORDER ? part[0][x] + part[1][y] : part[0][x] ^ part[1][y];
      const float weight = share[0][x] * share[1][y];
      for (int z = 0; z < 2; z++) {
        corners.row[4 * x + 2 * y + z] = IN_ORDER ? both + part[2][z] : (both ^ part[2][z]) & mask;
        corners.weight[4 * x + 2 * y + z] = weight * share[2][z];
      }
    }
  return corners;
}

struct Sizes {
  int64_t features, positions;
  std::vector<Level> levels;
};

// Neighboring features of a row, as one vector.
template <int COUNT>
struct Values {
  typedef float Vector __attribute__((vector_size(4 * COUNT)));
  Vector values;

  static Values read(const float* from) {
    Values read;
    std::memcpy(&read, from, sizeof(Values));
    return read;
  }
  void write(float* to) const { std::memcpy(to, this, sizeof(Values)); }
};

// Calls work with the number of features and the kind of level as constants, piece after piece.
template <typename Work>
void by_pieces(int64_t features, const Level& level, const Work& work) {
  const auto piece = [&](auto count, int64_t at) {
    level.in_order ? work(count, std::true_type(), at) : work(count, std::false_type(), at);
  };
  int64_t at = 0;
  for (; features - at >= 4; at += 4) piece(std::integral_constant<int, 4>(), at);
  for (; features - at >= 2; at += 2) piece(std::integral_constant<int, 2>(), at);
  if (at < features) piece(std::integral_constant<int, 1>(), at);
}

// `table` is [E, F], `positions` [3, M], `features` [L, F, M].
template <typename Table, typename Features>
ffi::Error read_sizes(const Table& table, const Floats& positions, const Features& features,
                      ffi::Span<const int64_t> cells, ffi::Span<const int64_t> rows, Sizes& sizes) {
  const auto t = table.dimensions(), p = positions.dimensions();
  if (t.size() != 2 || p.size() != 2 || p[0] != 3)
    return ffi::Error::InvalidArgument("the table must be [E, F] and positions [3, M]");
  sizes.features = t[1], sizes.positions = p[1];
  if (cells.size() != rows.size()) return ffi::Error::InvalidArgument("levels have no such sizes");
  int64_t start = 0;
  for (size_t i = 0; i < cells.size(); i++) {
    if (cells[i] < 1 || cells[i] > MOST_CELLS || rows[i] < 1 || rows[i] > (1 << 30))
      return ffi::Error::InvalidArgument("a level has no such size");
    const int64_t side = cells[i] + 1, vertices = side * side * side;
    const bool in_order = vertices == rows[i];
    if (!in_order && (rows[i] & (rows[i] - 1)))
      return ffi::Error::InvalidArgument("rows of a level must be its vertices, or a power of two");
    sizes.levels.push_back({start, rows[i], uint32_t(cells[i]), in_order});
    start += rows[i];
  }
  if (start != t[0] ||
      features.element_count() != sizes.levels.size() * size_t(sizes.features) * size_t(sizes.positions))
    return ffi::Error::InvalidArgument("arguments have different sizes");
  return ffi::Error::Success();
}

ffi::Error hash_forward(ffi::ThreadPool pool, Floats table, Floats positions, ffi::Result<Floats> features,
                        ffi::Span<const int64_t> cells, ffi::Span<const int64_t> rows) {
  Sizes sizes;
  if (auto error = read_sizes(table, positions, *features, cells, rows, sizes); error.failure()) return error;
  const int64_t blocks = (sizes.positions + BLOCK - 1) / BLOCK;
  const float* at = positions.typed_data();
  parallel_for(pool, int(sizes.levels.size() * blocks), [&](int number) {
    const int64_t i = number / blocks, begin = number % blocks * BLOCK;
    const int64_t end = std::min(begin + BLOCK, sizes.positions);
    const Level level = sizes.levels[i];
    const float* first = table.typed_data() + level.start * sizes.features;
    float* out = features->typed_data() + i * sizes.features * sizes.positions;
    by_pieces(sizes.features, level, [&](auto count, auto in_order, int64_t feature) {
      using Some = Values<count.value>;
      for (int64_t m = begin; m < end; m++) {
        const Corners corners = corners_of<in_order.value>(level, at, sizes.positions, m);
        Some sum{};
        for (int c = 0; c < 8; c++)
          sum.values += corners.weight[c] * Some::read(first + corners.row[c] * sizes.features + feature).values;
        for (int k = 0; k < count.value; k++) out[(feature + k) * sizes.positions + m] = sum.values[k];
      }
    });
  });
  return ffi::Error::Success();
}

ffi::Error hash_backward(ffi::ThreadPool pool, Floats positions, Floats features, ffi::Result<Floats> table,
                         ffi::Span<const int64_t> cells, ffi::Span<const int64_t> rows) {
  Sizes sizes;
  if (auto error = read_sizes(*table, positions, features, cells, rows, sizes); error.failure()) return error;
  const float* at = positions.typed_data();
  parallel_for(pool, int(sizes.levels.size()), [&](int i) {
    const Level level = sizes.levels[i];
    const float* bars = features.typed_data() + i * sizes.features * sizes.positions;
    float* first = table->typed_data() + level.start * sizes.features;
    std::fill(first, first + level.rows * sizes.features, 0.f);
    by_pieces(sizes.features, level, [&](auto count, auto in_order, int64_t feature) {
      using Some = Values<count.value>;
      for (int64_t m = 0; m < sizes.positions; m++) {
        const Corners corners = corners_of<in_order.value>(level, at, sizes.positions, m);
        Some bar;
        for (int k = 0; k < count.value; k++) bar.values[k] = bars[(feature + k) * sizes.positions + m];
        for (int c = 0; c < 8; c++) {
          float* row = first + corners.row[c] * sizes.features + feature;
          Some sum = Some::read(row);
          sum.values += corners.weight[c] * bar.values;
          sum.write(row);
        }
      }
    });
  });
  return ffi::Error::Success();
}

// Both functions take two arrays and make one.
auto binding() {
  return ffi::Ffi::Bind()
      .Ctx<ffi::ThreadPool>()
      .Arg<Floats>()
      .Arg<Floats>()
      .Ret<Floats>()
      .Attr<ffi::Span<const int64_t>>("cells")
      .Attr<ffi::Span<const int64_t>>("rows");
}

}  // namespace
}  // namespace jaxcloseup

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(hash_forward, jaxcloseup::hash_forward, jaxcloseup::binding());
XLA_FFI_DEFINE_HANDLER_SYMBOL(hash_backward, jaxcloseup::hash_backward, jaxcloseup::binding());

#pragma GCC visibility pop
