// Features of filtered bins, in the order and under the names of features/descriptors.py.
//
// Lanes run across (bin, channel) pairs: element k of every vector belongs to pair k of a group, so
// a line of code reads like its formula. A row (a channel's bin, a branch of a fast channel or
// its spectrum) is formed by products with given matrices, less its channel's first sample, and
// brought to order one before it is described: row = centre + span * d. One sort of d feeds median,
// mode, iqr and entropy.
//
// This file is compiled once for each instruction set (dispatch.cpp chooses), for float and double.
// Only vector types are used that GCC and clang share, no intrinsics, and nothing of the C++ runtime.

#include "engine.h"
#include "vectors.h"

namespace {

constexpr double CV_FLOOR = 1e-6;       // part of the rms that the mean counts as at least
constexpr double CV_ZERO = 1e-12;       // part of it within which a mean has no sign
constexpr double CROWDED = 2e-3;        // part of a row's span; float rounds to 3e-8 of it
constexpr double NEAR_ONE = 0.99;       // correlation from which on float takes another formula
constexpr double LEVELS = 255;          // of entropy's histogram, less one
constexpr int FEWEST_SAMPLES = 16;      // of a bin that may be silent
constexpr int CHUNK = 32;               // bins whose features are made before they are scored

constexpr uint32_t ORDERED = 1u << MEDIAN | 1u << MODE | 1u << IQR | 1u << ENTROPY;
constexpr uint32_t WEIGHTED = 1u << SPECTRAL_CENTROID | 1u << SPECTRAL_SPREAD;

typedef uint8_t Bytes __attribute__((vector_size(VECTOR_BYTES)));

// -- Products ------------------------------------------------------------------------------------

// out = matrix * x, a block of rows at a time, which has its own columns that are not zero.
template <class E, class V> INLINE void product(const Matrix<E>& matrix, const V* x, V* out) {
  const E* values = matrix.values;
  for (int32_t block = 0; block < matrix.num_blocks; ++block) {
    V sums[ROWS] = {};
    const V* from = x + matrix.first[block];
    for (int32_t k = 0; k < matrix.width; ++k, values += ROWS)
#pragma GCC unroll 8
      for (int r = 0; r < ROWS; ++r) sums[r] += from[k] * values[r];
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; ++r) out[block * ROWS + r] = sums[r];
  }
}

// a / b; 0 where b is not positive.
template <class V> INLINE V over(V a, V b) {
  V value = a / b;
  return b > 0 ? value : V{};
}

template <class V> struct Extent {
  V low, high, mean;
};
// In parts that do not wait for each other.
template <class V> INLINE Extent<V> extent(const V* row, int32_t n) {
  constexpr int PARTS = 4;
  V low[PARTS], high[PARTS], total[PARTS] = {};
  for (int p = 0; p < PARTS; ++p) low[p] = high[p] = row[0];
  auto take = [&](int p, V x) {
    low[p] = smaller(low[p], x);
    high[p] = larger(high[p], x);
    total[p] += x;
  };
  int32_t i = 0;
  for (; i + PARTS <= n; i += PARTS)
#pragma GCC unroll 4
    for (int p = 0; p < PARTS; ++p) take(p, row[i + p]);
  for (; i < n; ++i) take(0, row[i]);
  V mean = ((total[0] + total[1]) + (total[2] + total[3])) / (decltype(row[0][0] + 0))n;
  return {smaller(smaller(low[0], low[1]), smaller(low[2], low[3])),
          larger(larger(high[0], high[1]), larger(high[2], high[3])), mean};
}

// -- Descriptors of W rows at once ------------------------------------------------------------------

