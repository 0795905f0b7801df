// Evidence of slip and its score, hop by hop: what onset/evidence.py defines, of values alone.
//
// Rows of channels lie side by side, filter by filter. Loops run over the last index, which the
// compiler makes vectors of.

#include "engine.h"
#include "vectors.h"

namespace {

constexpr int32_t FEWEST_SAMPLES = 4;  // of a hop that may be one value
constexpr int32_t NUM_FLOORS = 3;
constexpr double LEAST_STEPS = 1e-3;  // sum of steps over their floors, that counts as none
constexpr double LEAST_RISE = 1e-6;   // sum of products of rises that counts as none

// Parts of the memory, in their order: onset/evidence.py, Memory.
template <class E> struct Kept {
  E *count, *logs, *products, *means, *steps, *floor, *step_floor, *scaled;
};

// Rows that are kept, the latest last.
template <class E> void shift(E* rows, int32_t num, int32_t width, const E* latest) {
  if (!num) return;
  memmove(rows, rows + width, (num - 1) * width * sizeof(E));
  memcpy(rows + (num - 1) * width, latest, width * sizeof(E));
}

template <class E> struct Hop {
  const Onset<E>& own;
  const OnsetHops<E>& run;
  int32_t num_logs = own.num_filters * own.num_fast, num_products = own.num_filters * own.num_pairs;
  int32_t num_sizes = own.num_steps * own.num_slow;
  int32_t longest_lag = own.num_lags ? own.lags[own.num_lags - 1] : 0;
  Kept<E> kept;
  E *frame, *heard, *logs, *products, *means, *power, *level, *risen, *steps, *columns, *scaled;
  E *values;
  E* other;
  bool* in_use;  // fast or slow channels

  E sample(int32_t channel, int32_t place) const {
    ptrdiff_t at = (ptrdiff_t)channel * run.channel_stride + place;
    return run.is_float ? (E)((const float*)run.samples)[at] : (E)((const double*)run.samples)[at];
  }

  // Whether a fast channel's own samples of the hop are not all one value.
  bool moves(int32_t start, int32_t f) const {
    int32_t first = start + own.context;
    bool is_one = own.hop >= FEWEST_SAMPLES;
    for (int32_t i = first + 1; i < first + own.hop; ++i)
      is_one &= sample(own.fast[f], i) == sample(own.fast[f], first);
    return !is_one;
  }

  // OnsetEvidence.blocks: of the hop whose context begins at a sample.
  void block(int32_t start) {
    int32_t length = own.context + own.hop, num_heard = own.num_filters * own.hop;
    for (int32_t f = 0; f < own.num_fast; ++f) {
      E* of_channel = heard + f * num_heard;
      for (int32_t i = 0; i < length; ++i) frame[i] = sample(own.fast[f], start + i);
      for (int32_t j = 0; j < num_heard; ++j) of_channel[j] = 0;
      for (int32_t i = 1; i < length; ++i) {
        const E x = frame[i] - frame[0], *weights = own.filters + i * num_heard;
        for (int32_t j = 0; j < num_heard; ++j) of_channel[j] += x * weights[j];
      }
      for (int32_t b = 0; b < own.num_filters; ++b) {
        E square = 0;
        for (int32_t i = b * own.hop; i < (b + 1) * own.hop; ++i)
          square += of_channel[i] * of_channel[i];
        int32_t at = b * own.num_fast + f;
        logs[at] = (E)0.5 * log_of(square / (E)own.hop + own.rounding[at]);
      }
    }
    for (int32_t p = 0; p < own.num_pairs; ++p) {
      const E* one = heard + own.first[p] * num_heard;
      const E* other = heard + own.second[p] * num_heard;
      for (int32_t b = 0; b < own.num_filters; ++b) {
        E product = 0;
        for (int32_t i = b * own.hop; i < (b + 1) * own.hop; ++i) product += one[i] * other[i];
        products[b * own.num_pairs + p] = product / (E)own.hop;
      }
    }
    for (int32_t s = 0; s < own.num_slow; ++s) {
      E sum = 0;
      for (int32_t i = own.context; i < length; ++i) sum += sample(own.slow[s], start + i);
      means[s] = sum / (E)own.hop;
    }
  }

  // OnsetEvidence.is_lost
  bool is_lost(int32_t start) {
    int32_t num_known = 0;
    for (int32_t f = 0; f < own.num_fast; ++f) {
      E sum = 0, rise = -(E)INFINITY;
      for (int32_t i = f; i < num_logs; i += own.num_fast) {
        sum += logs[i];
        rise = logs[i] - own.silence[i] > rise ? logs[i] - own.silence[i] : rise;
      }
      if (!run.in_use[own.fast[f]] || !isfinite(sum)) continue;
      num_known += own.is_still[f] || (rise > 0 && moves(start, f));
    }
    if (own.num_fast) return num_known < own.min_alive;
    for (int32_t s = 0; s < own.num_slow; ++s)
      num_known += run.in_use[own.slow[s]] && isfinite(means[s]);
    return num_known < own.min_alive;
  }

  // OnsetEvidence.begin: all that was before is equal to this block.
  void begin() {
    *kept.count = 0;
    for (int32_t i = 0; i < own.delay; ++i) {
      memcpy(kept.logs + i * num_logs, logs, num_logs * sizeof(E));
      memcpy(kept.products + i * num_products, products, num_products * sizeof(E));
    }
    for (int32_t i = 0; i < own.step_length - 1; ++i)
      memcpy(kept.means + i * own.num_slow, means, own.num_slow * sizeof(E));
    for (int32_t i = 0; i < own.delay * num_sizes; ++i)
      kept.steps[i] = 0 * means[i % own.num_slow];  // NaN where a channel is missing
    for (int32_t i = 0; i < NUM_FLOORS * num_logs; ++i) kept.floor[i] = (E)NAN;
    for (int32_t i = 0; i < num_sizes; ++i) kept.step_floor[i] = (E)NAN;
  }

  // A recursive mean of finite values.
  void follow(E* floor, const E* x, int32_t num, E rate) {
    for (int32_t i = 0; i < num; ++i) {
      E before = isfinite(floor[i]) ? floor[i] : x[i];
      if (isfinite(x[i])) floor[i] = before + rate * (x[i] - before);
    }
  }

  // Mean, largest, smallest and spread of rows over channels, 0 without any: `_over_channels`.
  E* pool(const E* rows, int32_t num_rows, int32_t num, const bool* in_use, int32_t kinds,
               E* to) {
    kinds = num > 1 ? kinds : 1;
    for (int32_t r = 0; r < num_rows; ++r) {
      const E* row = rows + r * num;
      E sum = 0, most = -(E)INFINITY, least = (E)INFINITY, count = 0, square = 0;
      for (int32_t c = 0; c < num; ++c) {
        if (!in_use[c]) continue;
        sum += row[c], count += 1;
        most = row[c] > most ? row[c] : most;
        least = row[c] < least ? row[c] : least;
      }
      E mean = count ? sum / count : 0;
      for (int32_t c = 0; c < num; ++c)
        if (in_use[c]) square += (row[c] - mean) * (row[c] - mean);
      const E found[] = {mean, count ? most : 0, count ? least : 0,
                              count ? root_of(square / count) : 0};
      for (int32_t k = 0; k < kinds; ++k) to[k * num_rows + r] = found[k];
    }
    return to + kinds * num_rows;
  }

  // Means of the last blocks, this one among them, ``[width]``.
  void last_means(const E* rows, const E* latest, int32_t width, int32_t length,
                  bool is_log, E* to) {
    for (int32_t i = 0; i < width; ++i) to[i] = is_log ? exp_of(2 * latest[i]) : latest[i];
    for (int32_t r = own.delay - length + 1; r < own.delay; ++r)
      for (int32_t i = 0; i < width; ++i)
        to[i] += is_log ? exp_of(2 * rows[r * width + i]) : rows[r * width + i];
    for (int32_t i = 0; i < width; ++i) to[i] /= (E)length;
  }

  // OnsetEvidence.columns of a block that is not lost; whether there is evidence.
  bool evidence() {
    E count = *kept.count += 1;
    E since = count - (E)own.delay > 1 ? count - (E)own.delay : 1;
    // steps, and what is usual of them
    const E* oldest = own.step_length > 1 ? kept.means : means;
    for (int32_t i = 0; i < num_sizes; ++i) steps[i] = 0;
    for (int32_t s = 0; s < own.num_slow; ++s) other[s] = 0;
    for (int32_t r = 1; r < own.step_length; ++r) {
      const E* row = r < own.step_length - 1 ? kept.means + r * own.num_slow : means;
      for (int32_t s = 0; s < own.num_slow; ++s) other[s] += row[s] - oldest[s];
      for (int32_t d = 0; d < own.num_steps; ++d) {
        E weight = own.steps[r * own.num_steps + d];
        if (weight == 0) continue;
        for (int32_t s = 0; s < own.num_slow; ++s)
          steps[d * own.num_slow + s] += weight * (row[s] - oldest[s]);
      }
    }
    for (int32_t d = 0; d < own.num_steps; ++d)  // a row that is not finite reaches every step
      for (int32_t s = 0; s < own.num_slow; ++s) steps[d * own.num_slow + s] += 0 * other[s];
    // floors
    for (int32_t n = 0; n < NUM_FLOORS; ++n) {
      E rate = 1 / since > own.rates[n] ? 1 / since : own.rates[n];
      follow(kept.floor + n * num_logs, kept.logs, num_logs, rate);
      if (n == 0) follow(kept.step_floor, kept.steps, num_sizes, rate);
    }
    // pools over fast channels
    E* to = columns;
    int32_t num_alive = 0, num_fast = own.num_fast, num_filters = own.num_filters;
    for (int32_t w = 0; w < own.num_windows && num_fast; ++w) {
      last_means(kept.logs, logs, num_logs, own.windows[w], true, power + w * num_logs);
      for (int32_t i = 0; i < num_logs; ++i)
        level[w * num_logs + i] = (E)0.5 * log_of(power[w * num_logs + i]);
    }
    for (int32_t f = 0; f < num_fast; ++f) {
      E rise = -(E)INFINITY, sum = 0;
      for (int32_t b = 0; b < num_filters; ++b) {
        int32_t i = b * num_fast + f;
        E over = kept.floor[(NUM_FLOORS - 1) * num_logs + i] - own.silence[i];
        rise = over > rise ? over : rise;
        sum += kept.floor[i];
        for (int32_t w = 0; w < own.num_windows; ++w) sum += level[w * num_logs + i];
      }
      in_use[f] = run.in_use[own.fast[f]] && rise > 0 && isfinite(sum);
      num_alive += in_use[f];
    }
    if (num_fast) {
      for (int32_t w = 0; w < own.num_windows; ++w)
        for (int32_t i = 0; i < num_logs; ++i)
          values[w * num_logs + i] = level[w * num_logs + i] - kept.floor[i];
      to = pool(values, own.num_windows * num_filters, num_fast, in_use, 4, to);
      E* next = values;
      for (int32_t w = 0; w < 2; ++w)
        for (int32_t n = 1; n < NUM_FLOORS; ++n)
          for (int32_t i = 0; i < num_logs; ++i)
            *next++ = level[w * num_logs + i] - kept.floor[n * num_logs + i];
      to = pool(values, 2 * (NUM_FLOORS - 1) * num_filters, num_fast, in_use, 2, to);
    }
    int32_t num_squares = own.num_windows * num_filters;
    for (int32_t w = 0; w < own.num_windows && num_fast > 1; ++w) {
      last_means(kept.products, products, num_products, own.windows[w], false, values);
      for (int32_t b = 0; b < num_filters; ++b) {
        const E* own_power = power + w * num_logs + b * num_fast;
        const E* own_level = level + w * num_logs + b * num_fast;
        for (int32_t f = 0; f < num_fast; ++f) {
          E rise = own_level[f] - kept.floor[b * num_fast + f];
          risen[f] = in_use[f] && rise > 0 ? rise : 0;
        }
        E sum = 0, num = 0, most = 0, weighted = 0, weights = 0;
        for (int32_t p = 0; p < own.num_pairs; ++p) {
          int32_t i = own.first[p], j = own.second[p];
          if (!in_use[i] || !in_use[j]) continue;
          E product = values[b * own.num_pairs + p];
          E square = product * product / (own_power[i] * own_power[j]);
          most = square > most ? square : most;
          sum += square, num += 1;
          weighted += risen[i] * risen[j] * square, weights += risen[i] * risen[j];
        }
        to[w * num_filters + b] = num ? sum / num : 0;
        to[num_squares + w * num_filters + b] = most;
        to[2 * num_squares + w * num_filters + b] = weighted / (weights + (E)LEAST_RISE);
      }
    }
    if (num_fast > 1) to += 3 * num_squares;
    // pools over slow channels
    if (int32_t num_slow = own.num_slow) {
      int32_t num_known = 0;
      for (int32_t s = 0; s < num_slow; ++s) {
        E sum = 0;
        for (int32_t i = s; i < num_sizes; i += num_slow) sum += steps[i] + kept.step_floor[i];
        in_use[s] = run.in_use[own.slow[s]] && isfinite(sum);
        num_known += in_use[s];
      }
      num_alive = num_fast ? num_alive : num_known;
      E *size = values, *way = values + num_sizes, *relative = values + 2 * num_sizes;
      for (int32_t i = 0; i < num_sizes; ++i) {
        relative[i] = steps[i] / (kept.step_floor[i] + own.least_step[i % num_slow]);
        size[i] = log_of(size_of(relative[i]) + 1);
        way[i] = relative[i] < 0 ? -size[i] : size[i];
      }
      to = pool(size, own.num_steps, num_slow, in_use, 3, to);
      to = pool(way, own.num_steps, num_slow, in_use, 3, to);
      for (int32_t d = 0; d < own.num_steps && num_slow > 1; ++d) {
        E sum = 0, all = 0;
        for (int32_t s = 0; s < num_slow; ++s) {
          if (!in_use[s]) continue;
          sum += relative[d * num_slow + s], all += size_of(relative[d * num_slow + s]);
        }
        *to++ = sum / (all + (E)LEAST_STEPS);
      }
    }
    // what is kept
    shift(kept.logs, own.delay, num_logs, logs);
    shift(kept.products, own.delay, num_products, products);
    shift(kept.means, own.step_length - 1, own.num_slow, means);
    for (int32_t i = 0; i < num_sizes; ++i) steps[i] = size_of(steps[i]);
    shift(kept.steps, own.delay, num_sizes, steps);
    return num_alive >= own.min_alive && count > (E)own.blind;
  }

  // The head on scaled columns, of now and of before.
  E score() {
    int32_t num = own.num_columns;
    for (int32_t i = 0; i < num; ++i) {
      E z = columns[i] * own.slope[i] + own.offset[i];
      scaled[i] = z < -1 ? -1 : z > 1 ? 1 : z;
    }
    if (*kept.count == 1)
      for (int32_t i = 0; i < longest_lag; ++i)
        memcpy(kept.scaled + i * num, scaled, num * sizeof(E));
    for (int32_t n = 0; n < own.num_lags; ++n)
      memcpy(scaled + (n + 1) * num, kept.scaled + (longest_lag - own.lags[n]) * num,
             num * sizeof(E));
    shift(kept.scaled, longest_lag, num, scaled);
    if (!own.num_layers) {
      E sum = (E)own.constant;
      for (int32_t j = 0; j < num; ++j) values[j] = own.linear[j];
      for (int32_t i = 0; i < num && own.quadratic; ++i)
        for (int32_t j = 0; j < num; ++j) values[j] += own.quadratic[i * num + j] * scaled[i];
      for (int32_t j = 0; j < num; ++j) sum += values[j] * scaled[j];
      return sum;
    }
    // weights of a layer are [in, out]
    const E *weights = own.weights, *biases = own.biases;
    E *from = scaled, *to = values;
    for (int32_t n = 0; n < own.num_layers; ++n) {
      int32_t num_in = own.widths[n], num_out = own.widths[n + 1];
      for (int32_t j = 0; j < num_out; ++j) to[j] = biases[j];
      for (int32_t i = 0; i < num_in; ++i)
        for (int32_t j = 0; j < num_out; ++j) to[j] += weights[i * num_out + j] * from[i];
      for (int32_t j = 0; j < num_out && n < own.num_layers - 1; ++j) to[j] /= 1 + exp_of(-to[j]);
      weights += num_in * num_out, biases += num_out;
      E* next = from == scaled ? other : from;
      from = to, to = next;
    }
    return from[0];
  }

  // Gives every part of the memory its place; how many numbers it holds.
  size_t recall(E* memory) {
    E* at = memory;
    auto take = [&at](E*& part, int32_t size) { part = at, at += size; };
    take(kept.count, 1);
    take(kept.logs, own.delay * num_logs);
    take(kept.products, own.delay * num_products);
    take(kept.means, (own.step_length - 1) * own.num_slow);
    take(kept.steps, own.delay * num_sizes);
    take(kept.floor, NUM_FLOORS * num_logs);
    take(kept.step_floor, num_sizes);
    take(kept.scaled, longest_lag * own.num_columns);
    return at - memory;
  }

  // The same of what it works in.
  size_t place(E* space) {
    int32_t widest = 0, most = 0, num_channels = own.num_fast + own.num_slow;
    for (int32_t n = 0; own.num_layers && n <= own.num_layers; ++n)
      widest = own.widths[n] > widest ? own.widths[n] : widest;
    int32_t num_rises = own.num_windows > 4 ? own.num_windows : 4;  // of both kinds of floors
    const int32_t of_values[] = {num_rises * num_logs, num_products, 3 * num_sizes,
                                 own.num_columns, widest};
    for (int32_t size : of_values) most = size > most ? size : most;
    E* at = space;
    auto take = [&at](E*& part, int32_t size) { part = at, at += size; };
    take(frame, own.context + own.hop);
    take(heard, num_logs * own.hop);
    take(logs, num_logs);
    take(products, num_products);
    take(means, own.num_slow);
    take(power, own.num_windows * num_logs);
    take(level, own.num_windows * num_logs);
    take(risen, own.num_fast);
    take(steps, num_sizes);
    take(columns, own.num_columns);
    take(scaled, (1 + own.num_lags) * own.num_columns);
    take(values, most);
    take(other, own.num_slow > widest ? own.num_slow : widest);
    in_use = (bool*)at;
    return at - space + (num_channels + sizeof(E) - 1) / sizeof(E);
  }
};

}  // namespace

