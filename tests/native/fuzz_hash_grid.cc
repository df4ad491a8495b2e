// Encodes positions natively, and adds up their derivatives, with drawn input, sensible and not.
#include "fuzz.h"

extern "C" XLA_FFI_Error* hash_forward(XLA_FFI_CallFrame*);
extern "C" XLA_FFI_Error* hash_backward(XLA_FFI_CallFrame*);

void fuzz_hash_grid() {
  const int64_t number = any_of({0, 1, 2, 3, 7}), positions = any_of({0, 1, 7, 1024, 2500});
  std::vector<int64_t> cells(any_of({1, 3})), rows(cells.size());
  int64_t entries = 0;
  for (size_t i = 0; i < cells.size(); i++) {
    cells[i] = any_of({1, 2, 5, 1000, 1 << 20});
    const int64_t side = cells[i] + 1;
    entries += rows[i] = side < 7 && generator() % 2 ? side * side * side : any_of({1, 16, 1024});
  }
  const int rarity = any_of({0, 200, 20, 2});
  Floats table({entries, number}), at({3, positions});
  Floats features({int64_t(cells.size()), number, positions});
  const auto draw = [](size_t) { return uniform(-.1f, 1.1f); };
  fill(table, rarity, draw);
  fill(at, rarity, draw);
  call_twice("hash_forward", hash_forward, [&] {
    Call call;
    call.arg(table).arg(at);
    return std::move(call.attr("cells", cells).attr("rows", rows));
  }, features);
  fill(features, rarity, draw);
  call_twice("hash_backward", hash_backward, [&] {
    Call call;
    call.arg(at).arg(features);
    return std::move(call.attr("cells", cells).attr("rows", rows));
  }, table);
}
