// Features of filtered bins, in the order and under the names of features/descriptors.py.
//
// Lanes run across (bin, channel) pairs: element k of every vector belongs to pair k of a group, so
// a line of code reads like its formula. A row (a channel's bin, a branch of a fast channel or
// its spectrum) is formed by products with given matrices, in double, and brought to order one
// before it is described: row = centre + span * d, with d in double or float. One sort of d feeds
// median, mode, iqr and entropy.
//
// This file is compiled once for each instruction set (dispatch.cpp chooses). Only vector types are
// used that GCC and clang share, no intrinsics, and nothing of the C++ runtime.

#include <stdlib.h>

#include "engine.h"
#include "vectors.h"

namespace {

constexpr double NOISE = 16 * 0x1p-52;  // part of a channel's magnitude; a span below is rounding
constexpr double CV_FLOOR = 1e-6;       // part of the rms that the mean counts as at least
constexpr double CV_ZERO = 1e-12;       // part of it within which a mean has no sign
constexpr double CROWDED = 2e-3;        // part of a row's span; float rounds to 3e-8 of it
constexpr double LEVELS = 255;          // of entropy's histogram, less one
constexpr double SMALLEST_USUAL = 0x1p-320, LARGEST_USUAL = 0x1p448;  // squares are in range
constexpr int FEWEST_SAMPLES = 16;  // of a bin that may be silent
constexpr double LARGEST = 0x1.fffffffffffffp1023, LARGEST_FLOAT = 0x1.fffffep127;
constexpr int USUAL = 100;              // values of a row whose sort is straight-line code
constexpr int CHUNK = 32;               // bins whose features are made before they are scored

constexpr uint32_t ORDERED = 1u << MEDIAN | 1u << MODE | 1u << IQR | 1u << ENTROPY;
constexpr uint32_t WEIGHTED = 1u << SPECTRAL_CENTROID | 1u << SPECTRAL_SPREAD;

// Vectors of T, of as many T as there are lanes of double, and of whole numbers, one a lane of T.
template <class T> struct Lanes {
  typedef D V, Part;
  typedef int32_t Whole __attribute__((vector_size(VECTOR_BYTES / 2)));
  typedef uint8_t Few __attribute__((vector_size(VECTOR_BYTES / 8)));
};
template <> struct Lanes<float> {
  typedef float V __attribute__((vector_size(VECTOR_BYTES)));
  typedef float Part __attribute__((vector_size(VECTOR_BYTES / 2)));
  typedef int32_t Whole __attribute__((vector_size(VECTOR_BYTES)));
  typedef uint8_t Few __attribute__((vector_size(VECTOR_BYTES / 4)));
};
typedef uint8_t Bytes __attribute__((vector_size(VECTOR_BYTES)));

// NaN stays NaN.
INLINE D clamped(D x, double most) { return x > most ? D{} + most : x < -most ? D{} - most : x; }

// -- Sorting -------------------------------------------------------------------------------------

template <class V> INLINE void exchange(V* a, V* b) {
  V x = *a, y = *b;
  *a = smaller(x, y);
  *b = larger(x, y);
}

// Batcher's odd-even merge sort of v[0..N): sorts FROM .. FROM + SIZE, a power of two, in steps.
template <int N, int FROM, int SIZE, int STEP, class V> INLINE void merge(V* v) {
  if constexpr (FROM + STEP < N) {
    if constexpr (2 * STEP < SIZE) {
      merge<N, FROM, SIZE, 2 * STEP>(v);
      merge<N, FROM + STEP, SIZE, 2 * STEP>(v);
      constexpr int end = (FROM - FROM % SIZE) + SIZE;
#pragma GCC unroll 128
      for (int i = FROM + STEP; i + STEP < (end < N ? end : N); i += 2 * STEP)
        exchange(v + i, v + i + STEP);
    } else {
      exchange(v + FROM, v + FROM + STEP);
    }
  }
}
template <int N, int FROM, int SIZE, class V> INLINE void sort_straight(V* v) {
  if constexpr (SIZE > 1 && FROM < N) {
    sort_straight<N, FROM, SIZE / 2>(v);
    sort_straight<N, FROM + SIZE / 2, SIZE / 2>(v);
    merge<N, FROM, SIZE, 1>(v);
  }
}

// The same comparisons in loops, for any n: Knuth, volume 3, 5.2.2, algorithm M.
template <class V> INLINE void sort_looped(V* v, int n) {
  int most = 1;
  while (2 * most < n) most *= 2;
  for (int p = most; p > 0; p /= 2)
    for (int q = most, r = 0, d = p;; d = q - p, q /= 2, r = p) {
      for (int i = 0; i < n - d; ++i)
        if ((i & p) == r) exchange(v + i, v + i + d);
      if (q == p) break;
    }
}

template <class V> NOINLINE void sort(V* v, int n) {
  if (n == USUAL)
    sort_straight<USUAL, 0, 128>(v);
  else
    sort_looped(v, n);
}

// -- Products ------------------------------------------------------------------------------------

// out = matrix * x, R rows at a time, of which each block has its own columns that are not zero.
template <int R, class E, class V> INLINE void product(const Matrix& matrix, const V* x, V* out) {
  const E* values = (const E*)matrix.values;
  for (int64_t block = 0; block < matrix.num_blocks; ++block) {
    V sums[R] = {};
    const V* from = x + matrix.first[block];
    for (int64_t k = 0; k < matrix.width; ++k, values += R)
#pragma GCC unroll 8
      for (int r = 0; r < R; ++r) sums[r] += from[k] * values[r];
#pragma GCC unroll 8
    for (int r = 0; r < R; ++r) out[block * R + r] = sums[r];
  }
}

struct Extent {
  D low, high, mean;
};
INLINE Extent extent(const D* row, int64_t n) {
  D low = row[0], high = low, total = low;
  for (int64_t i = 1; i < n; ++i) {
    low = smaller(low, row[i]);
    high = larger(high, row[i]);
    total += row[i];
  }
  return {low, high, total / (double)n};
}

// -- Descriptors of W rows at once ------------------------------------------------------------------

// Sums over a row, in the unit of d.
template <class V> struct Sums {
  V first, second, third, fourth, both, other;
};

// What descriptors are made of, for half of the lanes: row = centre + span * d.
struct Half : Sums<D> {
  D centre, span, top, energy;
  double n;
};

// By vectors of W lanes of T, which are H vectors of double.
template <class T> struct Describe {
  static constexpr int W = VECTOR_BYTES / sizeof(T), H = W / DL;
  typedef typename Lanes<T>::V V;
  typedef typename Lanes<T>::Part Part;
  typedef typename Lanes<T>::Whole Whole;
  typedef typename Lanes<T>::Few Few;

  INLINE D get(const V* from, int h) {
    return __builtin_convertvector(*(const Part*)((const T*)from + h * DL), D);
  }
  INLINE void put(V* to, int h, D x) {
    *(Part*)((T*)to + h * DL) = __builtin_convertvector(x, Part);
  }

  INLINE Sums<V> sums(const V* d, const V* other, int64_t n) {
    Sums<V> s = {};
    for (int64_t i = 0; i < n; ++i) {
      V v = d[i], w = v * v;
      s.first += magnitude(v);
      s.second += w;
      s.third += w * v;
      s.fourth += w * w;
      if (other) s.both += v * other[i];
    }
    return s;
  }

  static D mean(const Half& s) { return s.centre; }
  static V median(const V* sorted, int64_t n) {
    return n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) * (T)0.5;
  }
  // The first value of the first longest run of neighbours within the tolerance.
  static V mode(const V* sorted, V tolerance, int64_t n) {
    V start = sorted[0], best = start, run = {}, longest = {};
    for (int64_t i = 1; i < n; ++i) {
      auto is_near = sorted[i] - sorted[i - 1] <= tolerance;
      start = is_near ? start : sorted[i];
      run = is_near ? run + (T)1 : V{};
      best = run > longest ? start : best;
      longest = larger(longest, run);
    }
    return best;
  }
  static D range(const Half& s) { return s.span; }
  static D mean_deviation(const Half& s) { return s.span * s.first / s.n; }
  static D std(const Half& s) { return s.span * root(s.second / (s.n - 1)); }
  static D cv(const Half& s) {
    D rms = root(s.energy / s.n), floor = larger(magnitude(s.centre), CV_FLOOR * rms);
    D value = std(s) / (s.centre < -CV_ZERO * rms ? -floor : floor);
    return s.span > 0 ? value : D{};
  }
  template <class Any> INLINE Any quantile(const Any* sorted, double q, int64_t n) {
    double position = q * n - 0.5;
    position = position < 0 ? 0 : position > n - 1 ? n - 1 : position;
    int64_t below = (int64_t)position, above = below + 1 < n ? below + 1 : n - 1;
    T part = (T)(position - below);
    return sorted[below] * (1 - part) + sorted[above] * part;
  }
  // Between quantiles at Hazen's positions.
  template <class Any> INLINE Any iqr(const Any* sorted, int64_t n) {
    return quantile(sorted, 0.75, n) - quantile(sorted, 0.25, n);
  }
  static D skewness(const Half& s) {
    D value = s.third * root(s.n / s.second) / s.second;
    return s.span > 0 ? value : D{};
  }
  static D kurtosis(const Half& s) {
    D value = s.n * s.fourth / (s.second * s.second);
    return s.span > 0 ? value : D{} + 3;
  }
  static D energy(const Half& s) { return s.energy; }
  // Levels of sorted values as bytes; how many are equal to the one r places before is how often a
  // cell holds more than r, and gain[r] what that adds. `levels` has VECTOR_BYTES to spare.
  static V entropy(
      const V* sorted, const double* gain, int32_t* wholes, uint8_t* levels, int64_t n) {
    constexpr T half = 0.5 + (sizeof(T) == 4 ? 0x1p-13 : 1e-6);
    V last = {}, low = sorted[0], factor = (T)LEVELS / (sorted[n - 1] - low);
    for (int64_t i = 0; i < n; ++i) {
      V level = (sorted[i] - low) * factor + half;
      last = level < (T)LEVELS ? level : last;  // the second highest level joins the highest
      *(Whole*)(wholes + i * W) = __builtin_convertvector(last, Whole);
    }
    for (int64_t i = 0; i < n * W; ++i) levels[i] = (uint8_t)wholes[i];
    V total = {};
    total += (T)(n * gain[0]);
    constexpr int together = VECTOR_BYTES / W;  // samples in a vector of bytes
    uint8_t ones[2 * VECTOR_BYTES] = {};        // and zeros behind them
    memset(ones, 255, VECTOR_BYTES);
    for (int64_t r = 1; r < n; ++r) {
      V count = {};
      for (int64_t from = r; from < n; from += 248) {  // sums of bytes stay below 256
        int64_t to = from + 248 < n ? from + 248 : n;
        Bytes equal = {};
        int64_t i = from;
        for (; i + together <= to; i += together)
          equal -= (Bytes)(load(levels + i * W) == load(levels + (i - r) * W));
        Bytes rest = (Bytes)(load(levels + i * W) == load(levels + (i - r) * W));
        equal -= rest & load(ones + VECTOR_BYTES - (to - i) * W);
        fold<VECTOR_BYTES>((uint8_t*)&equal);
        Few few;
        memcpy(&few, &equal, W);
        Whole whole = __builtin_convertvector(few, Whole);
        count += __builtin_convertvector(whole, V);
      }
      if (!any(count != 0)) break;
      total += count * (T)(gain[r] - gain[r - 1]);
    }
    return total;
  }
  static D peak_factor(const Half& s) {
    D rms = root(s.energy / s.n);
    D value = s.top / rms;
    return rms > 0 ? value : D{};
  }
  static D rms(const Half& s) { return root(s.energy / s.n); }
  // Between neighbours in time, before values are sorted; in the unit of d.
  static V mean_abs_change(const V* d, int64_t n) {
    V sum = {};
    for (int64_t i = 1; i < n; ++i) sum += magnitude(d[i] - d[i - 1]);
    return sum / (T)(n - 1);
  }
  static D correlation(const Half& s) {
    D value = s.both / root(s.second * s.other);
    return (s.span > 0) & (s.other > 0) ? value : D{};
  }
  static V spectral_centroid(V moment, V total) {
    V value = moment / total;
    return total > 0 ? value : V{};
  }
  static V spectral_spread(
      const V* amplitude, V total, V centre, const double* frequency_hz, int64_t n) {
    V moment = {};
    for (int64_t i = 0; i < n; ++i) {
      V away = (T)frequency_hz[i] - centre;
      moment += away * away * amplitude[i];
    }
    V value = root(moment / total);
    return total > 0 ? value : V{};
  }

