// Chooses the engine of the processor's instruction set; compiled for the oldest of them.

#include "engine.h"

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

typedef int Bristles(const BristleRun*);
typedef int Features(const Plan*, const Machine*, const Bins*);
typedef int OnsetScores(const Onset*, OnsetHops*);

#if defined(__x86_64__)
#include <cpuid.h>

extern "C" Bristles bristles_v2, bristles_v3, bristles_v4;
extern "C" Features features_v2, features_v3, features_v4;
extern "C" OnsetScores onset_v2, onset_v3, onset_v4;
#define OF_LEVEL(name) (level >= 4 ? name##_v4 : level == 3 ? name##_v3 : name##_v2)

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
extern "C" Bristles bristles_v1;
extern "C" Features features_v1;
extern "C" OnsetScores onset_v1;
#define OF_LEVEL(name) (level, name##_v1)

EXPORT int tactslip_level() { return 1; }
#endif

EXPORT int tactslip_features(int level, const Plan* plan, const Machine* machine, const Bins* bins) {
  return OF_LEVEL(features)(plan, machine, bins);
}
EXPORT int tactslip_bristles(int level, const BristleRun* run) { return OF_LEVEL(bristles)(run); }
EXPORT int tactslip_onset(int level, const Onset* onset, OnsetHops* hops) {
  return OF_LEVEL(onset)(onset, hops);
}
