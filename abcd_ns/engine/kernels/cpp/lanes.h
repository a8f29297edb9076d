// Vectors of floats as wide as the processor's, by GCC's and Clang's vector extension.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__x86_64__)
#include <immintrin.h>
#elif defined(__ARM_NEON)
#include <arm_neon.h>
#endif

#if defined(__AVX512F__)
constexpr int LANES = 16;
typedef float V __attribute__((vector_size(64)));
typedef int32_t I __attribute__((vector_size(64)));
#elif defined(__AVX__)
constexpr int LANES = 8;
typedef float V __attribute__((vector_size(32)));
typedef int32_t I __attribute__((vector_size(32)));
#else
constexpr int LANES = 4;
typedef float V __attribute__((vector_size(16)));
typedef int32_t I __attribute__((vector_size(16)));
#endif

static inline V splat(float x) { return V{} + x; }
// b where either is a NaN.
static inline V vmax(V a, V b) {
#if defined(__AVX512F__)
  return (V)_mm512_max_ps((__m512)a, (__m512)b);
#elif defined(__AVX__)
  return (V)_mm256_max_ps((__m256)a, (__m256)b);
#else
  return a > b ? a : b;
#endif
}
static inline V vmin(V a, V b) {
#if defined(__AVX512F__)
  return (V)_mm512_min_ps((__m512)a, (__m512)b);
#elif defined(__AVX__)
  return (V)_mm256_min_ps((__m256)a, (__m256)b);
#else
  return a < b ? a : b;
#endif
}
static inline V only(I mask, V a) { return (V)(mask & (I)a); }  // a where the mask holds, else 0

static inline V load(const float* from) {
  V v;
  std::memcpy(&v, from, sizeof v);
  return v;
}
static inline void store(float* to, V v) { std::memcpy(to, &v, sizeof v); }

static inline bool any(I mask) {
#if defined(__AVX512F__)
  return _mm512_movepi32_mask((__m512i)mask) != 0;
#elif defined(__AVX__)
  return _mm256_movemask_ps((__m256)mask) != 0;
#elif defined(__SSE__)
  return _mm_movemask_ps((__m128)mask) != 0;
#elif defined(__ARM_NEON) && defined(__aarch64__)
  return vmaxvq_u32((uint32x4_t)mask) != 0;
#else
  int found = 0;
  for (int l = 0; l < LANES; l++) found |= mask[l];
  return found != 0;
#endif
}

static inline V vsqrt(V x) {
#if defined(__AVX512F__)
  return (V)_mm512_sqrt_ps((__m512)x);
#elif defined(__AVX__)
  return (V)_mm256_sqrt_ps((__m256)x);
#elif defined(__SSE__)
  return (V)_mm_sqrt_ps((__m128)x);
#else
  for (int l = 0; l < LANES; l++) x[l] = std::sqrt(x[l]);
  return x;
#endif
}

static inline V vceil(V x) {
#if defined(__AVX512F__)
  return (V)_mm512_roundscale_ps((__m512)x, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC);
#elif defined(__AVX__)
  return (V)_mm256_ceil_ps((__m256)x);
#else
  for (int l = 0; l < LANES; l++) x[l] = std::ceil(x[l]);
  return x;
#endif
}

static inline V vfloor(V x) { return -vceil(-x); }

// 2^x to 1e-7 for -126 <= x <= 127, and some number beyond: a polynomial on [-1/2, 1/2], shifted.
static inline V vexp2(V x) {
  const V shifted = x + 12582912.0f;  // 1.5 * 2^23: rounds to a whole number
  const V f = x - (shifted - 12582912.0f);
  V p = splat(1.327647152e-3f);
  p = p * f + 9.675541331e-3f;
  p = p * f + 5.550713275e-2f;
  p = p * f + 2.402211972e-1f;
  p = p * f + 6.931469671e-1f;
  p = p * f + 1.000000072f;
  return (V)((I)p + ((I)shifted << 23));
}

// e^x to 2e-7 for -87 <= x <= 88, clamped beyond; a NaN stays one.
static inline V vexp(V x) {
  x = vmin(splat(88.0f), vmax(splat(-87.0f), x));
  const V n = (x * 1.44269504f + 12582912.0f) - 12582912.0f;
  return vexp2(n) * vexp2(((x - n * 0.693359375f) + n * 2.12194440e-4f) * 1.44269504f);
}

static inline float sum(V v) {
  float total = 0;
  for (int l = 0; l < LANES; l++) total += v[l];
  return total;
}