  INLINE Bytes load(const uint8_t* from) {
    Bytes bytes;
    memcpy(&bytes, from, sizeof(bytes));
    return bytes;
  }
  template <int N> INLINE void fold(uint8_t* bytes) {
    if constexpr (N > W) {
      typedef uint8_t Part __attribute__((vector_size(N / 2)));
      Part a, b;
      memcpy(&a, bytes, N / 2);
      memcpy(&b, bytes + N / 2, N / 2);
      a += b;
      memcpy(bytes, &a, N / 2);
      fold<N / 2>(bytes);
    }
  }
};

// -- A group of pairs ---------------------------------------------------------------------------------

template <class T> struct Group : Describe<T> {
  using Base = Describe<T>;
  using typename Base::V;
  using Base::get;
  using Base::put;
  static constexpr int W = Base::W, H = Base::H;

  const Plan& plan;
  const Bins& bins;
  int64_t n, num_lines, num_branches, most_taps;
  int64_t bin[W], channel[W], first_bin;  // the bin whose features come first in memory
  int num;             // pairs in it; the other lanes repeat the first
  bool is_broken[W];   // holds NaN or Inf
  double loudest[W];   // size of a sample as given, in the frames of its filter
  D first[H], scale[H], unit[H], span[H];
  D *window[H], *weights[H];  // samples that the filter takes in, and its weights
  D *y[H], *approximation[H], *coefficients[H], *row[H];
  V *raw, *d, *few, *lines, *total;
  int32_t* wholes;
  uint8_t* levels;
  V other;             // sum of squares of raw
  D unknown[H];       // NaN for what is broken, if that is not told otherwise, or 0
  D is_constant[H], centre[H];
  D values[MAX_BRANCHES][H];
  uint32_t need[2 * MAX_BRANCHES + 2];
  double limit;
  void* out;  // features of the first of these bins
  bool out_is_float;

  Group(const Plan& plan, const Bins& bins)
      : plan(plan), bins(bins), n(plan.num_samples), num_lines(plan.num_lines),
        num_branches(plan.num_branches), most_taps(1) {
    for (int64_t c = 0; c < plan.num_channels; ++c)
      if (bins.filters[c].length > most_taps) most_taps = bins.filters[c].length;
  }

  // Bytes of memory wanted; with a place, where everything lies in it.
  size_t place(char* at) {
    char* start = at;
    auto take = [&at](size_t bytes) {
      char* it = at;
      at += (bytes + 2 * VECTOR_BYTES - 1) / VECTOR_BYTES * VECTOR_BYTES;
      return it;
    };
    size_t samples = n + 8, spectrum = 2 * num_lines + 16, most = samples + spectrum;
    for (int h = 0; h < H; ++h) {
      window[h] = (D*)take((samples + most_taps) * sizeof(D));
      weights[h] = (D*)take(most_taps * sizeof(D));
      y[h] = (D*)take(samples * sizeof(D));
      row[h] = (D*)take(samples * sizeof(D));
      approximation[h] = (D*)take(plan.num_coefficients * sizeof(D));
      coefficients[h] = (D*)take(plan.num_coefficients * sizeof(D));
    }
    raw = (V*)take(samples * sizeof(V));
    few = (V*)take(samples * sizeof(V));
    d = (V*)take(most * sizeof(V));
    lines = (V*)take(spectrum * sizeof(V));
    total = (V*)take(spectrum * sizeof(V));
    wholes = (int32_t*)take(most * W * sizeof(int32_t));
    levels = (uint8_t*)take(most * W + VECTOR_BYTES);
    return at - start;
  }

  // Filtered samples less the first of each pair, and its magnitude. What is broken or odd is read
  // as zeros.
  template <class X> void read() {
    int64_t taps = 1;
    for (int k = 0; k < W; ++k) {
      const Filter& filter = bins.filters[channel[k]];
      const X* from = (const X*)bins.samples + bin[k] * bins.bin_stride +
                      channel[k] * bins.channel_stride + filter.start;
      int64_t span = n + filter.length - 1;
      double* to = (double*)window[k / DL] + k % DL;
      for (int64_t i = 0; i < span; ++i) to[i * DL] = (double)from[i];
      for (int64_t i = span; i < n + most_taps - 1; ++i) to[i * DL] = 0;
      to = (double*)weights[k / DL] + k % DL;
      for (int64_t i = 0; i < most_taps; ++i)
        to[i * DL] = i < filter.length ? filter.weights[i] : 0;
      taps = filter.length > taps ? filter.length : taps;
    }
    for (int h = 0; h < H; ++h) {
      settle(h);
      convolve(window[h], weights[h], y[h], taps);
      Extent e = extent(y[h], n);
      span[h] = e.high - e.low;
      scale[h] = larger(e.high, -e.low);
      D inverse = 1 / scale[h];
      unit[h] = scale[h] > 0 ? inverse : D{};
      first[h] = y[h][0];
      for (int64_t i = 0; i < n; ++i) y[h][i] -= first[h];
    }
    if (bins.sensing) note_channels();
  }

  // The size of what was read; lanes that are broken or odd become zeros.
  void settle(int h) {
    D most = {}, finite = D{} + 1;
    for (int64_t i = 0; i < n + most_taps - 1; ++i) {
      D size = magnitude(window[h][i]);
      finite = size <= LARGEST ? finite : D{};
      most = larger(size, most);
    }
    auto is_usual = (most == 0) | ((SMALLEST_USUAL <= most) & (most <= LARGEST_USUAL));
    auto is_read = (finite > 0) & is_usual;
    if (any(~is_read))
      for (int64_t i = 0; i < n + most_taps - 1; ++i)
        window[h][i] = is_read ? window[h][i] : D{};
    for (int k = 0; k < DL; ++k) {
      int64_t lane = h * DL + k;
      is_broken[lane] = !(finite[k] > 0);
      loudest[lane] = most[k];
      bins.is_odd[bin[lane]] |= !is_broken[lane] && !is_usual[k];
    }
    unknown[h] = bins.sensing ? D{} : finite > 0 ? D{} : D{} + (double)NAN;
  }

  void convolve(const D* x, const D* weight, D* out, int64_t taps) {
    for (int64_t i = 0; i < n; i += 4) {  // memory is there for some samples more
      D sums[4] = {};
      for (int64_t k = 0; k < taps; ++k)
#pragma GCC unroll 4
        for (int r = 0; r < 4; ++r) sums[r] += x[i + k + r] * weight[k];
#pragma GCC unroll 4
      for (int r = 0; r < 4; ++r) out[i + r] = sums[r];
    }
  }

  // Which channels are lost (features/sensing.py: is_alive).
  void note_channels() {
    const Sensing& sensing = *bins.sensing;
    for (int k = 0; k < num; ++k) {
      int64_t c = channel[k], at = bin[k] * plan.num_channels + c;
      double own = ((double*)span)[k];
      bool moves = own * sensing.inverse_span[c] > loudest[k] && own >= sensing.floor[c];
      bins.is_lost[at] = is_broken[k] || (n >= FEWEST_SAMPLES && !moves);
      bins.span[at] = is_broken[k] ? NAN : own;
    }
  }

  int64_t num_rows() { return 2 * num_branches + 2; }  // of a channel, the last of which is its bin

  // Features of the group's row to their columns.
  void write(int64_t row_number) {
    for (int i = 0; i < MAX_BRANCHES; ++i)
      for (int h = 0; h < H && need[row_number] >> i & 1; ++h)
        values[i][h] = clamped(values[i][h], limit) + unknown[h];
    for (int k = 0, end; k < num; k = end) {  // lanes of one channel, whose bins follow each other
      for (end = k; end < num && channel[end] == channel[k];) ++end;
      if (out_is_float)
        write((float*)out, row_number, k, end);
      else
        write((double*)out, row_number, k, end);
    }
  }

  template <class X> void write(X* to, int64_t row_number, int start, int end) {
    int64_t at = channel[start] * num_rows() + row_number;
    to += (bin[start] - first_bin) * plan.num_features;
    for (int64_t w = plan.first[at]; w < plan.first[at + 1]; ++w) {
      const double* from = (const double*)values[plan.descriptor[w]];
      X* next = to + plan.column[w];
      for (int k = start; k < end; ++k, next += plan.num_features) *next = (X)from[k];
    }
  }

  // All that is wanted of the rows centre + span * d; sorts d.
  void describe(uint32_t wanted, int64_t count, Half* halves, const V* with, const double* gain,
                bool in_time) {
    Sums<V> s = Base::sums(d, with, count);
    s.other = other;
    for (int h = 0; h < H; ++h) {
      Half& half = halves[h];
      half.n = (double)count;
      for (int i = 0; i < 6; ++i) ((D*)&half)[i] = get((const V*)&s + i, h);
      if (in_time)
        half.energy = half.span * half.span * half.second + half.n * half.centre * half.centre;
      if (wanted & 1u << MEAN) values[MEAN][h] = Base::mean(half);
      if (wanted & 1u << RANGE) values[RANGE][h] = Base::range(half);
      if (wanted & 1u << MEAN_DEVIATION) values[MEAN_DEVIATION][h] = Base::mean_deviation(half);
      if (wanted & 1u << STD) values[STD][h] = Base::std(half);
      if (wanted & 1u << CV) values[CV][h] = Base::cv(half);
      if (wanted & 1u << SKEWNESS) values[SKEWNESS][h] = Base::skewness(half);
      if (wanted & 1u << KURTOSIS) values[KURTOSIS][h] = Base::kurtosis(half);
      if (wanted & 1u << ENERGY) values[ENERGY][h] = Base::energy(half);
      if (wanted & 1u << PEAK_FACTOR) values[PEAK_FACTOR][h] = Base::peak_factor(half);
      if (wanted & 1u << CORRELATION) values[CORRELATION][h] = Base::correlation(half);
      if (wanted & 1u << RMS) values[RMS][h] = Base::rms(half);
    }
    if (wanted & 1u << MEAN_ABS_CHANGE) {
      V change = Base::mean_abs_change(d, count);
      for (int h = 0; h < H; ++h) values[MEAN_ABS_CHANGE][h] = halves[h].span * get(&change, h);
    }
    if (!(wanted & ORDERED)) return;
    sort(d, (int)count);
    V tolerance, order[4] = {};
    for (int h = 0; h < H; ++h) {
      D near = 1e-12 * scale[h] / halves[h].span + (sizeof(T) == 4 ? 0x1p-22 : 0.0);
      put(&tolerance, h, halves[h].span > 0 ? near : D{} + 1);
    }
    order[0] = Base::median(d, count);
    if (wanted & 1u << MODE) order[1] = Base::mode(d, tolerance, count);
    order[2] = Base::iqr(d, count);
    if (wanted & 1u << ENTROPY) order[3] = Base::entropy(d, gain, wholes, levels, count);
    for (int h = 0; h < H; ++h) {
      D centre = halves[h].centre, span = halves[h].span;
      values[MEDIAN][h] = centre + span * get(order + 0, h);
      values[MODE][h] = centre + span * get(order + 1, h);
      values[IQR][h] = span * get(order + 2, h);
      values[ENTROPY][h] = span > 0 ? get(order + 3, h) : D{};
    }
    if (sizeof(T) == 4 && in_time && (wanted & (1u << MEDIAN | 1u << IQR))) uncrowd(halves);
  }

  // Where float values crowd about the median or between the quartiles, of a quiet bin with a tap
  // say, their rounding is no small part of the result: the row is sorted in double.
  void uncrowd(const Half* halves) {
    int64_t few_values = n / 25, half = n / 2;
    int64_t high = half + few_values < n ? half + few_values : n - 1;
    int64_t low = half - 1 - few_values > 0 ? half - 1 - few_values : 0;
    V about = d[high] - d[low], spread = Base::iqr(d, n);
    auto is_crowded = (about < (T)CROWDED) | (spread < (T)CROWDED);
    if (!any(is_crowded)) return;
    V chosen = is_crowded ? V{} + 1 : V{};
    for (int h = 0; h < H; ++h) {
      sort(row[h], (int)n);
      auto take = (get(&chosen, h) > 0) & (halves[h].span > 0);
      // the row lies in memory less a constant, which is the centre less its mean
      D exact = Describe<double>::median(row[h], n) + (halves[h].centre - centre[h]);
      values[MEDIAN][h] = take ? exact : values[MEDIAN][h];
      values[IQR][h] = take ? Describe<double>::iqr(row[h], n) : values[IQR][h];
    }
  }

  // The row in memory, less `offset`: is it constant, and at what; its descriptors, if wanted.
  void describe_time(uint32_t wanted, bool keeps_first, const V* with, int64_t row_number) {
    Half halves[H];
    for (int h = 0; h < H; ++h) {
      Extent e = extent(row[h], n);
      D span = e.high - e.low, offset = keeps_first ? first[h] : D{};
      auto constant = span * (1 / NOISE) < scale[h];
      span = constant ? D{} : span;
      D middle = e.mean + offset;
      if (!keeps_first) middle = constant ? D{} : middle;
      halves[h].centre = middle;
      halves[h].span = span;
      halves[h].top = span > 0 ? e.high + offset : middle;
      is_constant[h] = constant ? D{} + 1 : D{};
      centre[h] = e.mean;
    }
    if (wanted) {
      for (int h = 0; h < H; ++h) {
        D mean = centre[h], factor = 1 / halves[h].span;
        factor = halves[h].span > 0 ? factor : D{};
        for (int64_t i = 0; i < n; ++i) put(d + i, h, (row[h][i] - mean) * factor);
      }
      describe(wanted, n, halves, with, plan.gain_time, true);
      write(row_number);
    }
    for (int h = 0; h < H; ++h) centre[h] = halves[h].centre;
  }

  // The spectrum |gain * spectrum + offset * ones| in the unit of the channel: its energy.
  void describe_lines(
      uint32_t wanted, const V* spectrum, bool keeps_first, D* energies, int64_t row_number) {
    V gain, offset, energy = {}, most = {};
    for (int h = 0; h < H; ++h) {
      auto constant = is_constant[h] > 0;
      put(&gain, h, constant ? D{} : D{} + 1);
      put(&offset, h, (constant ? centre[h] : keeps_first ? first[h] : D{}) * unit[h]);
    }
    const T* ones = (const T*)plan.ones;
    int64_t count = num_lines;
    for (int64_t i = 0; i < count; ++i) {
      V real = gain * spectrum[i] + offset * ones[i];
      V imaginary = gain * spectrum[count + i] + offset * ones[count + i];
      V square = real * real + imaginary * imaginary;
      d[i] = square;
      energy += square;
      most = larger(most, square);
    }
    for (int h = 0; h < H; ++h) energies[h] = get(&energy, h);
    if (!wanted) return;
    V inverse = 1 / most, low = V{} + 1, high = {}, sum = {}, moment = {};
    inverse = most > 0 ? inverse : V{};
    for (int64_t i = 0; i < count; ++i) {
      V amplitude = root(d[i] * inverse);
      d[i] = amplitude;
      sum += amplitude;
      moment += amplitude * (T)plan.frequency_hz[i];
      low = smaller(low, amplitude);
      high = larger(high, amplitude);
    }
    if (wanted & WEIGHTED) {
      V centroid = Base::spectral_centroid(moment, sum), spread = {};
      if (wanted & 1u << SPECTRAL_SPREAD)
        spread = Base::spectral_spread(d, sum, centroid, plan.frequency_hz, count);
      for (int h = 0; h < H; ++h) {
        values[SPECTRAL_CENTROID][h] = get(&centroid, h);
        values[SPECTRAL_SPREAD][h] = get(&spread, h);
      }
    }
    V mean = sum / (T)count, span = high - low, factor = 1 / span;
    factor = span > 0 ? factor : V{};
    for (int64_t i = 0; i < count; ++i) d[i] = (d[i] - mean) * factor;
    Half halves[H];
    for (int h = 0; h < H; ++h) {
      D size = scale[h] * root(get(&most, h));
      halves[h].centre = size * get(&mean, h);
      halves[h].span = size * get(&span, h);
      halves[h].top = size;
      halves[h].energy = scale[h] * scale[h] * energies[h];
    }
    describe(wanted, count, halves, nullptr, plan.gain_lines, false);
    write(row_number);
  }

  // The bin itself.
  void describe_raw() {
    int64_t row_number = num_rows() - 1;
    if (!need[row_number]) return;
    for (int h = 0; h < H; ++h) memcpy(row[h], y[h], n * sizeof(D));
    other = V{};
    describe_time(need[row_number], true, nullptr, row_number);
  }

  void describe_branches() {
    uint32_t shares = need[2 * num_branches];
    int64_t levels_wanted = 0;
    for (int64_t b = 0; b < num_branches; ++b)
      if (need[b] || need[num_branches + b] || shares) levels_wanted = b / 2 + 1;
    if (!levels_wanted) return;
    for (int h = 0; h < H; ++h) {  // the bin itself, for correlation
      Extent e = extent(y[h], n);
      D span = e.high - e.low, factor = 1 / span;
      factor = span * (1 / NOISE) < scale[h] ? D{} : factor;
      factor = span > 0 ? factor : D{};
      for (int64_t i = 0; i < n; ++i) put(raw + i, h, (y[h][i] - e.mean) * factor);
    }
    other = V{};
    for (int64_t i = 0; i < n; ++i) other += raw[i] * raw[i];
    // coefficients, finest first; those of level m lie from `starts[m]` on
    int64_t starts[MAX_BRANCHES / 2 + 1] = {0};
    for (int64_t m = 0; m < levels_wanted; ++m)
      for (int h = 0; h < H; ++h) {
        const D* from = m ? approximation[h] + starts[m - 1] : y[h];
        product<4, double>(plan.low[m], from, approximation[h] + starts[m]);
        product<4, double>(plan.high[m], from, coefficients[h] + starts[m]);
        starts[m + 1] = starts[m] + 4 * plan.low[m].num_blocks;
      }
    D energies[MAX_BRANCHES][H];
    bool has_total = false;  // the spectrum of the approximation last formed
    int64_t finest = levels_wanted;  // level whose approximation's spectrum is wanted
    for (int64_t m = levels_wanted - 1; m >= 0; --m)
      if (need[num_branches + 2 * m] || shares) finest = m;
    for (int64_t m = levels_wanted - 1; m >= 0; --m) {
      const uint32_t *in_time = need + 2 * m, *in_lines = need + num_branches + 2 * m;
      bool wants_a = in_lines[0] || shares, wants_d = in_lines[1] || shares;
      if (in_time[0] || wants_a) form(2 * m, approximation, starts[m], in_time[0]);
      if (wants_a) {
        if (!has_total) spectrum_of(2 * m, approximation, starts[m], total);
        has_total = true;
        describe_lines(in_lines[0], total, true, energies[2 * m], num_branches + 2 * m);
      }
      if (in_time[1] || wants_d) form(2 * m + 1, coefficients, starts[m], in_time[1]);
      bool is_added = has_total && finest < m;
      if (wants_d || is_added) spectrum_of(2 * m + 1, coefficients, starts[m], lines);
      if (is_added)
        for (int64_t i = 0; i < 2 * num_lines; ++i) total[i] += lines[i];
      if (wants_d)
        describe_lines(in_lines[1], lines, false, energies[2 * m + 1], num_branches + 2 * m + 1);
    }
    if (shares) band_energy_ratio(energies);
  }

  void form(int64_t branch, D* const* from, int64_t start, uint32_t wanted) {
    for (int h = 0; h < H; ++h) product<4, double>(plan.out[branch], from[h] + start, row[h]);
    describe_time(wanted, branch % 2 == 0, raw, branch);
  }

  void spectrum_of(int64_t branch, D* const* from, int64_t start, V* to) {
    for (int h = 0; h < H; ++h)
      for (int64_t k = 0; k < plan.lines[branch].num_columns; ++k)
        put(few + k, h, from[h][start + k] * unit[h]);
    product<8, T>(plan.lines[branch], few, to);
  }

  // Each branch's share of the energy of all spectra; 0 if all are zero.
  void band_energy_ratio(const D (*energies)[H]) {
    for (int h = 0; h < H; ++h) {
      D sum = {};
      for (int64_t b = 0; b < num_branches; ++b) sum += energies[b][h];
      for (int64_t b = 0; b < num_branches; ++b) {
        D value = energies[b][h] / sum;
        values[b][h] = sum > 0 ? value : D{};
      }
    }
    write(2 * num_branches);
  }

  // What is wanted of any of the pairs' channels.
  void gather_needs() {
    for (int64_t r = 0; r < num_rows(); ++r) {
      need[r] = 0;
      for (int k = 0; k < num; ++k) need[r] |= plan.need[channel[k] * num_rows() + r];
    }
  }
};

