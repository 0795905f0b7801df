// Vectors as wide as the instruction set, in the dialect that GCC and clang share: no intrinsics.
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>

#if !defined(VECTOR_BYTES)  // on a microcontroller one may choose: memory grows with it
#if defined(__AVX512F__)
#define VECTOR_BYTES 64
#elif defined(__AVX2__)
#define VECTOR_BYTES 32
#else
#define VECTOR_BYTES 16
#endif
#endif
#define INLINE static inline __attribute__((always_inline))
#define NOINLINE static __attribute__((noinline))

// Of numbers, and of bytes and whole numbers of which each lane has one.
template <class E> struct Lanes;
template <> struct Lanes<double> {
  static constexpr int NUM = VECTOR_BYTES / 8;
  typedef double V __attribute__((vector_size(VECTOR_BYTES)));
  typedef int32_t Whole __attribute__((vector_size(VECTOR_BYTES / 2)));
  typedef uint64_t Bits __attribute__((vector_size(VECTOR_BYTES)));
  typedef uint8_t Few __attribute__((vector_size(VECTOR_BYTES / 8)));
};
template <> struct Lanes<float> {
  static constexpr int NUM = VECTOR_BYTES / 4;
  typedef float V __attribute__((vector_size(VECTOR_BYTES)));
  typedef int32_t Whole __attribute__((vector_size(VECTOR_BYTES)));
  typedef uint32_t Bits __attribute__((vector_size(VECTOR_BYTES)));
  typedef uint8_t Few __attribute__((vector_size(VECTOR_BYTES / 4)));
};

INLINE float root_of(float x) { return sqrtf(x); }
INLINE double root_of(double x) { return sqrt(x); }
INLINE float log_of(float x) { return logf(x); }
INLINE double log_of(double x) { return log(x); }
INLINE float exp_of(float x) { return expf(x); }
INLINE double exp_of(double x) { return exp(x); }
template <class E> INLINE E size_of(E x) { return x < 0 ? -x : x; }

template <class V> INLINE V smaller(V a, V b) { return a < b ? a : b; }
template <class V> INLINE V larger(V a, V b) { return a > b ? a : b; }
INLINE Lanes<double>::V magnitude(Lanes<double>::V a) {
  return (Lanes<double>::V)((Lanes<double>::Bits)a & (~0ull >> 1));
}
INLINE Lanes<float>::V magnitude(Lanes<float>::V a) {
  return (Lanes<float>::V)((Lanes<float>::Bits)a & (~0u >> 1));
}
template <class V> INLINE V root(V a) {
  constexpr int num = sizeof(V) / sizeof(a[0]);
  for (int k = 0; k < num; ++k) a[k] = root_of(a[k]);
  return a;
}
// Of a number from 0 to 1; in double by that of float, and two steps of Newton's, as it is slow.
INLINE Lanes<float>::V root_of_part(Lanes<float>::V x) { return root(x); }
INLINE Lanes<double>::V root_of_part(Lanes<double>::V x) {
#if VECTOR_BYTES >= 16
  typedef Lanes<double>::V V;
  typedef float Half __attribute__((vector_size(VECTOR_BYTES / 2)));
  Half least = __builtin_convertvector(larger(x, V{} + 1e-36), Half);
  V inverse = __builtin_convertvector(1 / root(least), V), half = 0.5 * inverse, found = x * inverse;
  found += (x - found * found) * half;
  return found + (x - found * found) * half;
#else
  return root(x);
#endif
}
template <class M> INLINE bool any(M mask) {
  uint32_t words[sizeof(M) / 4], all = 0;
  memcpy(words, &mask, sizeof(M));
  for (uint32_t word : words) all |= word;
  return all != 0;
}

// The next part of a space, as aligned as vectors are.
INLINE char* aligned(char* at) {
  return (char*)(((uintptr_t)at + VECTOR_BYTES - 1) / VECTOR_BYTES * VECTOR_BYTES);
}

constexpr double LARGEST_FLOAT = 0x1.fffffep127;

