// Sums rows of tables with drawn input, sensible and not.
#include "fuzz.h"

extern "C" XLA_FFI_Error* rows_sum(XLA_FFI_CallFrame*);
extern "C" XLA_FFI_Error* rows_add(XLA_FFI_CallFrame*);

void fuzz_rows() {
  const Dims batch = any_of<Dims>({{}, {}, {2}, {0}, {2, 2}});
  const int64_t features = any_of({0, 1, 2, 3, 13, 16}), corners = any_of({0, 1, 4, 8});
  const int64_t positions = any_of({0, 1, 7, 2048, 5000});
  std::vector<int64_t> of_grids(any_of({0, 1, 3}));
  int64_t entries = 0;
  for (int64_t& size : of_grids) entries += size = any_of({1, 2, 50});
  const int64_t grids = of_grids.size();
  const int rarity = any_of({0, 200, 20, 2});
  Floats table(with(batch, {entries, features})), weights(with(batch, {corners, grids, positions}));
  Floats between(with(batch, {grids, features, positions}));
  Integers rows(weights.dims);
  fill(table, rarity, [](size_t) { return uniform(-1, 1); });
  fill(weights, rarity, [](size_t) { return uniform(0, 1); });
  for (size_t i = 0; i < rows.size; i++)
    rows.data[i] = rarity && generator() % 4 == 0 ? any_of({-1, 2147483647, -2147483647 - 1})
                                                  : generator() % (entries + 1);
  call_twice("rows_sum", rows_sum, [&] {
    Call call;
    return std::move(call.arg(table).arg(rows).arg(weights).attr("of_grids", of_grids));
  }, between);
  fill(between, rarity, [](size_t) { return uniform(-1, 1); });
  call_twice("rows_add", rows_add, [&] {
    Call call;
    return std::move(call.arg(rows).arg(weights).arg(between).attr("of_grids", of_grids));
  }, table);
}