// -- Pooling over channels, scaling and head --------------------------------------------------------

// log(1 + x) for x >= 0, as fdlibm has it: an error below 1 ulp.
INLINE D log1p_of(D x) {
  typedef uint64_t Bits __attribute__((vector_size(VECTOR_BYTES)));
  constexpr double ln2_hi = 6.93147180369123816490e-01, ln2_lo = 1.90821492927058770002e-10;
  D u = 1 + x, lost = x < 1 ? x - (u - 1) : 1 - (u - x);
  Bits bits = (Bits)u + (0x3ff0000000000000 - 0x3fe6a09e00000000);  // mantissas from sqrt(1/2)
  D k = (D)((bits >> 52) + (0x4338000000000000 - 0x3ff)) - 0x1.8p52;
  D f = (D)((bits & 0x000fffffffffffff) + 0x3fe6a09e00000000) - 1;
  D s = f / (2 + f), z = s * s, half = 0.5 * f * f;
  D r = z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 +
        z * (2.857142874366239149e-01 + z * (2.222219843214978396e-01 +
        z * (1.818357216161805012e-01 + z * (1.531383769920937332e-01 +
        z * 1.479819860511658591e-01))))));
  return k * ln2_hi - ((half - (s * (half + r) + (k * ln2_lo + lost / u))) - f);
}

