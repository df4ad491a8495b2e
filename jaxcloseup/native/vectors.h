// Vectors of floats, as wide as the instructions that a file is compiled for.
//
// Arithmetic, comparisons and selections are those of the vector extensions of GCC and Clang. What
// these lack is here. Products are fused with sums only where `mad` says so, because the forward
// pass and its derivative must round alike.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__) || defined(__AVX__) || defined(__SSE__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define WIDTH 16
#elif defined(__AVX2__)
#define WIDTH 8
#else
#define WIDTH 4
#endif

namespace {

typedef float V __attribute__((vector_size(4 * WIDTH)));
typedef int32_t I __attribute__((vector_size(4 * WIDTH)));

inline V broadcast(float x) {
#if defined(__AVX512F__)
  return (V)_mm512_set1_ps(x);
#elif defined(__AVX__)
  return (V)_mm256_set1_ps(x);
#else
  return V{} + x;
#endif
}
inline V load(const float* from) {
  V to;
  std::memcpy(&to, from, sizeof to);
  return to;
}
// The first `count` numbers, and 0; `count` may be negative.
inline V load_some(const float* from, int64_t count) {
  if (count >= WIDTH) return load(from);
  float some[WIDTH] = {};
  for (int64_t i = 0; i < count; i++) some[i] = from[i];
  return load(some);
}
inline void store(float* to, V from) { std::memcpy(to, &from, sizeof from); }

// a b + c
inline V mad(V a, V b, V c) {
#if defined(__AVX512F__)
  return (V)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c);
#elif defined(__FMA__)
  return (V)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c);
#else
  return a * b + c;
#endif
}

// Where a comparison holds: a bit for each element, or all bits of an element.
#if defined(__AVX512F__)
struct M {
  __mmask16 bits;
};
#define COMPARE(name, op, predicate) \
  inline M name(V a, V b) { return {_mm512_cmp_ps_mask((__m512)a, (__m512)b, predicate)}; }
inline bool any(M mask) { return mask.bits != 0; }
inline V select(M mask, V a, V b) {
  return (V)_mm512_mask_blend_ps(mask.bits, (__m512)b, (__m512)a);
}
inline V select(M mask, V a) { return (V)_mm512_maskz_mov_ps(mask.bits, (__m512)a); }
inline M operator&(M a, M b) { return {(__mmask16)(a.bits & b.bits)}; }
inline M operator|(M a, M b) { return {(__mmask16)(a.bits | b.bits)}; }
inline M operator~(M a) { return {(__mmask16)~a.bits}; }
#else
struct M {
  I bits;
};
#define COMPARE(name, op, predicate) \
  inline M name(V a, V b) { return {a op b}; }
inline bool any(M mask) {
#if defined(__AVX__)
  return !_mm256_testz_si256((__m256i)mask.bits, (__m256i)mask.bits);
#elif defined(__SSE2__)
  return _mm_movemask_ps((__m128)mask.bits) != 0;
#else
  int32_t all = 0;
  for (int i = 0; i < WIDTH; i++) all |= mask.bits[i];
  return all != 0;
#endif
}
inline V select(M mask, V a, V b) { return (V)((mask.bits & (I)a) | (~mask.bits & (I)b)); }
inline V select(M mask, V a) { return (V)(mask.bits & (I)a); }
inline M operator&(M a, M b) { return {a.bits & b.bits}; }
inline M operator|(M a, M b) { return {a.bits | b.bits}; }
inline M operator~(M a) { return {~a.bits}; }
#endif
COMPARE(less, <, _CMP_LT_OQ)
COMPARE(at_most, <=, _CMP_LE_OQ)
COMPARE(equal, ==, _CMP_EQ_OQ)
#undef COMPARE

// The first where both are numbers and it is the lesser, or greater; else the second.
#if defined(__AVX512F__)
inline V lesser(V a, V b) { return (V)_mm512_maskz_min_ps(-1, (__m512)a, (__m512)b); }
inline V greater(V a, V b) { return (V)_mm512_maskz_max_ps(-1, (__m512)a, (__m512)b); }
#else
inline V lesser(V a, V b) { return a < b ? a : b; }
inline V greater(V a, V b) { return a > b ? a : b; }
#endif

inline V squared(V x) { return x * x; }
inline V root(V x) {
#if defined(__AVX512F__)
  return (V)_mm512_maskz_sqrt_ps(-1, (__m512)x);
#elif defined(__AVX__)
  return (V)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE2__)
  return (V)_mm_sqrt_ps((__m128)x);
#else
  for (int i = 0; i < WIDTH; i++) x[i] = __builtin_sqrtf(x[i]);
  return x;