template <class E> struct Describe {
  static constexpr int W = Lanes<E>::NUM;
  typedef typename Lanes<E>::V V;
  typedef typename Lanes<E>::Whole Whole;
  typedef typename Lanes<E>::Few Few;

  // What descriptors are made of: row = centre + span * d. Sums are in the unit of d.
  struct Row {
    V first, second, third, fourth, both, other;
    V centre, span, top, energy;
    E n;
  };

  // Makes d = (x - mean) * factor, and the sums; x may be d.
  INLINE void sum(Row& row, const V* x, V mean, V factor, V* d, const V* other, int32_t n) {
    V first = {}, second = {}, third = {}, fourth = {}, both = {};
    for (int32_t i = 0; i < n; ++i) {
      V v = (x[i] - mean) * factor, w = v * v;
      d[i] = v;
      first += magnitude(v);
      second += w;
      third += w * v;
      fourth += w * w;
      if (other) both += v * other[i];
    }
    row.first = first, row.second = second, row.third = third, row.fourth = fourth, row.both = both;
    row.n = (E)n;
  }

  static V median(const V* sorted, int32_t n) {
    return n % 2 ? sorted[n / 2] : (sorted[n / 2 - 1] + sorted[n / 2]) * (E)0.5;
  }
  // The first value of the first longest run of neighbours within the tolerance.
  static V mode(const V* sorted, V tolerance, int32_t n) {
    V start = sorted[0], best = start, run = {}, longest = {};
    for (int32_t i = 1; i < n; ++i) {
      auto is_near = sorted[i] - sorted[i - 1] <= tolerance;
      start = is_near ? start : sorted[i];
      run = is_near ? run + (E)1 : V{};
      best = run > longest ? start : best;
      longest = larger(longest, run);
    }
    return best;
  }
  static V mean_deviation(const Row& s) { return s.span * s.first / s.n; }
  static V std(const Row& s) { return s.span * root(s.second / (s.n - 1)); }
  static V cv(const Row& s) {
    V rms = root(s.energy / s.n), floor = larger(magnitude(s.centre), (E)CV_FLOOR * rms);
    V value = std(s) / (s.centre < (E)-CV_ZERO * rms ? -floor : floor);
    return s.span > 0 ? value : V{};
  }
  static V quantile(const V* sorted, double q, int32_t n) {
    double position = q * n - 0.5;
    position = position < 0 ? 0 : position > n - 1 ? n - 1 : position;
    int32_t below = (int32_t)position, above = below + 1 < n ? below + 1 : n - 1;
    E part = (E)(position - below);
    return sorted[below] * (1 - part) + sorted[above] * part;
  }
  // Between quantiles at Hazen's positions.
  static V iqr(const V* sorted, int32_t n) {
    return quantile(sorted, 0.75, n) - quantile(sorted, 0.25, n);
  }
  static V skewness(const Row& s) {
    V value = s.third * root(s.n / s.second) / s.second;
    return s.span > 0 ? value : V{};
  }
  static V kurtosis(const Row& s) {
    V value = s.n * s.fourth / (s.second * s.second);
    return s.span > 0 ? value : V{} + 3;
  }
  // Levels of sorted values as bytes; how many are equal to the one r places before is how often a
  // cell holds more than r, and gain[r] what that adds. `levels` has VECTOR_BYTES to spare.
  static V entropy(const V* sorted, const E* gain, int32_t* wholes, uint8_t* levels, int32_t n) {
    V last = {}, low = sorted[0], factor = (E)LEVELS / (sorted[n - 1] - low);
    for (int32_t i = 0; i < n; ++i) {
      V level = (sorted[i] - low) * factor + Limits<E>::HALF;
      last = level < (E)LEVELS ? level : last;  // the second highest level joins the highest
      *(Whole*)(wholes + i * W) = __builtin_convertvector(last, Whole);
    }
    for (int32_t i = 0; i < n * W; ++i) levels[i] = (uint8_t)wholes[i];
    V total = V{} + n * gain[0];
    constexpr int together = VECTOR_BYTES / W;  // samples in a vector of bytes
    uint8_t ones[2 * VECTOR_BYTES] = {};        // and zeros behind them
    memset(ones, 255, VECTOR_BYTES);
    for (int32_t r = 1; r < n; ++r) {
      V count = {};
      for (int32_t from = r; from < n; from += 248) {  // sums of bytes stay below 256
        int32_t to = from + 248 < n ? from + 248 : n;
        Bytes equal = {};
        int32_t i = from;
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
      total += count * gain[r];
    }
    return total;
  }
  static V peak_factor(const Row& s) { return over(s.top, rms(s)); }
  static V rms(const Row& s) { return root(s.energy / s.n); }
  // Between neighbours in time, before values are sorted.
  static V mean_abs_change(const Row& s, const V* d, int32_t n) {
    V sum = {};
    for (int32_t i = 1; i < n; ++i) sum += magnitude(d[i] - d[i - 1]);
    return s.span * (sum / (E)(n - 1));
  }
  // Near 1 it is 1 less half the square of the distance of both as unit vectors: float rounds sums to
  // 1e-7 of them, which is a large part of what is missing to 1.
  static V correlation(const Row& s, const V* d, const V* with, int32_t n) {
    V value = s.both / root(s.second * s.other);
    auto is_near = value > (E)NEAR_ONE;
    if (sizeof(E) == 4 && any(is_near)) {
      V own = 1 / root(s.second), its = 1 / root(s.other), square = {};
      for (int32_t i = 0; i < n; ++i) {
        V apart = d[i] * own - with[i] * its;
        square += apart * apart;
      }
      value = is_near ? 1 - (E)0.5 * square : value;
    }
    return (s.span > 0) & (s.other > 0) ? value : V{};
  }
  static V spectral_spread(const V* amplitude, V total, V centre, const E* frequency_hz, int32_t n) {
    V moment = {};
    for (int32_t i = 0; i < n; ++i) {
      V away = frequency_hz[i] - centre;
      moment += away * away * amplitude[i];
    }
    return root(over(moment, total));
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

template <class E> struct Group : Describe<E> {
  using Base = Describe<E>;
  using typename Base::Row;
  using typename Base::V;
  static constexpr int W = Base::W;

  const Plan<E>& plan;
  const Bins<E>& bins;
  int32_t n, num_lines, num_branches, most_taps;
  int32_t bin[W], channel[W], first_bin;  // the bin whose features come first in memory
  int num;            // pairs in it; the other lanes repeat the first
  bool is_broken[W];  // holds NaN or Inf
  E loudest[W];       // size of a sample as given, in the frames of its filter
  V first, scale, unit, span;
  V quiet;  // a row whose span is below is rounding
  V *window, *weights;  // samples that the filter takes in, and its weights
  V *y, *approximation, *coefficients, *row, *raw, *d, *few, *lines, *total;
  int32_t* wholes;
  uint8_t* levels;
  V other;    // sum of squares of raw
  V unknown;  // NaN for what is broken, if that is not told otherwise, or 0
  V is_constant, centre;
  V values[MAX_BRANCHES];
  uint32_t need[2 * MAX_BRANCHES + 2];
  E limit;
  void* out;  // features of the first of these bins
  bool out_is_float;

  Group(const Plan<E>& plan, const Bins<E>& bins)
      : plan(plan), bins(bins), n(plan.num_samples), num_lines(plan.num_lines),
        num_branches(plan.num_branches), most_taps(1) {
    for (int32_t c = 0; c < plan.num_channels; ++c)
      if (bins.filters[c].length > most_taps) most_taps = bins.filters[c].length;
  }

  // Gives everything its place in memory, and returns the end.
  char* place(char* at) {
    at = aligned(at);
    auto take = [&at](size_t bytes) {
      char* it = at;
      at += (bytes + 2 * VECTOR_BYTES - 1) / VECTOR_BYTES * VECTOR_BYTES;
      return it;
    };
    size_t samples = n + 8, spectrum = 2 * num_lines + 16, framed = samples + most_taps;
    size_t longest = framed > spectrum ? framed : spectrum, num_points = plan.num_points;
    weights = (V*)take(most_taps * sizeof(V));
    V **rows[] = {&y, &row, &raw, &few}, **bands[] = {&approximation, &coefficients};
    V** spectra[] = {&lines, &total};
    for (V** each : rows) *each = (V*)take(samples * sizeof(V));
    for (V** each : bands) *each = (V*)take(plan.num_coefficients * sizeof(V));
    for (V** each : spectra)
      *each = (V*)take((spectrum > samples ? spectrum : samples) * sizeof(V));
    window = d = (V*)take((longest > num_points ? longest : num_points) * sizeof(V));
    wholes = (int32_t*)lines;  // entropy's, when the lines of a branch are done with
    levels = (uint8_t*)few;
    return at;
  }

  // Filtered samples less the first of each pair, and its magnitude. What is broken or odd is read
  // as zeros.
  template <class X> void read() {
    int32_t taps = 1;
    for (int k = 0; k < W; ++k) {
      const Filter<E>& filter = bins.filters[channel[k]];
      const X* from = (const X*)bins.samples + (ptrdiff_t)bin[k] * bins.bin_stride +
                      (ptrdiff_t)channel[k] * bins.channel_stride + filter.start;
      int32_t span = n + filter.length - 1;
      E* to = (E*)window + k;
      for (int32_t i = 0; i < span; ++i) to[i * W] = (E)from[i];
      for (int32_t i = span; i < n + most_taps - 1; ++i) to[i * W] = to[0];
      to = (E*)weights + k;
      for (int32_t i = 0; i < most_taps; ++i)
        to[i * W] = i < filter.length ? filter.weights[i] : 0;
      taps = filter.length > taps ? filter.length : taps;
    }
    settle();
    V offset = window[0], base = {};  // a small vibration keeps its digits on any offset
    for (int32_t i = 0; i < taps; ++i) base += offset * weights[i];
    V most = {};
    for (int32_t i = 0; i < n + most_taps - 1; ++i) {
      window[i] -= offset;
      if (sizeof(E) == 4) most = larger(most, magnitude(window[i]));
    }
    convolve(taps);
    Extent<V> e = extent(y, n);
    span = e.high - e.low;
    scale = larger(base + e.high, -(base + e.low));
    V start = y[0];
    unit = over(V{} + 1, scale);
    quiet = larger(Limits<E>::NOISE * most, (E)Limits<double>::NOISE * scale);
    first = base + start;
    for (int32_t i = 0; i < n; ++i) y[i] -= start;
    if (bins.sensing) note_channels();
  }

  // The size of what was read; lanes that are broken or odd become zeros.
  void settle() {
    V most = {}, finite = V{} + 1;
    for (int32_t i = 0; i < n + most_taps - 1; ++i) {
      V size = magnitude(window[i]);
      finite = size <= Limits<E>::LARGEST ? finite : V{};
      most = larger(size, most);
    }
    auto is_usual = (most == 0) | ((Limits<E>::SMALLEST_USUAL <= most) &
                                   (most <= Limits<E>::LARGEST_USUAL));
    auto is_read = (finite > 0) & is_usual;
    if (any(~is_read))
      for (int32_t i = 0; i < n + most_taps - 1; ++i) window[i] = is_read ? window[i] : V{};
    for (int k = 0; k < W; ++k) {
      is_broken[k] = !(finite[k] > 0);
      loudest[k] = most[k];
      bool is_small = most[k] < Limits<E>::SMALLEST_USUAL && !Limits<E>::IS_SMALL_ODD;
      bins.is_odd[bin[k]] |= !is_broken[k] && !is_usual[k] && !is_small;
    }
    unknown = bins.sensing ? V{} : finite > 0 ? V{} : V{} + (E)NAN;
  }

  void convolve(int32_t taps) {
    for (int32_t i = 0; i < n; i += 8) {  // memory is there for some samples more
      V sums[8] = {};
      for (int32_t k = 0; k < taps; ++k)
#pragma GCC unroll 8
        for (int r = 0; r < 8; ++r) sums[r] += window[i + k + r] * weights[k];
#pragma GCC unroll 8
      for (int r = 0; r < 8; ++r) y[i + r] = sums[r];
    }
  }

  // Which channels are lost (features/sensing.py: is_alive).
  void note_channels() {
    const Sensing<E>& sensing = *bins.sensing;
    for (int k = 0; k < num; ++k) {
      int32_t c = channel[k];
      ptrdiff_t at = (ptrdiff_t)bin[k] * plan.num_channels + c;
      bool moves = span[k] * sensing.inverse_span[c] > loudest[k] && span[k] >= sensing.floor[c];
      bins.is_lost[at] = is_broken[k] || (n >= FEWEST_SAMPLES && !moves);
      bins.span[at] = is_broken[k] ? (E)NAN : span[k];
    }
  }

  int32_t num_rows() const { return 2 * num_branches + 2; }  // of a channel, the last is its bin

  // Features of the group's row to their columns.
  void write(int32_t row_number) {
    for (int i = 0; i < MAX_BRANCHES && need[row_number] >> i; ++i)
      if (need[row_number] >> i & 1) values[i] = clamped<E>(values[i], limit) + unknown;
    for (int k = 0, end; k < num; k = end) {  // lanes of one channel, whose bins follow each other
      for (end = k; end < num && channel[end] == channel[k];) ++end;
      if (out_is_float)
        write((float*)out, row_number, k, end);
      else
        write((double*)out, row_number, k, end);
    }
  }

  template <class X> void write(X* to, int32_t row_number, int start, int end) {
    int32_t at = channel[start] * num_rows() + row_number;
    to += (ptrdiff_t)(bin[start] - first_bin) * plan.num_features;
    for (int32_t w = plan.first[at]; w < plan.first[at + 1]; ++w) {
      const E* from = (const E*)(values + plan.descriptor[w]);
      X* next = to + plan.column[w];
      for (int k = start; k < end; ++k, next += plan.num_features) *next = (X)from[k];
    }
  }

  // All that is wanted of the rows centre + span * d, summed before; sorts d.
  void describe(uint32_t wanted, int32_t count, Row& s, const E* gain, bool in_time) {
    s.other = other;
    if (in_time) s.energy = s.span * s.span * s.second + s.n * s.centre * s.centre;
    values[MEAN] = s.centre, values[RANGE] = s.span, values[ENERGY] = s.energy;
    if (wanted & 1u << MEAN_DEVIATION) values[MEAN_DEVIATION] = Base::mean_deviation(s);
    if (wanted & 1u << STD) values[STD] = Base::std(s);
    if (wanted & 1u << CV) values[CV] = Base::cv(s);
    if (wanted & 1u << SKEWNESS) values[SKEWNESS] = Base::skewness(s);
    if (wanted & 1u << KURTOSIS) values[KURTOSIS] = Base::kurtosis(s);
    if (wanted & 1u << PEAK_FACTOR) values[PEAK_FACTOR] = Base::peak_factor(s);
    if (wanted & 1u << CORRELATION) values[CORRELATION] = Base::correlation(s, d, raw, count);
    if (wanted & 1u << RMS) values[RMS] = Base::rms(s);
    if (wanted & 1u << MEAN_ABS_CHANGE)
      values[MEAN_ABS_CHANGE] = Base::mean_abs_change(s, d, count);
    if (!(wanted & ORDERED)) return;
    sort(d, count);
    V near = (E)1e-12 * scale / s.span + Limits<E>::TOLERANCE;
    values[MEDIAN] = s.centre + s.span * Base::median(d, count);
    if (wanted & 1u << MODE)
      values[MODE] = s.centre + s.span * Base::mode(d, s.span > 0 ? near : V{} + 1, count);
    values[IQR] = s.span * Base::iqr(d, count);
    if (wanted & 1u << ENTROPY) {
      V found = Base::entropy(d, gain, wholes, levels, count);
      values[ENTROPY] = s.span > 0 ? found : V{};
    }
    if (sizeof(E) == 4 && in_time && (wanted & (1u << MEDIAN | 1u << IQR))) uncrowd(s);
  }

  // Where float values crowd about the median or between the quartiles, of a quiet bin with a tap
  // say, their rounding is no small part of the result: it is taken of the row, which is less the
  // first sample instead of the mean.
  void uncrowd(const Row& s) {
    int32_t few_values = n / 25, half = n / 2;
    int32_t high = half + few_values < n ? half + few_values : n - 1;
    int32_t low = half - 1 - few_values > 0 ? half - 1 - few_values : 0;
    V about = d[high] - d[low], spread = Base::iqr(d, n);
    auto is_crowded = ((about < (E)CROWDED) | (spread < (E)CROWDED)) & (s.span > 0);
    if (!any(is_crowded)) return;
    sort(row, n);
    // the row lies in memory less a constant, which is the centre less its mean
    V exact = Base::median(row, n) + (s.centre - centre);
    values[MEDIAN] = is_crowded ? exact : values[MEDIAN];
    V between = Base::iqr(row, n);
    values[IQR] = is_crowded ? between : values[IQR];
  }

  // The row in memory, less `offset`: is it constant, and at what; its descriptors, if wanted.
  void describe_time(uint32_t wanted, bool keeps_first, const V* with, int32_t row_number) {
    Row s;
    Extent<V> e = extent(row, n);
    V offset = keeps_first ? first : V{};
    s.span = e.high - e.low;
    auto constant = s.span < quiet;
    s.span = constant ? V{} : s.span;
    V middle = e.mean + offset;
    if (!keeps_first) middle = constant ? V{} : middle;
    s.centre = middle;
    s.top = s.span > 0 ? e.high + offset : middle;
    is_constant = constant ? V{} + 1 : V{};
    centre = e.mean;
    if (wanted) {
      Base::sum(s, row, e.mean, over(V{} + 1, s.span), d, with, n);
      describe(wanted, n, s, plan.gain_time, true);
      write(row_number);
    }
    centre = middle;
  }

  // The spectrum |gain * spectrum + offset * ones| in the unit of the channel; returns its energy.
  V describe_lines(uint32_t wanted, const V* spectrum, bool keeps_first, int32_t row_number) {
    auto constant = is_constant > 0;
    V gain = constant ? V{} : V{} + 1, energy = {}, most = {};
    V offset = (constant ? centre : keeps_first ? first : V{}) * unit;
    int32_t count = num_lines;
    for (int32_t i = 0; i < count; ++i) {
      V real = gain * spectrum[i] + offset * plan.ones[i];
      V imaginary = gain * spectrum[count + i] + offset * plan.ones[count + i];
      V square = real * real + imaginary * imaginary;
      d[i] = square;
      energy += square;
      most = larger(most, square);
    }
    if (!wanted) return energy;
    V inverse = over(V{} + 1, most), low = V{} + 1, high = {}, sum = {}, moment = {};
    for (int32_t i = 0; i < count; ++i) {
      V amplitude = root_of_part(d[i] * inverse);
      d[i] = amplitude;
      sum += amplitude;
      moment += amplitude * plan.frequency_hz[i];
      low = smaller(low, amplitude);
      high = larger(high, amplitude);
    }
    if (wanted & WEIGHTED) {
      V centroid = over(moment, sum);
      values[SPECTRAL_CENTROID] = centroid;
      if (wanted & 1u << SPECTRAL_SPREAD)
        values[SPECTRAL_SPREAD] =
            Base::spectral_spread(d, sum, centroid, plan.frequency_hz, count);
    }
    V mean = sum / (E)count, spread = high - low;
    Row s;
    Base::sum(s, d, mean, over(V{} + 1, spread), d, nullptr, count);
    s.top = scale * root(most);
    s.centre = s.top * mean;
    s.span = s.top * spread;
    s.energy = scale * scale * energy;
    describe(wanted, count, s, plan.gain_lines, false);
    write(row_number);
    return energy;
  }

  // The bin itself.
  void describe_raw() {
    int32_t row_number = num_rows() - 1;
    if (!need[row_number]) return;
    memcpy(row, y, n * sizeof(V));
    other = V{};
    describe_time(need[row_number], true, nullptr, row_number);
  }

  void describe_branches() {
    uint32_t shares = need[2 * num_branches];
    int32_t levels_wanted = 0;
    for (int32_t b = 0; b < num_branches; ++b)
      if (need[b] || need[num_branches + b] || shares) levels_wanted = b / 2 + 1;
    if (!levels_wanted) return;
    // the bin itself, for correlation
    Extent<V> e = extent(y, n);
    V around = e.high - e.low, factor = over(V{} + 1, around);
    factor = around < quiet ? V{} : factor;
    other = V{};
    for (int32_t i = 0; i < n; ++i) {
      raw[i] = (y[i] - e.mean) * factor;
      other += raw[i] * raw[i];
    }
    // coefficients, finest first; those of level m lie from `starts[m]` on
    int32_t starts[MAX_BRANCHES / 2 + 1] = {0};
    for (int32_t m = 0; m < levels_wanted; ++m) {
      const V* from = m ? approximation + starts[m - 1] : y;
      product(plan.low[m], from, approximation + starts[m]);
      product(plan.high[m], from, coefficients + starts[m]);
      starts[m + 1] = starts[m] + ROWS * plan.low[m].num_blocks;
    }
    V energies[MAX_BRANCHES];
    bool has_total = false;  // the spectrum of the approximation last formed
    int32_t finest = levels_wanted;  // level whose approximation's spectrum is wanted
    for (int32_t m = levels_wanted - 1; m >= 0; --m)
      if (need[num_branches + 2 * m] || shares) finest = m;
    for (int32_t m = levels_wanted - 1; m >= 0; --m) {
      const uint32_t *in_time = need + 2 * m, *in_lines = need + num_branches + 2 * m;
      bool wants_a = in_lines[0] || shares, wants_d = in_lines[1] || shares;
      if (in_time[0] || wants_a) form(2 * m, approximation + starts[m], in_time[0]);
      if (wants_a) {
        if (!has_total) spectrum_of(2 * m, approximation + starts[m], total);
        has_total = true;
        energies[2 * m] = describe_lines(in_lines[0], total, true, num_branches + 2 * m);
      }
      if (in_time[1] || wants_d) form(2 * m + 1, coefficients + starts[m], in_time[1]);
      bool is_added = has_total && finest < m;
      if (wants_d || is_added) spectrum_of(2 * m + 1, coefficients + starts[m], lines);
      if (is_added)
        for (int32_t i = 0; i < 2 * num_lines; ++i) total[i] += lines[i];
      if (wants_d)
        energies[2 * m + 1] = describe_lines(in_lines[1], lines, false, num_branches + 2 * m + 1);
    }
    if (shares) band_energy_ratio(energies);
  }

  void form(int32_t branch, const V* from, uint32_t wanted) {
    product(plan.out[branch], from, row);
    describe_time(wanted, branch % 2 == 0, raw, branch);
  }

  void spectrum_of(int32_t branch, const V* from, V* to) {
    const Matrix<E>& matrix = plan.lines[branch];
    if (matrix.values || !plan.num_points) {
      for (int32_t k = 0; k < matrix.num_columns; ++k) few[k] = from[k] * unit;
      return product(matrix, few, to);
    }
    product(plan.out[branch], from, few);
    transform(0, 1, d);
    for (int32_t i = 0; i < num_lines; ++i) {
      V gain = unit * plan.line_gains[i];
      bool is_real = i == 0 || 2 * i == plan.num_points;
      to[i] = gain * d[i];
      to[num_lines + i] = is_real ? V{} : gain * d[plan.num_points - i];
    }
  }

  // The Fourier transform of the row `few`, as if zeros followed, or of every `stride`-th of its
  // values from `start` on: real parts of the lines up to half of its points, then imaginary parts
  // backwards. Lines k and half - k take both parts from, and leave them in, the same four places.
  void transform(int32_t start, int32_t stride, V* to) {
    int32_t whole = plan.num_points, num = whole / stride, half = num / 2;
    const E *cosines = plan.cosines, *sines = cosines + whole / 4;  // with another sign
    if (num % 2 || num <= 8) {
      for (int32_t k = 0; k <= half; ++k) {
        V real = {}, imaginary = {};
        for (int32_t i = start, angle = 0; i < n; i += stride) {
          real += few[i] * cosines[angle], imaginary += few[i] * sines[angle];
          angle += k * stride;
          if (angle >= whole) angle -= whole;
        }
        to[k ? num - k : 0] = imaginary;
        to[k] = real;
      }
      return;
    }
    V* odd = to + half;
    transform(start, 2 * stride, to);
    transform(start + stride, 2 * stride, odd);
    V even = to[0];
    to[0] = even + odd[0], odd[0] = even - odd[0];
    for (int32_t k = 1; 4 * k < num; ++k) {
      E cosine = cosines[k * stride], sine = sines[k * stride];
      V real = odd[k] * cosine - odd[half - k] * sine;
      V imaginary = odd[half - k] * cosine + odd[k] * sine;
      V even_real = to[k], even_imaginary = to[half - k];
      to[k] = even_real + real, odd[half - k] = even_imaginary + imaginary;
      to[half - k] = even_real - real, odd[k] = imaginary - even_imaginary;
    }
    if (num % 4 == 0) odd[num / 4] = -odd[num / 4];
  }

  // Each branch's share of the energy of all spectra; 0 if all are zero.
  void band_energy_ratio(const V* energies) {
    V sum = {};
    for (int32_t b = 0; b < num_branches; ++b) sum += energies[b];
    for (int32_t b = 0; b < num_branches; ++b) values[b] = over(energies[b], sum);
    write(2 * num_branches);
  }

  // What is wanted of any of the pairs' channels.
  void gather_needs() {
    for (int32_t r = 0; r < num_rows(); ++r) {
      need[r] = 0;
      for (int k = 0; k < num; ++k) need[r] |= plan.need[channel[k] * num_rows() + r];
    }
  }
};

// Which bins are valid, and which in range (features/sensing.py: is_enough).
template <class E>
void count_channels(const Plan<E>& plan, const Bins<E>& bins, int32_t start, int32_t num_bins) {
  const Sensing<E>& sensing = *bins.sensing;
  for (int32_t b = start; b < start + num_bins; ++b) {
    int32_t num_alive = 0, num_fit = 0;
    ptrdiff_t at = (ptrdiff_t)b * plan.num_channels;
    for (int32_t c = 0; c < plan.num_channels; ++c, ++at) {
      bool counts = sensing.counted[c] && !bins.is_lost[at];
      num_alive += counts;
      num_fit += counts && bins.span[at] >= sensing.low[c] && bins.span[at] <= sensing.high[c];
    }
    bins.is_valid[b] = num_alive >= sensing.min_alive;
    bins.in_range[b] = bins.is_valid[b] && 2 * num_fit >= num_alive;
  }
}

// A chunk of bins at a time: their features, and what is made of these.
template <class E> struct Run {
  const Plan<E> no_plan = {};
  const Machine<E>* machine;
  const Bins<E>& bins;
  alignas(VECTOR_BYTES) Group<E> group;
  E* features;
  void* for_scores;

  Run(const Plan<E>* plan, const Machine<E>* machine, const Bins<E>& bins)
      : machine(machine), bins(bins), group(plan ? *plan : no_plan, bins) {}

  // The end of what is used of a space.
  char* place(char* space) {
    features = (E*)group.place(space);
    if (!machine) return (char*)features;
    int32_t num = bins.num_bins < CHUNK ? bins.num_bins : CHUNK;
    for_scores = features + (size_t)num * group.plan.num_features;
    return (char*)for_scores + LEVEL::scores_space(machine, bins.num_bins);
  }

  void go() {
    const Plan<E>& plan = group.plan;
    group.out_is_float = machine ? sizeof(E) == 4 : bins.features_are_float;
    group.limit = group.out_is_float ? (E)LARGEST_FLOAT : Limits<E>::LARGEST;
    for (int32_t start = 0; start < bins.num_bins; start += CHUNK) {
      int32_t num = bins.num_bins - start < CHUNK ? bins.num_bins - start : CHUNK;
      group.first_bin = machine ? start : 0;
      group.out = machine ? features : bins.features;
      describe(plan, start, num);
      if (bins.sensing) count_channels(plan, bins, start, num);
      if (!machine) continue;
      int32_t stride = plan.num_features ? plan.num_features : bins.bin_stride;
      const E* given = (const E*)bins.samples + (ptrdiff_t)start * stride;
      const E* inputs = plan.num_features ? features : given;
      LEVEL::scores(machine, &bins, inputs, stride, start, num, for_scores);
    }
  }

  // Pairs of fast channels first, so that few groups have branches.
  void describe(const Plan<E>& plan, int32_t start, int32_t num_bins) {
    int32_t num_fast = plan.num_fast * num_bins, num_pairs = num_fast + plan.num_slow * num_bins;
    for (int32_t from = 0; from < num_pairs; from += group.W) {
      group.num = num_pairs - from < group.W ? num_pairs - from : group.W;
      for (int k = 0; k < group.W; ++k) {
        int32_t pair = from + (k < group.num ? k : 0), place = pair / num_bins;
        group.bin[k] = start + pair % num_bins;
        group.channel[k] = pair < num_fast ? plan.fast[place] : plan.slow[place - plan.num_fast];
      }
      group.gather_needs();
      if (bins.is_float)
        group.template read<float>();
      else
        group.template read<double>();
      group.describe_raw();
      if (from < num_fast) group.describe_branches();
    }
  }
};

}  // namespace

namespace LEVEL {

template <class E>
size_t features_space(const Plan<E>* plan, const Machine<E>* machine, const Bins<E>* bins) {
  return (size_t)Run<E>(plan, machine, *bins).place(nullptr) + VECTOR_BYTES;
}

template <class E>
void features(const Plan<E>* plan, const Machine<E>* machine, const Bins<E>* bins, void* space) {
  Run<E> run(plan, machine, *bins);
  run.place((char*)space);
  run.go();
}

#define MAKE(E)                                                                                  \
  template size_t features_space(const Plan<E>*, const Machine<E>*, const Bins<E>*);             \
  template void features(const Plan<E>*, const Machine<E>*, const Bins<E>*, void*);
MAKE(float)
MAKE(double)

}  // namespace LEVEL