// sign(x) scale log(1 + |x| / scale)
INLINE D signed_log(D x, D scale) {
  D size = x < 0 ? -x : x, ratio = size / scale, bent = scale * log1p_of(ratio);
  auto is_far = ratio > LARGEST;
  if (any(is_far))
    for (int k = 0; k < DL; ++k)
      if (is_far[k]) bent[k] = scale[k] * fmax(log(fmax(size[k], scale[k])) - log(scale[k]), 0x1.62e42fefa39efp9);
  bent = ratio < 0x1p-1022 ? size : bent;  // a denormal ratio has lost its digits
  return x < 0 ? -bent : bent;
}

// What lanes run across: a few bins, or, of one bin alone, its families, scaled columns and rows of
// the head. Each number is made by the same operations in the same order, so scores are the same.
enum Across { BINS, ONE_BIN };

constexpr int64_t filled_up(int64_t num) { return (num + WHOLE - 1) / WHOLE * WHOLE; }

struct Judge {
  const Machine& machine;
  D *x, *y, *z;  // [inputs], [columns], [scaled]: of a few bins, or of one in as many doubles
  D *values, *sorted, *in_use;  // [channels]
  int64_t at;                   // the first of these bins
  int few;
  const uint8_t* is_lost;  // of these bins

  explicit Judge(const Machine& machine) : machine(machine) {}