namespace LEVEL {

template <class E> size_t onset_memory(const Onset<E>* own) {
  return Hop<E>{*own, {}}.recall(nullptr);
}

template <class E> size_t onset_space(const Onset<E>* own) {
  return (Hop<E>{*own, {}}.place(nullptr) + 1) * sizeof(E);
}

template <class E> void onset(const Onset<E>* own, OnsetHops<E>* run, void* space) {
  Hop<E> of{*own, *run};
  of.recall(run->memory);
  of.place((E*)(((uintptr_t)space + sizeof(E) - 1) / sizeof(E) * sizeof(E)));
  for (int32_t k = 0; k < run->num_hops; ++k) {
    of.block(k * own->hop);
    run->score[k] = (E)NAN;
    run->is_lost[k] = of.is_lost(k * own->hop);
    E* row = run->columns ? run->columns + (ptrdiff_t)k * own->num_columns : nullptr;
    for (int32_t i = 0; i < own->num_columns && row; ++i) row[i] = (E)NAN;
    run->num_lost += run->is_lost[k];
    if (run->is_lost[k]) continue;
    if (*of.kept.count == 0 || run->num_lost > own->most_lost) of.begin();
    run->num_lost = 0;
    bool is_usable = of.evidence();
    if (row) memcpy(row, of.columns, own->num_columns * sizeof(E));
    E score = of.score();
    if (is_usable) run->score[k] = score;
  }
}

#define MAKE(E)                                                 \
  template size_t onset_memory(const Onset<E>*);                \
  template size_t onset_space(const Onset<E>*);                 \
  template void onset(const Onset<E>*, OnsetHops<E>*, void*);
MAKE(float)
MAKE(double)

}  // namespace LEVEL
