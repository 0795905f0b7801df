// Chooses the engine of the processor's instruction set; compiled for the oldest of them.

#include "engine.h"

#if defined(_WIN32)
#define EXPORT extern "C" __declspec(dllexport)
#else
#define EXPORT extern "C" __attribute__((visibility("default")))
#endif

typedef int Bristles(const BristleRun*);
typedef int Features(const Plan*, const void*, int, int64_t, void*, int, uint8_t*);

#if defined(__x86_64__)
#include <cpuid.h>

extern "C" Features features_v2, features_v3, features_v4;
extern "C" Bristles bristles_v2, bristles_v3, bristles_v4;

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

EXPORT int tactslip_features(int level, const Plan* plan, const void* bins, int bins_are_float,
                             int64_t num_bins, void* out, int out_is_float, uint8_t* is_odd) {
  Features* engine = level >= 4 ? features_v4 : level == 3 ? features_v3 : features_v2;
  return engine(plan, bins, bins_are_float, num_bins, out, out_is_float, is_odd);
}

EXPORT int tactslip_bristles(int level, const BristleRun* run) {
  return (level >= 4 ? bristles_v4 : level == 3 ? bristles_v3 : bristles_v2)(run);
}
#else
extern "C" Features features_v1;
extern "C" Bristles bristles_v1;

EXPORT int tactslip_level() { return 1; }

EXPORT int tactslip_features(int, const Plan* plan, const void* bins, int bins_are_float,
                             int64_t num_bins, void* out, int out_is_float, uint8_t* is_odd) {
  return features_v1(plan, bins, bins_are_float, num_bins, out, out_is_float, is_odd);
}

EXPORT int tactslip_bristles(int, const BristleRun* run) { return bristles_v1(run); }
#endif