  size_t place(char* at) {
    int64_t most = machine.most_channels;
    x = (D*)at;
    y = x + machine.num_inputs;
    z = y + machine.num_columns;
    values = z + filled_up(machine.num_scaled);
    sorted = values + most;
    in_use = sorted + most;
    return (in_use + most - x) * sizeof(D);
  }

  // Of inputs of bins from `start` on.
  void judge(const double* inputs, int64_t stride, int64_t start, int64_t num, const Bins& bins) {
    for (int64_t b = 0; b < num; b += few) {
      at = start + b;
      few = (int)(num - b < DL ? num - b : DL);
      if (2 * few <= DL) few = 1;  // up to here it is quicker
      is_lost = bins.is_lost ? bins.is_lost + at * machine.num_channels : nullptr;
      if (few == 1)
        judge_few<ONE_BIN>(inputs + b * stride, stride, bins);
      else
        judge_few<BINS>(inputs + b * stride, stride, bins);
    }
  }

  template <Across ACROSS>
  void judge_few(const double* inputs, int64_t stride, const Bins& bins) {
    const Machine& m = machine;
    for (int64_t i = 0; i < m.num_inputs; ++i)
      for (int k = 0; k < (ACROSS == BINS ? DL : 1); ++k)
        of<ACROSS>(x, i, k) = inputs[(k < few ? k : 0) * stride + i];
    for (int64_t i = 0; i < m.num_singles; ++i)
      for (int k = 0; k < (ACROSS == BINS ? DL : 1); ++k)
        of<ACROSS>(y, m.single_columns[i], k) = of<ACROSS>(x, m.single_inputs[i], k);
    for (int64_t p = 0; p < m.num_pools; ++p) pool<ACROSS>(m.pools[p]);
    for (int64_t i = 0; i < m.num_scaled; i += step<ACROSS>()) scale<ACROSS>(i);
    for (int k = 0; m.imputation && is_lost && k < few; ++k)
      for (int64_t i = 0; i < m.num_scaled; ++i)
        if (m.channels[i] >= 0 && is_lost[k * m.num_channels + m.channels[i]])
          of<ACROSS>(z, i, k) = m.imputation[i];
    for (int k = 0; bins.scaled && k < few; ++k)
      for (int64_t i = 0; i < m.num_scaled; ++i)
        bins.scaled[(at + k) * m.num_scaled + i] = of<ACROSS>(z, i, k);
    if (!bins.score) return;
    D score = clamped(head<ACROSS>(), bins.score_as_float ? LARGEST_FLOAT : LARGEST);
    for (int k = 0; k < few; ++k)
      bins.score[at + k] = bins.is_valid && !bins.is_valid[at + k] ? NAN : score[k];
  }

