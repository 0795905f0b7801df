// Vectors as wide as the instruction set, in the dialect that GCC and clang share: no intrinsics.
#pragma once
#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(__AVX512F__)
#define VECTOR_BYTES 64
#elif defined(__AVX2__)
#define VECTOR_BYTES 32
#else
#define VECTOR_BYTES 16
#endif
#define INLINE static inline __attribute__((always_inline))
#define NOINLINE static __attribute__((noinline))

typedef double D __attribute__((vector_size(VECTOR_BYTES)));
constexpr int DL = VECTOR_BYTES / sizeof(double);  // lanes of double

template <class V> INLINE V smaller(V a, V b) { return a < b ? a : b; }
template <class V> INLINE V larger(V a, V b) { return a > b ? a : b; }
template <class V> INLINE V magnitude(V a) { return larger(a, -a); }
template <class V> INLINE V root(V a) {
  constexpr int num = sizeof(V) / sizeof(a[0]);
  for (int k = 0; k < num; ++k) a[k] = sizeof(a[0]) == 4 ? sqrtf(a[k]) : sqrt(a[k]);
  return a;
}
template <class M> INLINE bool any(M mask) {
  uint64_t words[sizeof(M) / 8], all = 0;
  memcpy(words, &mask, sizeof(M));
  for (uint64_t word : words) all |= word;
  return all != 0;
}
