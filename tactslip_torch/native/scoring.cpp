// Scores of bins from their features: pooling over channels, scaling and head.
//
// Lanes run across a few bins, or, of one bin alone, across its families, scaled columns and rows of
// the head. Each number is made by the same operations in the same order, so scores are the same:
// to be compiled without contraction of products and sums.

#include "engine.h"
#include "vectors.h"

namespace {

// log(1 + x) for x > -1, as fdlibm has it: an error of about 1 ulp. Of f, less than the square root of 2
// over 1, it is a series in the squares of s = f / (2 + f).
template <class E> struct Series;
template <> struct Series<double> {
  static constexpr int DIGITS = 52, BIAS = 0x3ff;
  static constexpr uint64_t ONE = 0x3ff0000000000000, LOWEST = 0x3fe6a09e00000000;  // sqrt(1/2)
  static constexpr double LN2_HIGH = 6.93147180369123816490e-01, LN2_LOW = 1.90821492927058770002e-10;
  static constexpr double LN_LARGEST = 0x1.62e42fefa39efp9;
  template <class V> INLINE V at(V z) {
    return z * (6.666666666666735130e-01 + z * (3.999999999940941908e-01 +
           z * (2.857142874366239149e-01 + z * (2.222219843214978396e-01 +
           z * (1.818357216161805012e-01 + z * (1.531383769920937332e-01 +
           z * 1.479819860511658591e-01))))));
  }
};
template <> struct Series<float> {
  static constexpr int DIGITS = 23, BIAS = 0x7f;
  static constexpr uint32_t ONE = 0x3f800000, LOWEST = 0x3f3504f3;
  static constexpr float LN2_HIGH = 6.9313812256e-01f, LN2_LOW = 9.0580006145e-06f;
  static constexpr float LN_LARGEST = 0x1.62e43p6f;
  template <class V> INLINE V at(V z) {
    return z * (6.6666662693e-01f + z * (4.0000972152e-01f +
           z * (2.8498786688e-01f + z * 2.4279078841e-01f)));
  }
};
template <class E> INLINE typename Lanes<E>::V log1p_of(typename Lanes<E>::V x) {
  typedef typename Lanes<E>::V V;
  typedef typename Lanes<E>::Bits Bits;
  typedef Series<E> Own;
  constexpr auto digits = ((decltype(Own::ONE))1 << Own::DIGITS) - 1;
  constexpr E whole = 3 * ((E)((decltype(Own::ONE))1 << Own::DIGITS) / 2);  // on it, a number's bits
  V u = 1 + x, lost = x < 1 ? x - (u - 1) : 1 - (u - x);
  Bits bits = (Bits)u + (Own::ONE - Own::LOWEST);
  V k = (V)((bits >> Own::DIGITS) + ((Bits)(V{} + whole) - Own::BIAS)) - whole;
  V f = (V)((bits & digits) + Own::LOWEST) - 1;
  V s = f / (2 + f), z = s * s, half = (E)0.5 * f * f;
  V about = (V)(2 * Own::ONE - (Bits)smaller(u, V{} + (E)0x1p60));  // 1 / u to an eighth; 1 at 1
  return k * Own::LN2_HIGH - ((half - (s * (half + Own::at(z)) + (k * Own::LN2_LOW + lost * about))) - f);
}

template <class V> INLINE V inverse_of(V scale) {
  typedef decltype(scale[0] + 0) E;
  return smaller(1 / scale, V{} + Limits<E>::LARGEST);
}

// scale log(1 + away / whole), the inverse being that of `whole`.
template <class E, class V> INLINE V log_part(V away, V scale, V whole, V inverse) {
  V ratio = away * inverse, bent = scale * log1p_of<E>(ratio);
  auto is_far = ratio > Limits<E>::LARGEST;
  if (any(is_far))
    for (int k = 0; k < Lanes<E>::NUM; ++k)
      if (is_far[k]) {
        E far = log_of(away[k] > whole[k] ? away[k] : whole[k]) - log_of(whole[k]);
        bent[k] = scale[k] * (far > Series<E>::LN_LARGEST ? far : Series<E>::LN_LARGEST);
      }
  return magnitude(ratio) < Limits<E>::SMALLEST ? away : bent;  // a denormal ratio has lost digits
}

// sign(x) scale log(1 + |x| / scale)
template <class E, class V> INLINE V signed_log(V x, V scale, V inverse) {
  V bent = log_part<E>(magnitude(x), scale, scale, inverse);
  return x < 0 ? -bent : bent;
}

// The same, less that of a centre. Near the centre it is the log of one ratio, so that what lies close
// together stays apart.
template <class E, class V> INLINE V signed_log_less(V x, V scale, V centre) {
  auto is_turned = (centre < 0) | ((centre == 0) & (x < 0));
  V turned = is_turned ? -x : x, middle = magnitude(centre);
  auto is_beside = 2 * turned >= middle;
  V away = is_beside ? turned - middle : magnitude(turned);
  V whole = is_beside ? scale + middle : scale, inverse = inverse_of(whole);
  V bent = log_part<E>(away, scale, whole, inverse);
  if (any(~is_beside)) {
    V own = turned < 0 ? -bent : bent;
    bent = is_beside ? bent : own - scale * log1p_of<E>(middle * inverse);
  }
  return is_turned ? -bent : bent;
}

enum Across { BINS, ONE_BIN };

constexpr int32_t filled_up(int32_t num) { return (num + WHOLE - 1) / WHOLE * WHOLE; }

template <class E> struct Scorer {
  static constexpr int L = Lanes<E>::NUM;
  typedef typename Lanes<E>::V V;
  const Machine<E>& machine;
  V *several, *y, *z;  // [inputs], [columns], [scaled]: of a few bins, or of one in as many numbers
  V *values, *sorted, *in_use;  // [channels]
  int32_t at;                   // the first of these bins
  int few;
  const uint8_t* is_lost;  // of these bins

  explicit Scorer(const Machine<E>& machine) : machine(machine) {}

  char* place(char* at, int32_t num_bins) {
    int32_t lanes = num_bins > 1 ? L : 1, most = machine.most_channels;
    several = (V*)aligned(at);  // of one bin, inputs stay where they are
    y = several + (num_bins > 1 ? machine.num_inputs : 0);
    z = y + filled_up(machine.num_columns) * lanes / L;
    values = z + filled_up(machine.num_scaled) * lanes / L;
    sorted = values + most;
    in_use = sorted + most;
    return (char*)(in_use + most);
  }

  // Of inputs of bins from `start` on.
  void run(const E* inputs, int32_t stride, int32_t start, int32_t num, const Bins<E>& bins) {
    for (int32_t b = 0; b < num; b += few) {
      at = start + b;
      few = (int)(num - b < L ? num - b : L);
      if (2 * few <= L) few = 1;  // up to here it is quicker
      is_lost = bins.is_lost ? bins.is_lost + (ptrdiff_t)at * machine.num_channels : nullptr;
      if (few == 1)
        score_few<ONE_BIN>(inputs + b * stride, stride, bins);
      else
        score_few<BINS>(inputs + b * stride, stride, bins);
    }
  }

  template <Across ACROSS>
  void score_few(const E* inputs, int32_t stride, const Bins<E>& bins) {
    const Machine<E>& m = machine;
    const V* x = ACROSS == BINS ? several : (const V*)inputs;
    for (int32_t i = 0; ACROSS == BINS && i < m.num_inputs; ++i)
      for (int k = 0; k < L; ++k) several[i][k] = inputs[(k < few ? k : 0) * stride + i];
    for (int32_t i = 0; i < m.num_singles; ++i)
      for (int k = 0; k < (ACROSS == BINS ? L : 1); ++k)
        of<ACROSS>(y, m.single_columns[i], k) = of<ACROSS>((V*)x, m.single_inputs[i], k);
    for (int32_t p = 0; p < m.num_pools; ++p) pool<ACROSS>(m.pools[p], x);
    for (int32_t i = 0; i < m.num_scaled; i += step<ACROSS>()) scale<ACROSS>(i);
    for (int k = 0; m.imputation && is_lost && k < few; ++k)
      for (int32_t i = 0; i < m.num_scaled; ++i)
        if (m.channels[i] >= 0 && is_lost[k * m.num_channels + m.channels[i]])
          of<ACROSS>(z, i, k) = m.imputation[i];
    for (int k = 0; bins.scaled && k < few; ++k)
      for (int32_t i = 0; i < m.num_scaled; ++i)
        bins.scaled[(ptrdiff_t)(at + k) * m.num_scaled + i] = of<ACROSS>(z, i, k);
    if (!bins.score) return;
    V score = clamped<E>(head<ACROSS>(), bins.score_as_float ? (E)LARGEST_FLOAT : Limits<E>::LARGEST);
    for (int k = 0; k < few; ++k)
      bins.score[at + k] = bins.is_valid && !bins.is_valid[at + k] ? (E)NAN : score[k];
  }

  // Families, scaled columns or rows that one vector holds.
  template <Across ACROSS> static constexpr int step() { return ACROSS == BINS ? 1 : L; }

  // A number of a bin.
  template <Across ACROSS> static E& of(V* rows, int32_t i, int k) {
    return ((E*)rows)[ACROSS == BINS ? i * L + k : i];
  }

  // One vector of numbers that are there once for each family, scaled column or row.
  template <Across ACROSS> static V constants(const E* from) {
    V found = V{} + *from;
    if (ACROSS == ONE_BIN) memcpy(&found, from, sizeof(V));
    return found;
  }

  // One vector of inputs or columns.
  template <Across ACROSS> static V gathered(const V* from, const int32_t* places) {
    if (ACROSS == BINS) return from[*places];
    V found = {};
    for (int k = 0; k < L; ++k) found[k] = ((const E*)from)[places[k]];
    return found;
  }

  template <Across ACROSS> void pool(const Pool<E>& p, const V* x) {
    int32_t stride = filled_up(p.num_families);
    V count = {};
    for (int32_t c = 0; c < p.num_channels; ++c) {
      in_use[c] = V{} + 1;
      for (int k = 0; is_lost && k < few; ++k)
        if (is_lost[k * machine.num_channels + p.channels[c]]) {
          if (ACROSS == BINS)
            in_use[c][k] = 0;
          else
            in_use[c] = V{};
        }
      count += in_use[c];
    }
    for (int32_t r = 0; r < p.num_families; r += step<ACROSS>()) {
      V mean = {}, square = {}, low = {}, high = {}, last = {}, lowest = V{} + Limits<E>::LARGEST;
      for (int32_t c = 0; c < p.num_channels; ++c) {
        values[c] = gathered<ACROSS>(x, p.inputs + c * stride + r);
        lowest = in_use[c] > 0 ? smaller(values[c], lowest) : lowest;
      }
      lowest = larger(lowest, V{});
      // where all are positive, logs are less that of the lowest: what lies close together stays apart
      V scale = constants<ACROSS>(p.scales + r), whole = scale + lowest, inverse = inverse_of(whole);
      V base = log_part<E>(lowest, scale, scale, inverse_of(scale));
      for (int32_t c = 0; c < p.num_channels; ++c) {
        V away = values[c] - lowest, bent = log_part<E>(magnitude(away), scale, whole, inverse);
        values[c] = in_use[c] > 0 ? away < 0 ? -bent : bent : V{};
        mean += values[c];
        last = larger(last, values[c]);
      }
      mean /= larger(count, V{} + 1);
      for (int32_t c = 0; c < p.num_channels; ++c) {
        V away = (values[c] - mean) * in_use[c];  // a channel that is not in use stands at the mean
        square += away * away;
        low = smaller(low, away);
        high = larger(high, away);
      }
      bool is_sorted = false;
      for (int32_t s = 0; s < p.num_statistics; ++s) {
        const int32_t* columns = p.columns + s * stride + r;
        bool is_wanted = false;
        for (int k = 0; k < step<ACROSS>(); ++k) is_wanted |= columns[k] >= 0;
        if (!is_wanted) continue;
        V found = mean;
        if (p.statistics[s] == POOLED_STD) found = root(square / larger(count - 1, V{} + 1));
        if (p.statistics[s] == POOLED_MIN) found = low + mean;
        if (p.statistics[s] == POOLED_MAX) found = high + mean;
        if (p.statistics[s] == POOLED_ORDER) {
          if (!is_sorted)  // those not in use come last
            for (int32_t c = 0; c < p.num_channels; ++c)
              sorted[c] = in_use[c] > 0 ? values[c] : last;
          if (!is_sorted) sort_few(sorted, p.num_channels);
          is_sorted = true;
          found = mean - mean;  // NaN stays NaN
          for (int32_t c = 0; c < p.num_channels; ++c) {
            V weight = 1 - magnitude((count - 1) * p.fractions[s] - (E)c);
            found += weight > 0 ? sorted[c] * weight : V{};  // linear interpolation
          }
        }
        if (p.statistics[s] != POOLED_STD) found += base;
        if (ACROSS == BINS) y[*columns] = count > 0 ? found : V{} + machine.fill[*columns];
        for (int k = 0; ACROSS == ONE_BIN && k < L; ++k)
          if (columns[k] >= 0)
            of<ACROSS>(y, columns[k], 0) = count[0] > 0 ? found[k] : machine.fill[columns[k]];
      }
    }
  }

  template <Across ACROSS> void scale(int32_t i) {
    const Machine<E>& m = machine;
    V value = gathered<ACROSS>(y, m.sources + i);
    V centre = m.centre ? constants<ACROSS>(m.centre + i) : V{};
    V scale = m.compression ? constants<ACROSS>(m.compression + i) : V{};
    if (!m.compression)
      value -= centre;
    else if (m.centre)
      value = signed_log_less<E>(value, scale, centre);
    else
      value = signed_log<E>(value, scale, inverse_of(scale));
    if (m.minimum) {
      V low = constants<ACROSS>(m.minimum + i), width = constants<ACROSS>(m.width + i);
      V scaled = clamped<E>(2 * ((value - low) / width) - 1, 1);
      value = width > 0 ? scaled : value - value;  // 0; NaN stays NaN
    }
    z[i / step<ACROSS>()] = value;
  }

  // Adds the product of a scaled column with rows of a block.
  template <Across ACROSS, int NUM> void add_column(V (&pull)[NUM], const E* block, int32_t j) {
    V other = ACROSS == BINS ? z[j] : V{} + of<ACROSS>(z, j, 0);
#pragma GCC unroll 4
    for (int v = 0; v < NUM; ++v)
      pull[v] += other * constants<ACROSS>(block + WHOLE * j + v * step<ACROSS>());
  }

  // Adds the terms of rows to the scores of a few bins, or to that of one in lane 0.
  template <Across ACROSS> static void add(V& sums, V terms) {
    if (ACROSS == BINS) sums += terms;
    for (int k = 0; ACROSS == ONE_BIN && k < L; ++k) sums[0] += terms[k];
  }

  // The scores of a few bins, or that of one in lane 0.
  template <Across ACROSS> V head() {
    const Machine<E>& m = machine;
    constexpr int rows = ACROSS == BINS ? 4 : WHOLE, num = rows / step<ACROSS>();
    for (int32_t i = m.num_scaled; i < filled_up(m.num_scaled); ++i)
      for (int k = 0; k < (ACROSS == BINS ? L : 1); ++k) of<ACROSS>(z, i, k) = 0;
    V sums = V{} + (E)m.constant;
    int32_t num_quadratic = m.signs ? 0 : m.num_quadratic;
    for (int32_t i = 0; i < m.num_scaled; i += rows) {
      V pull[num];
      for (int v = 0; v < num; ++v) pull[v] = constants<ACROSS>(m.linear + i + v * step<ACROSS>());
      const E* block = m.quadratic + i / WHOLE * WHOLE * num_quadratic + i % WHOLE;
      int32_t reach = i + rows < num_quadratic ? i + rows : num_quadratic;
      for (int32_t j = 0; i < num_quadratic && j < reach; ++j) add_column<ACROSS>(pull, block, j);
      for (int v = 0; v < num; ++v) add<ACROSS>(sums, pull[v] * z[i / step<ACROSS>() + v]);
    }
    if (m.signs) factors<ACROSS>(sums);
    return sums;
  }

  // Add the squares of the products with the factors. There are few rows and many columns, so each
  // product is summed in PARTS, which do not wait for each other.
  template <Across ACROSS> void factors(V& sums) {
    const Machine<E>& m = machine;
    constexpr int PARTS = 4, rows = ACROSS == BINS ? 4 : L, num = rows / step<ACROSS>();
    for (int32_t i = 0; i < m.num_factors; i += rows) {
      const E* block = m.quadratic + i / WHOLE * WHOLE * m.num_quadratic + i % WHOLE;
      V pull[PARTS][num] = {};
      for (int32_t j = 0; j < m.num_quadratic; j += PARTS)
#pragma GCC unroll 4
        for (int p = 0; p < PARTS; ++p) add_column<ACROSS>(pull[p], block, j + p);
      for (int v = 0; v < num; ++v) {
        V whole = (pull[0][v] + pull[1][v]) + (pull[2][v] + pull[3][v]);
        add<ACROSS>(sums, whole * whole * constants<ACROSS>(m.signs + i + v * step<ACROSS>()));
      }
    }
  }
};

}  // namespace

namespace LEVEL {

template <class E> size_t scores_space(const Machine<E>* machine, int32_t num_bins) {
  return (size_t)Scorer<E>(*machine).place(nullptr, num_bins) + VECTOR_BYTES;
}

template <class E>
void scores(const Machine<E>* machine, const Bins<E>* bins, const E* inputs, int32_t stride,
           int32_t start, int32_t num, void* space) {
  Scorer<E> scorer(*machine);
  scorer.place((char*)space, bins->num_bins);
  scorer.run(inputs, stride, start, num, *bins);
}

#define MAKE(E)                                                                                    \
  template size_t scores_space(const Machine<E>*, int32_t);                                        \
  template void scores(const Machine<E>*, const Bins<E>*, const E*, int32_t, int32_t, int32_t, void*);
MAKE(float)
MAKE(double)

}  // namespace LEVEL
