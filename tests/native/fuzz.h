// What programs share that call the native library with drawn input.
#pragma once

#include <cmath>
#include <cstring>
#include <limits>
#include <random>

#include "xla_runtime.h"

using Dims = std::vector<int64_t>;
using Floats = Array<float>;
using Integers = Array<int32_t>;

inline std::mt19937 generator;

inline float uniform(float low, float high) { return std::uniform_real_distribution<float>(low, high)(generator); }
template <typename T>
inline T any_of(std::initializer_list<T> values) {
  return values.begin()[generator() % values.size()];
}

inline float nonsense() {
  constexpr float INF = std::numeric_limits<float>::infinity(), NONE = std::numeric_limits<float>::quiet_NaN();
  return any_of({NONE, -NONE, INF, -INF, 0.f, -0.f, 1e-45f, -1e-40f, 1e-38f, 3.4e38f, -3.4e38f, 1e20f, -1e10f, 1e9f,
                 -2147483648.f, 2147483648.f, -1.f, 1.f, .5f, 1.f / 255, .99f});
}

// Fills an array by a function of the index; some values become nonsense, one in `rarity`.
template <typename Draw>
inline void fill(Floats& array, int rarity, const Draw& draw) {
  for (size_t i = 0; i < array.size; i++)
    array.data[i] = rarity && generator() % rarity == 0 ? nonsense() : draw(i);
}

inline Dims with(Dims dims, std::initializer_list<int64_t> more) {
  dims.insert(dims.end(), more);
  return dims;
}

[[noreturn]] inline void fail(const char* what, const std::string& why) {
  std::fprintf(stderr, "%s: %s\n", what, why.c_str());
  std::exit(1);
}

// Calls a handler with one thread and with several, whose results must be the same.
template <typename Make, typename... Results>
void call_twice(const char* name, XLA_FFI_Handler* handler, const Make& make, Results&... results) {
  for (int threads : {1, 4}) {
    std::vector<std::vector<char>> before;
    const auto keep = [&](const auto& array) {
      const char* bytes = reinterpret_cast<const char*>(array.data.get());
      before.emplace_back(bytes, bytes + array.size * sizeof(array.data[0]));
    };
    (keep(results), ...);
    Call call = make();
    (call.ret(results), ...);
    const std::string error = call.run(handler, threads);
    if (!error.empty()) fail(name, error);
    if (threads == 1) continue;
    size_t number = 0;
    const auto same = [&](const auto& array) {
      const auto& old = before[number++];
      if (!old.empty() && std::memcmp(old.data(), array.data.get(), old.size())) fail(name, "threads change results");
    };
    (same(results), ...);
  }
}

// Gathers once; in `fuzz_gather.cc`.
void fuzz_gathering();

// Matches patches once; in `fuzz_stereo.cc`.
void fuzz_matching();

// Encodes positions once; in `fuzz_hash_grid.cc`.
void fuzz_hash_grid();

// Compares two images once; in `fuzz_ssim.cc`.
void fuzz_comparing();