#endif
}

// e^x of x <= 87, to 1e-7; the coefficients are those of Cephes' expf.
inline V exponential(V x) {
  x = greater(broadcast(-80.f), x);  // NaN stays
  const V shift = broadcast(12582912.f);  // rounds what is added to it
  const V k = (x * 1.44269504f + shift) - shift;
  V r = mad(k, broadcast(-.693359375f), x);
  r = mad(k, broadcast(2.12194440e-4f), r);
  V y = broadcast(1.9875691500e-4f);
  y = mad(y, r, broadcast(1.3981999507e-3f));
  y = mad(y, r, broadcast(8.3334519073e-3f));
  y = mad(y, r, broadcast(4.1665795894e-2f));
  y = mad(y, r, broadcast(1.6666665459e-1f));
  y = mad(y, r, broadcast(5.0000001201e-1f));
  y = mad(y, r * r, r + 1.f);
  const I power = (__builtin_convertvector(k, I) + 127) << 23;
  return y * (V)power;
}

// log x of normal x > 0, to 1e-7; the coefficients are those of Cephes' logf.
inline V logarithm(V x) {
  I bits = (I)x;
  V e = __builtin_convertvector((bits >> 23) - 126, V);
  V m = (V)((bits & 0x7fffff) | 0x3f000000);  // in [1/2, 1)
  const M small = less(m, broadcast(.707106781f));
  e = e - select(small, broadcast(1));
  m = select(small, m + m, m) - 1.f;
  V y = broadcast(7.0376836292e-2f);
  y = mad(y, m, broadcast(-1.1514610310e-1f));
  y = mad(y, m, broadcast(1.1676998740e-1f));
  y = mad(y, m, broadcast(-1.2420140846e-1f));
  y = mad(y, m, broadcast(1.4249322787e-1f));
  y = mad(y, m, broadcast(-1.6668057665e-1f));
  y = mad(y, m, broadcast(2.0000714765e-1f));
  y = mad(y, m, broadcast(-2.4999993993e-1f));
  y = mad(y, m, broadcast(3.3333331174e-1f));
  const V square = m * m;
  y = mad(e, broadcast(-2.12194440e-4f), y * m * square) - .5f * square;
  return mad(e, broadcast(.693359375f), m + y);
}

// The sums of WIDTH vectors, as the elements of one.
inline V sum_each(const V* v) {
#if WIDTH == 16
  V a[8], b[4];
  for (int i = 0; i < 8; i++) {
    const V x = v[i], y = v[i + 8];
    a[i] = __builtin_shufflevector(x, y, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
           __builtin_shufflevector(x, y, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
  }
  for (int i = 0; i < 4; i++) {
    const V x = a[i], y = a[i + 4];
    b[i] = __builtin_shufflevector(x, y, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27) +
           __builtin_shufflevector(x, y, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
  }
  for (int i = 0; i < 2; i++) {
    const V x = b[i], y = b[i + 2];
    a[i] = __builtin_shufflevector(x, y, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
           __builtin_shufflevector(x, y, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
  }
  return __builtin_shufflevector(a[0], a[1], 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30) +
         __builtin_shufflevector(a[0], a[1], 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
#elif WIDTH == 8
  V a[4], b[2];
  for (int i = 0; i < 4; i++) {
    const V x = v[i], y = v[i + 4];
    a[i] = __builtin_shufflevector(x, y, 0, 1, 2, 3, 8, 9, 10, 11) +
           __builtin_shufflevector(x, y, 4, 5, 6, 7, 12, 13, 14, 15);
  }
  for (int i = 0; i < 2; i++) {
    const V x = a[i], y = a[i + 2];
    b[i] = __builtin_shufflevector(x, y, 0, 1, 8, 9, 4, 5, 12, 13) +
           __builtin_shufflevector(x, y, 2, 3, 10, 11, 6, 7, 14, 15);
  }
  return __builtin_shufflevector(b[0], b[1], 0, 8, 2, 10, 4, 12, 6, 14) +
         __builtin_shufflevector(b[0], b[1], 1, 9, 3, 11, 5, 13, 7, 15);
#else
  V a[2];
  for (int i = 0; i < 2; i++) {
    const V x = v[i], y = v[i + 2];
    a[i] = __builtin_shufflevector(x, y, 0, 1, 4, 5) + __builtin_shufflevector(x, y, 2, 3, 6, 7);
  }
  return __builtin_shufflevector(a[0], a[1], 0, 4, 2, 6) +
         __builtin_shufflevector(a[0], a[1], 1, 5, 3, 7);
#endif
}

}  // namespace