// What depends on the number type.
template <class E> struct Limits;
template <> struct Limits<double> {
  static constexpr double NOISE = 0x1p-48;  // part of a channel's magnitude; a span below is rounding
  static constexpr double TOLERANCE = 0;    // of neighbours of one run, more than 1e-12 of the channel
  static constexpr double HALF = 0.5 + 1e-6;  // to round levels of entropy, at an edge up
  static constexpr double LARGEST = 0x1.fffffffffffffp1023, SMALLEST = 0x1p-1022;
  static constexpr double SMALLEST_USUAL = 0x1p-320, LARGEST_USUAL = 0x1p448;  // squares are in range
  static constexpr bool IS_SMALL_ODD = true;  // below counts as odd; or as silent
};
template <> struct Limits<float> {
  static constexpr float NOISE = 0x1p-19f;  // of samples less the first, beside that of double
  static constexpr float TOLERANCE = 0x1p-22f, HALF = 0.5f + 0x1p-13f;
  static constexpr float LARGEST = LARGEST_FLOAT, SMALLEST = 0x1p-126f;
  static constexpr float SMALLEST_USUAL = 0x1p-50f, LARGEST_USUAL = 0x1p56f;
  static constexpr bool IS_SMALL_ODD = false;
};

// NaN stays NaN.
template <class E, class V> INLINE V clamped(V x, E most) {
  return x > most ? V{} + most : x < -most ? V{} - most : x;
}

template <class V> INLINE void exchange(V* a, V* b) {
  V x = *a, y = *b;
  *a = smaller(x, y);
  *b = larger(x, y);
}
template <int NUM, class V> INLINE void exchange_all(V* v, const int (&pairs)[NUM][2]) {
#pragma GCC unroll 19
  for (auto& pair : pairs) exchange(v + pair[0], v + pair[1]);
}

// Sorts by Batcher's odd-even merges, with the fewest comparisons: for few values.
template <class V> INLINE void sort_few(V* v, int n) {
  for (int p = 1; p < n; p *= 2)
    for (int k = p; k > 0; k /= 2)
      for (int block = 0; block < n; block += 2 * p) {
        int end = block + 2 * p < n ? block + 2 * p : n;
        for (int j = block + k % p; j + k < end; j += 2 * k)
          for (int i = j; i < (j + k < end - k ? j + k : end - k); ++i) exchange(v + i, v + i + k);
      }
}

// Sorts by bitonic merges, of which those within 8 values stay in registers. Needs memory for a whole
// number of 8 values.
template <class V> NOINLINE void sort(V* v, int n) {
#if defined(TACTSLIP_SMALL)
  sort_few(v, n);
#else
  constexpr int sorts[][2] = {{0, 1}, {2, 3}, {4, 5}, {6, 7}, {0, 2}, {1, 3}, {4, 6},
                              {5, 7}, {1, 2}, {5, 6}, {0, 4}, {1, 5}, {2, 6}, {3, 7},
                              {2, 4}, {3, 5}, {1, 2}, {3, 4}, {5, 6}};
  constexpr int merges[][2] = {{0, 4}, {1, 5}, {2, 6}, {3, 7}, {0, 2}, {1, 3},
                               {4, 6}, {5, 7}, {0, 1}, {2, 3}, {4, 5}, {6, 7}};
  for (; n % 8; ++n) v[n] = V{} + INFINITY;
  for (int i = 0; i < n; i += 8) exchange_all(v + i, sorts);
  for (int p = 8; p < n; p *= 2) {  // two sorted blocks of p become one
    for (int low = 0, high = 2 * p - 1; low + p < n; low += 2 * p, high += 2 * p)
      for (int i = high < n ? 0 : high - n + 1; i < p; ++i) exchange(v + low + i, v + high - i);
    for (int k = p / 2; k >= 8; k /= 2)
      for (int low = 0; low + k < n; low += 2 * k)
        for (int i = low; i < low + k && i + k < n; ++i) exchange(v + i, v + i + k);
    for (int i = 0; i < n; i += 8) exchange_all(v + i, merges);
  }
#endif
}