#if defined(__clang__) || __GNUC__ >= 12
#define SHUFFLE(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SHUFFLE(a, b, ...) __builtin_shuffle(a, b, (I){__VA_ARGS__})
#endif

// Row j of the result is lane j of all rows.
__attribute__((always_inline)) static inline void transpose(V* rows) {
  V next[LANES];
#if defined(__AVX512F__)
#pragma GCC unroll 16
  for (int i = 0; i < 16; i += 2) {
    next[i] = SHUFFLE(rows[i], rows[i + 1], 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30);
    next[i + 1] = SHUFFLE(rows[i], rows[i + 1], 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
  }
#pragma GCC unroll 16
  for (int i = 0; i < 16; i += 4)
#pragma GCC unroll 16
    for (int j = i; j < i + 2; j++) {
      rows[j] = SHUFFLE(next[j], next[j + 2], 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
      rows[j + 2] = SHUFFLE(next[j], next[j + 2], 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    }
#pragma GCC unroll 16
  for (int i = 0; i < 16; i += 8)
#pragma GCC unroll 16
    for (int j = i; j < i + 4; j++) {
      next[j] = SHUFFLE(rows[j], rows[j + 4], 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27);
      next[j + 4] = SHUFFLE(rows[j], rows[j + 4], 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    }
#pragma GCC unroll 16
  for (int j = 0; j < 8; j++) {
    rows[j] = SHUFFLE(next[j], next[j + 8], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
    rows[j + 8] = SHUFFLE(next[j], next[j + 8], 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
  }
#elif defined(__AVX__)
#pragma GCC unroll 16
  for (int i = 0; i < 8; i += 2) {
    next[i] = SHUFFLE(rows[i], rows[i + 1], 0, 8, 2, 10, 4, 12, 6, 14);
    next[i + 1] = SHUFFLE(rows[i], rows[i + 1], 1, 9, 3, 11, 5, 13, 7, 15);
  }
#pragma GCC unroll 16
  for (int i = 0; i < 8; i += 4)
#pragma GCC unroll 16
    for (int j = i; j < i + 2; j++) {
      rows[j] = SHUFFLE(next[j], next[j + 2], 0, 1, 8, 9, 4, 5, 12, 13);
      rows[j + 2] = SHUFFLE(next[j], next[j + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    }
#pragma GCC unroll 16
  for (int j = 0; j < 4; j++) {
    next[j] = SHUFFLE(rows[j], rows[j + 4], 0, 1, 2, 3, 8, 9, 10, 11);
    next[j + 4] = SHUFFLE(rows[j], rows[j + 4], 4, 5, 6, 7, 12, 13, 14, 15);
  }
#pragma GCC unroll 16
  for (int j = 0; j < 8; j++) rows[j] = next[j];
#else
#pragma GCC unroll 16
  for (int i = 0; i < 4; i += 2) {
    next[i] = SHUFFLE(rows[i], rows[i + 1], 0, 4, 2, 6);
    next[i + 1] = SHUFFLE(rows[i], rows[i + 1], 1, 5, 3, 7);
  }
#pragma GCC unroll 16
  for (int j = 0; j < 2; j++) {
    rows[j] = SHUFFLE(next[j], next[j + 2], 0, 1, 4, 5);
    rows[j + 2] = SHUFFLE(next[j], next[j + 2], 2, 3, 6, 7);
  }
#endif
}

// Columns 0 .. C-1 of LANES consecutive rows of a matrix, each as one vector; rows from `valid` on repeat the
// last one that is valid.
template <int C>
static inline void load_rows(const float* matrix, int valid, V* columns) {
  const float* row[LANES];
  for (int l = 0; l < LANES; l++) row[l] = matrix + int64_t(C) * (l < valid ? l : valid - 1);
  int c = 0;
  for (; c + LANES <= C; c += LANES) {
    for (int l = 0; l < LANES; l++) columns[c + l] = load(row[l] + c);
    transpose(columns + c);
  }
  if constexpr (C % LANES != 0)
    for (; c < C; c++)
      for (int l = 0; l < LANES; l++) columns[c][l] = row[l][c];
}

// The way back; rows from `valid` on are left out, and `columns` is overwritten.
template <int C>
static inline void store_rows(V* columns, int valid, float* matrix) {
  int c = 0;
  for (; c + LANES <= C; c += LANES) {
    transpose(columns + c);
    for (int l = 0; l < valid; l++) store(matrix + int64_t(C) * l + c, columns[c + l]);
  }
  if constexpr (C % LANES != 0)
    for (; c < C; c++)
      for (int l = 0; l < valid; l++) matrix[int64_t(C) * l + c] = columns[c][l];
}