  // Families, scaled columns or rows that one vector holds.
  template <Across ACROSS> static constexpr int step() { return ACROSS == BINS ? 1 : DL; }

  // A number of a bin.
  template <Across ACROSS> static double& of(D* rows, int64_t i, int k) {
    return ((double*)rows)[ACROSS == BINS ? i * DL + k : i];
  }

  // One vector of numbers that are there once for each family, scaled column or row.
  template <Across ACROSS> static D constants(const double* from) {
    D found = D{} + *from;
    if (ACROSS == ONE_BIN) memcpy(&found, from, sizeof(D));
    return found;
  }

  // One vector of inputs or columns.
  template <Across ACROSS> static D gathered(const D* from, const int64_t* places) {
    if (ACROSS == BINS) return from[*places];
    D found;
    for (int k = 0; k < DL; ++k) found[k] = ((const double*)from)[places[k]];
    return found;
  }

  template <Across ACROSS> void pool(const Pool& p) {
    int64_t stride = filled_up(p.num_families);
    D count = {};
    for (int64_t c = 0; c < p.num_channels; ++c) {
      in_use[c] = D{} + 1;
      for (int k = 0; is_lost && k < few; ++k)
        if (is_lost[k * machine.num_channels + p.channels[c]]) {
          if (ACROSS == BINS)
            in_use[c][k] = 0;
          else
            in_use[c] = D{};
        }
      count += in_use[c];
    }
    for (int64_t r = 0; r < p.num_families; r += step<ACROSS>()) {
      D mean = {}, square = {}, low = {}, high = {}, last = {};
      D scale = constants<ACROSS>(p.scales + r);
      for (int64_t c = 0; c < p.num_channels; ++c) {
        D value = signed_log(gathered<ACROSS>(x, p.inputs + c * stride + r), scale);
        values[c] = in_use[c] > 0 ? value : D{};
        mean += values[c];
        last = larger(last, values[c]);
      }
      mean /= larger(count, D{} + 1);
      for (int64_t c = 0; c < p.num_channels; ++c) {
        D away = (values[c] - mean) * in_use[c];  // a channel that is not in use stands at the mean
        square += away * away;
        low = smaller(low, away);
        high = larger(high, away);
      }
      bool is_sorted = false;
      for (int64_t s = 0; s < p.num_statistics; ++s) {
        const int64_t* columns = p.columns + s * stride + r;
        bool is_wanted = false;
        for (int k = 0; k < step<ACROSS>(); ++k) is_wanted |= columns[k] >= 0;
        if (!is_wanted) continue;
        D found = mean;
        if (p.statistics[s] == POOLED_STD) found = root(square / larger(count - 1, D{} + 1));
        if (p.statistics[s] == POOLED_MIN) found = low + mean;
        if (p.statistics[s] == POOLED_MAX) found = high + mean;
        if (p.statistics[s] == POOLED_ORDER) {
          if (!is_sorted)  // those not in use come last
            for (int64_t c = 0; c < p.num_channels; ++c)
              sorted[c] = in_use[c] > 0 ? values[c] : last;
          if (!is_sorted) sort_looped(sorted, (int)p.num_channels);
          is_sorted = true;
          found = mean - mean;  // NaN stays NaN
          for (int64_t c = 0; c < p.num_channels; ++c) {
            D weight = 1 - magnitude((count - 1) * p.fractions[s] - (double)c);
            found += weight > 0 ? sorted[c] * weight : D{};  // linear interpolation
          }
        }
        if (ACROSS == BINS) y[*columns] = count > 0 ? found : D{} + machine.fill[*columns];
        for (int k = 0; ACROSS == ONE_BIN && k < DL; ++k)
          if (columns[k] >= 0)
            of<ACROSS>(y, columns[k], 0) = count[0] > 0 ? found[k] : machine.fill[columns[k]];
      }
    }
  }

