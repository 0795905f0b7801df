// Chooses the engine of the processor's instruction set; compiled for the oldest of them.

#include "engine.h"

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

#if defined(__x86_64__) && !defined(TACTSLIP_PORTABLE)
#include <cpuid.h>

static bool has(unsigned bits, unsigned wanted) { return (bits & wanted) == wanted; }

// 2, 3 or 4, as in x86-64-v3: what the processor has and the operating system saves. An own check,
// as __builtin_cpu_supports said no to everything in a build by zig. AVX2 stands for v3, the five
// parts of AVX-512 for v4: no processor has them without the rest.
EXPORT int tactslip_level() {
  unsigned a, b, c, d;
  if (!__get_cpuid(1, &a, &b, &c, &d) || !has(c, 1u << 27 | 1u << 28 | 1u << 12)) return 2;
  unsigned low, high;
  __asm__ volatile("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
  if (!has(low, 0x06) || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return 2;
  if (!has(b, 1u << 3 | 1u << 5 | 1u << 8)) return 2;
  return has(low, 0xe6) && has(b, 1u << 16 | 1u << 17 | 1u << 28 | 1u << 30 | 1u << 31) ? 4 : 3;
}

#else
EXPORT int tactslip_level() { return 1; }
#endif

#if !defined(TACTSLIP_BARE)
#include <stdlib.h>

// With memory of the heap, for Python; not zero: there is none.
template <class Call> static int with_space(size_t bytes, Call call) {
  void* space = malloc(bytes);
  if (!space) return 1;
  call(space);
  free(space);
  return 0;
}

template <class E>
static int features(int level, const void* plan, const void* machine, const void* bins) {
  auto p = (const Plan<E>*)plan;
  auto m = (const Machine<E>*)machine;
  auto b = (const Bins<E>*)bins;
  return with_space(OF_LEVEL(level, features_space(p, m, b)),
                    [&](void* space) { OF_LEVEL(level, features(p, m, b, space)); });
}

EXPORT int tactslip_features(
    int level, int is_float, const void* plan, const void* machine, const void* bins) {
  return (is_float ? features<float> : features<double>)(level, plan, machine, bins);
}
EXPORT int tactslip_onset(int level, const Onset<double>* onset, OnsetHops<double>* hops) {
  return with_space(OF_LEVEL(level, onset_space(onset)),
                    [&](void* space) { OF_LEVEL(level, onset(onset, hops, space)); });
}
EXPORT int tactslip_bristles(int level, const BristleRun* run) {
  return with_space(OF_LEVEL(level, bristles_space(run)),
                    [&](void* space) { OF_LEVEL(level, bristles(run, space)); });
}
#endif