  template <Across ACROSS> void scale(int64_t i) {
    const Machine& m = machine;
    D value = gathered<ACROSS>(y, m.sources + i);
    if (m.compression) value = signed_log(value, constants<ACROSS>(m.compression + i));
    if (m.minimum) {
      D low = constants<ACROSS>(m.minimum + i), width = constants<ACROSS>(m.maximum + i) - low;
      D scaled = clamped(2 * ((value - low) / width) - 1, 1);
      value = width > 0 ? scaled : value - value;  // 0; NaN stays NaN
    }
    z[i / step<ACROSS>()] = value;
  }

  // The scores of a few bins, or that of one in lane 0.
  template <Across ACROSS> D head() {
    const Machine& m = machine;
    constexpr int rows = ACROSS == BINS ? WHOLE / 2 : WHOLE, num = rows / step<ACROSS>();
    for (int64_t i = m.num_scaled; i < filled_up(m.num_scaled); ++i)
      for (int k = 0; k < (ACROSS == BINS ? DL : 1); ++k) of<ACROSS>(z, i, k) = 0;
    D sums = D{} + m.constant;
    int64_t num_quadratic = m.signs ? 0 : m.num_quadratic;
    for (int64_t i = 0; i < m.num_scaled; i += rows) {
      D pull[num];
      for (int v = 0; v < num; ++v) pull[v] = constants<ACROSS>(m.linear + i + v * step<ACROSS>());
      const double* block = m.quadratic + i / WHOLE * WHOLE * num_quadratic + i % WHOLE;
      int64_t reach = i + rows < num_quadratic ? i + rows : num_quadratic;
      for (int64_t j = 0; i < num_quadratic && j < reach; ++j) {
        D other = ACROSS == BINS ? z[j] : D{} + of<ACROSS>(z, j, 0);
#pragma GCC unroll 4
        for (int v = 0; v < num; ++v)
          pull[v] += other * constants<ACROSS>(block + WHOLE * j + v * step<ACROSS>());
      }
      for (int v = 0; v < num; ++v) {
        D terms = pull[v] * z[i / step<ACROSS>() + v];
        if (ACROSS == BINS) sums += terms;
        for (int k = 0; ACROSS == ONE_BIN && k < DL; ++k) sums[0] += terms[k];
      }
    }
    if (m.signs) factors<ACROSS>(sums);
    return sums;
  }

  // Add the squares of the products with the factors. There are few rows and many columns, so each
  // product is summed in PARTS, which do not wait for each other.
  template <Across ACROSS> void factors(D& sums) {
    const Machine& m = machine;
    constexpr int PARTS = 4, rows = ACROSS == BINS ? 4 : WHOLE, num = rows / step<ACROSS>();
    for (int64_t i = 0; i < m.num_factors; i += rows) {
      const double* block = m.quadratic + i / WHOLE * WHOLE * m.num_quadratic + i % WHOLE;
      D pull[PARTS][num] = {};
      for (int64_t j = 0; j < m.num_quadratic; j += PARTS) {
#pragma GCC unroll 4
        for (int p = 0; p < PARTS; ++p) {
          D other = ACROSS == BINS ? z[j + p] : D{} + of<ACROSS>(z, j + p, 0);
#pragma GCC unroll 4
          for (int v = 0; v < num; ++v)
            pull[p][v] += other * constants<ACROSS>(block + WHOLE * (j + p) + v * step<ACROSS>());
        }
      }
      for (int v = 0; v < num; ++v) {
        D whole = (pull[0][v] + pull[1][v]) + (pull[2][v] + pull[3][v]);
        D terms = whole * whole * constants<ACROSS>(m.signs + i + v * step<ACROSS>());
        if (ACROSS == BINS) sums += terms;
        for (int k = 0; ACROSS == ONE_BIN && k < DL; ++k) sums[0] += terms[k];
      }
    }
  }
};

// Which bins are valid, and which in range (features/sensing.py: is_enough).
void judge_channels(const Plan& plan, const Bins& bins, int64_t start, int64_t num_bins) {
  const Sensing& sensing = *bins.sensing;
  for (int64_t b = start; b < start + num_bins; ++b) {
    int64_t num_alive = 0, num_fit = 0;
    for (int64_t c = 0, at = b * plan.num_channels; c < plan.num_channels; ++c, ++at) {
      bool counts = sensing.counted[c] && !bins.is_lost[at];
      num_alive += counts;
      num_fit += counts && bins.span[at] >= sensing.low[c] && bins.span[at] <= sensing.high[c];
    }
    bins.is_valid[b] = num_alive >= sensing.min_alive;
    bins.in_range[b] = bins.is_valid[b] && 2 * num_fit >= num_alive;
  }
}

// -- What the door calls -----------------------------------------------------------------------------

template <class T> int run(const Plan& plan, const Machine* machine, const Bins& bins) {
  constexpr int W = Group<T>::W;
  alignas(VECTOR_BYTES) Group<T> group(plan, bins);
  const Machine nothing = {};
  Judge judge(machine ? *machine : nothing);
  size_t of_group = group.place(nullptr), of_judge = judge.place(nullptr) + VECTOR_BYTES;
  size_t of_features = machine ? CHUNK * plan.num_features * sizeof(double) : 0;
  char* memory = (char*)malloc(of_group + of_judge + of_features + 2 * VECTOR_BYTES);
  if (!memory) return 1;
  char* at = (char*)(((uintptr_t)memory + VECTOR_BYTES - 1) / VECTOR_BYTES * VECTOR_BYTES);
  group.place(at);
  judge.place(at += of_group);
  double* features = (double*)(at + of_judge);
  group.out_is_float = !machine && bins.features_are_float;
  group.limit = group.out_is_float ? LARGEST_FLOAT : LARGEST;
  const int64_t* channels[2] = {plan.slow, plan.fast};
  const int64_t counts[2] = {plan.num_slow, plan.num_fast};
  for (int64_t start = 0; start < bins.num_bins; start += CHUNK) {
    int64_t num_bins = bins.num_bins - start < CHUNK ? bins.num_bins - start : CHUNK;
    group.first_bin = machine ? start : 0;
    group.out = machine ? features : bins.features;
    for (int kind = 0; kind < 2; ++kind) {
      int64_t num_pairs = counts[kind] * num_bins;
      for (int64_t from = 0; from < num_pairs; from += W) {
        group.num = (int)(num_pairs - from < W ? num_pairs - from : W);
        for (int k = 0; k < W; ++k) {
          int64_t pair = from + (k < group.num ? k : 0);
          group.bin[k] = start + pair % num_bins;
          group.channel[k] = channels[kind][pair / num_bins];
        }
        group.gather_needs();
        if (bins.is_float)
          group.template read<float>();
        else
          group.template read<double>();
        group.describe_raw();
        if (kind == 1) group.describe_branches();
      }
    }
    int64_t stride = plan.num_features ? plan.num_features : bins.bin_stride;
    const double* given = (const double*)bins.samples + start * stride;
    if (bins.sensing) judge_channels(plan, bins, start, num_bins);
    if (machine) judge.judge(plan.num_features ? features : given, stride, start, num_bins, bins);
  }
  free(memory);
  return 0;
}

}  // namespace

// Without a plan, samples are the machine's inputs.
extern "C" int FEATURES_ENTRY(const Plan* plan, const Machine* machine, const Bins* bins) {
  const Plan nothing = {};
  if (!plan) return run<double>(nothing, machine, *bins);
  return plan->is_float ? run<float>(*plan, machine, *bins) : run<double>(*plan, machine, *bins);
}
