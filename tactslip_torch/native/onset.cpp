// Evidence of slip and its score, hop by hop: what onset/evidence.py defines, of values alone.
//
// Rows of channels lie side by side, filter by filter. Loops run over the last index, which the
// compiler makes vectors of.

#include <stdlib.h>

#include "engine.h"
#include "vectors.h"

namespace {

constexpr int64_t FEWEST_SAMPLES = 4;  // of a hop that may be one value
constexpr int64_t NUM_FLOORS = 3;
constexpr double LEAST_STEPS = 1e-3;  // sum of steps over their floors, that counts as none

// Parts of the memory, in their order: onset/evidence.py, Memory.
struct Kept {
  double *count, *logs, *products, *means, *steps, *floor, *step_floor, *scaled;
};

// Rows that are kept, the latest last.
void shift(double* rows, int64_t num, int64_t width, const double* latest) {
  if (!num) return;
  memmove(rows, rows + width, (num - 1) * width * sizeof(double));
  memcpy(rows + (num - 1) * width, latest, width * sizeof(double));
}

struct Hop {
  const Onset& own;
  const OnsetHops& run;
  int64_t num_logs = own.num_filters * own.num_fast, num_products = own.num_filters * own.num_pairs;
  int64_t num_sizes = own.num_steps * own.num_slow;
  int64_t longest_lag = own.num_lags ? own.lags[own.num_lags - 1] : 0;
  Kept kept;
  double *frame, *heard, *logs, *products, *means, *power, *level, *steps, *columns, *scaled, *values;
  double* other;

  double sample(int64_t channel, int64_t place) const {
    int64_t at = channel * run.channel_stride + place;
    return run.is_float ? ((const float*)run.samples)[at] : ((const double*)run.samples)[at];
  }

  // Whether a fast channel's own samples of the hop are not all one value.
  bool moves(int64_t start, int64_t f) const {
    int64_t first = start + own.context;
    bool is_one = own.hop >= FEWEST_SAMPLES;
    for (int64_t i = first + 1; i < first + own.hop; ++i)
      is_one &= sample(own.fast[f], i) == sample(own.fast[f], first);
    return !is_one;
  }

  // OnsetEvidence.blocks: of the hop whose context begins at a sample.
  void block(int64_t start) {
    int64_t length = own.context + own.hop, num_heard = own.num_filters * own.hop;
    for (int64_t f = 0; f < own.num_fast; ++f) {
      double* of_channel = heard + f * num_heard;
      for (int64_t i = 0; i < length; ++i) frame[i] = sample(own.fast[f], start + i);
      for (int64_t j = 0; j < num_heard; ++j) of_channel[j] = 0.0;
      for (int64_t i = 1; i < length; ++i) {
        const double x = frame[i] - frame[0], *weights = own.filters + i * num_heard;
        for (int64_t j = 0; j < num_heard; ++j) of_channel[j] += x * weights[j];
      }
      for (int64_t b = 0; b < own.num_filters; ++b) {
        double square = 0.0;
        for (int64_t i = b * own.hop; i < (b + 1) * own.hop; ++i)
          square += of_channel[i] * of_channel[i];
        int64_t at = b * own.num_fast + f;
        logs[at] = 0.5 * log(square / (double)own.hop + own.rounding[at]);
      }
    }
    for (int64_t p = 0; p < own.num_pairs; ++p) {
      const double* one = heard + own.first[p] * num_heard;
      const double* other = heard + own.second[p] * num_heard;
      for (int64_t b = 0; b < own.num_filters; ++b) {
        double product = 0.0;
        for (int64_t i = b * own.hop; i < (b + 1) * own.hop; ++i) product += one[i] * other[i];
        products[b * own.num_pairs + p] = product / (double)own.hop;
      }
    }
    for (int64_t s = 0; s < own.num_slow; ++s) {
      double sum = 0.0;
      for (int64_t i = own.context; i < length; ++i) sum += sample(own.slow[s], start + i);
      means[s] = sum / (double)own.hop;
    }
  }

  // OnsetEvidence.is_lost
  bool is_lost(int64_t start) {
    int64_t num_known = 0;
    for (int64_t f = 0; f < own.num_fast; ++f) {
      double sum = 0.0, rise = -INFINITY;
      for (int64_t i = f; i < num_logs; i += own.num_fast) {
        sum += logs[i];
        rise = logs[i] - own.silence[i] > rise ? logs[i] - own.silence[i] : rise;
      }
      if (!run.in_use[own.fast[f]] || !isfinite(sum)) continue;
      num_known += own.is_still[f] || (rise > 0.0 && moves(start, f));
    }
    if (own.num_fast) return num_known < own.min_alive;
    for (int64_t s = 0; s < own.num_slow; ++s)
      num_known += run.in_use[own.slow[s]] && isfinite(means[s]);
    return num_known < own.min_alive;
  }

  // OnsetEvidence.begin: all that was before is equal to this block.
  void begin() {
    *kept.count = 0.0;
    for (int64_t i = 0; i < own.delay; ++i) {
      memcpy(kept.logs + i * num_logs, logs, num_logs * sizeof(double));
      memcpy(kept.products + i * num_products, products, num_products * sizeof(double));
    }
    for (int64_t i = 0; i < own.step_length - 1; ++i)
      memcpy(kept.means + i * own.num_slow, means, own.num_slow * sizeof(double));
    for (int64_t i = 0; i < own.delay * num_sizes; ++i)
      kept.steps[i] = 0.0 * means[i % own.num_slow];  // NaN where a channel is missing
    for (int64_t i = 0; i < NUM_FLOORS * num_logs; ++i) kept.floor[i] = NAN;
    for (int64_t i = 0; i < num_sizes; ++i) kept.step_floor[i] = NAN;
  }

  // A recursive mean of finite values.
  void follow(double* floor, const double* x, int64_t num, double rate) {
    for (int64_t i = 0; i < num; ++i) {
      double before = isfinite(floor[i]) ? floor[i] : x[i];
      if (isfinite(x[i])) floor[i] = before + rate * (x[i] - before);
    }
  }

  // Mean, largest, smallest and spread of rows over channels, 0 without any: `_over_channels`.
  double* pool(const double* rows, int64_t num_rows, int64_t num, const bool* in_use, int64_t kinds,
               double* to) {
    kinds = num > 1 ? kinds : 1;
    for (int64_t r = 0; r < num_rows; ++r) {
      const double* row = rows + r * num;
      double sum = 0.0, most = -INFINITY, least = INFINITY, count = 0.0, square = 0.0;
      for (int64_t c = 0; c < num; ++c) {
        if (!in_use[c]) continue;
        sum += row[c], count += 1.0;
        most = row[c] > most ? row[c] : most;
        least = row[c] < least ? row[c] : least;
      }
      double mean = count ? sum / count : 0.0;
      for (int64_t c = 0; c < num; ++c)
        if (in_use[c]) square += (row[c] - mean) * (row[c] - mean);
      const double found[] = {mean, count ? most : 0.0, count ? least : 0.0,
                              count ? sqrt(square / count) : 0.0};
      for (int64_t k = 0; k < kinds; ++k) to[k * num_rows + r] = found[k];
    }
    return to + kinds * num_rows;
  }

  // Means of the last blocks, this one among them, ``[width]``.
  void last_means(const double* rows, const double* latest, int64_t width, int64_t length,
                  bool is_log, double* to) {
    for (int64_t i = 0; i < width; ++i) to[i] = is_log ? exp(2.0 * latest[i]) : latest[i];
    for (int64_t r = own.delay - length + 1; r < own.delay; ++r)
      for (int64_t i = 0; i < width; ++i)
        to[i] += is_log ? exp(2.0 * rows[r * width + i]) : rows[r * width + i];
    for (int64_t i = 0; i < width; ++i) to[i] /= (double)length;
  }

  // OnsetEvidence.columns of a block that is not lost; whether there is evidence.
  bool evidence(bool* in_use) {
    double count = *kept.count += 1.0;
    double since = count - (double)own.delay > 1.0 ? count - (double)own.delay : 1.0;
    // steps, and what is usual of them
    const double* oldest = own.step_length > 1 ? kept.means : means;
    for (int64_t i = 0; i < num_sizes; ++i) steps[i] = 0.0;
    for (int64_t s = 0; s < own.num_slow; ++s) other[s] = 0.0;
    for (int64_t r = 1; r < own.step_length; ++r) {
      const double* row = r < own.step_length - 1 ? kept.means + r * own.num_slow : means;
      for (int64_t s = 0; s < own.num_slow; ++s) other[s] += row[s] - oldest[s];
      for (int64_t d = 0; d < own.num_steps; ++d) {
        double weight = own.steps[r * own.num_steps + d];
        if (weight == 0.0) continue;
        for (int64_t s = 0; s < own.num_slow; ++s)
          steps[d * own.num_slow + s] += weight * (row[s] - oldest[s]);
      }
    }
    for (int64_t d = 0; d < own.num_steps; ++d)  // a row that is not finite reaches every step
      for (int64_t s = 0; s < own.num_slow; ++s) steps[d * own.num_slow + s] += 0.0 * other[s];
    // floors
    for (int64_t n = 0; n < NUM_FLOORS; ++n) {
      double rate = 1.0 / since > own.rates[n] ? 1.0 / since : own.rates[n];
      follow(kept.floor + n * num_logs, kept.logs, num_logs, rate);
      if (n == 0) follow(kept.step_floor, kept.steps, num_sizes, rate);
    }
    // pools over fast channels
    double* to = columns;
    int64_t num_alive = 0, num_fast = own.num_fast, num_filters = own.num_filters;
    for (int64_t w = 0; w < own.num_windows && num_fast; ++w) {
      last_means(kept.logs, logs, num_logs, own.windows[w], true, power + w * num_logs);
      for (int64_t i = 0; i < num_logs; ++i)
        level[w * num_logs + i] = 0.5 * log(power[w * num_logs + i]);
    }
    for (int64_t f = 0; f < num_fast; ++f) {
      double rise = -INFINITY, sum = 0.0;
      for (int64_t b = 0; b < num_filters; ++b) {
        int64_t i = b * num_fast + f;
        double over = kept.floor[(NUM_FLOORS - 1) * num_logs + i] - own.silence[i];
        rise = over > rise ? over : rise;
        sum += kept.floor[i];
        for (int64_t w = 0; w < own.num_windows; ++w) sum += level[w * num_logs + i];
      }
      in_use[f] = run.in_use[own.fast[f]] && rise > 0.0 && isfinite(sum);
      num_alive += in_use[f];
    }
    if (num_fast) {
      for (int64_t w = 0; w < own.num_windows; ++w)
        for (int64_t i = 0; i < num_logs; ++i)
          values[w * num_logs + i] = level[w * num_logs + i] - kept.floor[i];
      to = pool(values, own.num_windows * num_filters, num_fast, in_use, 4, to);
      double* next = values;
      for (int64_t w = 0; w < 2; ++w)
        for (int64_t n = 1; n < NUM_FLOORS; ++n)
          for (int64_t i = 0; i < num_logs; ++i)
            *next++ = level[w * num_logs + i] - kept.floor[n * num_logs + i];
      to = pool(values, 2 * (NUM_FLOORS - 1) * num_filters, num_fast, in_use, 2, to);
    }
    int64_t num_squares = own.num_windows * num_filters;
    for (int64_t w = 0; w < own.num_windows && num_fast > 1; ++w) {
      last_means(kept.products, products, num_products, own.windows[w], false, values);
      for (int64_t b = 0; b < num_filters; ++b) {
        const double* own_power = power + w * num_logs + b * num_fast;
        double sum = 0.0, num = 0.0, most = 0.0;
        for (int64_t p = 0; p < own.num_pairs; ++p) {
          int64_t i = own.first[p], j = own.second[p];
          if (!in_use[i] || !in_use[j]) continue;
          double product = values[b * own.num_pairs + p];
          double square = product * product / (own_power[i] * own_power[j]);
          most = square > most ? square : most;
          sum += square, num += 1.0;
        }
        to[w * num_filters + b] = num ? sum / num : 0.0;
        to[num_squares + w * num_filters + b] = most;
      }
    }
    if (num_fast > 1) to += 2 * num_squares;
    // pools over slow channels
    if (int64_t num_slow = own.num_slow) {
      int64_t num_known = 0;
      for (int64_t s = 0; s < num_slow; ++s) {
        double sum = 0.0;
        for (int64_t i = s; i < num_sizes; i += num_slow) sum += steps[i] + kept.step_floor[i];
        in_use[s] = run.in_use[own.slow[s]] && isfinite(sum);
        num_known += in_use[s];
      }
      num_alive = num_fast ? num_alive : num_known;
      double *size = values, *way = values + num_sizes, *relative = values + 2 * num_sizes;
      for (int64_t i = 0; i < num_sizes; ++i) {
        relative[i] = steps[i] / (kept.step_floor[i] + own.least_step[i % num_slow]);
        size[i] = log(fabs(relative[i]) + 1.0);
        way[i] = relative[i] < 0.0 ? -size[i] : size[i];
      }
      to = pool(size, own.num_steps, num_slow, in_use, 3, to);
      to = pool(way, own.num_steps, num_slow, in_use, 3, to);
      for (int64_t d = 0; d < own.num_steps && num_slow > 1; ++d) {
        double sum = 0.0, all = 0.0;
        for (int64_t s = 0; s < num_slow; ++s) {
          if (!in_use[s]) continue;
          sum += relative[d * num_slow + s], all += fabs(relative[d * num_slow + s]);
        }
        *to++ = sum / (all + LEAST_STEPS);
      }
    }
    // what is kept
    shift(kept.logs, own.delay, num_logs, logs);
    shift(kept.products, own.delay, num_products, products);
    shift(kept.means, own.step_length - 1, own.num_slow, means);
    for (int64_t i = 0; i < num_sizes; ++i) steps[i] = fabs(steps[i]);
    shift(kept.steps, own.delay, num_sizes, steps);
    return num_alive >= own.min_alive && count > (double)own.blind;
  }

  // The head on scaled columns, of now and of before.
  double score() {
    int64_t num = own.num_columns;
    for (int64_t i = 0; i < num; ++i) {
      double z = columns[i] * own.slope[i] + own.offset[i];
      scaled[i] = z < -1.0 ? -1.0 : z > 1.0 ? 1.0 : z;
    }
    if (*kept.count == 1.0)
      for (int64_t i = 0; i < longest_lag; ++i)
        memcpy(kept.scaled + i * num, scaled, num * sizeof(double));
    for (int64_t n = 0; n < own.num_lags; ++n)
      memcpy(scaled + (n + 1) * num, kept.scaled + (longest_lag - own.lags[n]) * num,
             num * sizeof(double));
    shift(kept.scaled, longest_lag, num, scaled);
    if (!own.num_layers) {
      double sum = own.constant;
      for (int64_t j = 0; j < num; ++j) values[j] = own.linear[j];
      for (int64_t i = 0; i < num && own.quadratic; ++i)
        for (int64_t j = 0; j < num; ++j) values[j] += own.quadratic[i * num + j] * scaled[i];
      for (int64_t j = 0; j < num; ++j) sum += values[j] * scaled[j];
      return sum;
    }
    // weights of a layer are [in, out]
    const double *weights = own.weights, *biases = own.biases;
    double *from = scaled, *to = values;
    for (int64_t n = 0; n < own.num_layers; ++n) {
      int64_t num_in = own.widths[n], num_out = own.widths[n + 1];
      for (int64_t j = 0; j < num_out; ++j) to[j] = biases[j];
      for (int64_t i = 0; i < num_in; ++i)
        for (int64_t j = 0; j < num_out; ++j) to[j] += weights[i * num_out + j] * from[i];
      for (int64_t j = 0; j < num_out && n < own.num_layers - 1; ++j) to[j] /= 1.0 + exp(-to[j]);
      weights += num_in * num_out, biases += num_out;
      double* next = from == scaled ? other : from;
      from = to, to = next;
    }
    return from[0];
  }
};

}  // namespace

extern "C" int ONSET_ENTRY(const Onset* own, OnsetHops* run) {
  int64_t num_logs = own->num_filters * own->num_fast;
  int64_t num_products = own->num_filters * own->num_pairs;
  int64_t num_sizes = own->num_steps * own->num_slow;
  int64_t longest = own->num_lags ? own->lags[own->num_lags - 1] : 0, widest = 0;
  for (int64_t n = 0; n <= own->num_layers && own->num_layers; ++n)
    widest = own->widths[n] > widest ? own->widths[n] : widest;
  int64_t num_rises = own->num_windows > 4 ? own->num_windows : 4;  // of both kinds of floors
  int64_t of_values[] = {num_rises * num_logs, num_products, 3 * num_sizes, own->num_columns, widest};
  int64_t most = 0;
  for (int64_t size : of_values) most = size > most ? size : most;
  int64_t others = own->num_slow > widest ? own->num_slow : widest;
  int64_t sizes[] = {own->context + own->hop, num_logs * own->hop, num_logs, num_products,
                     own->num_slow, own->num_windows * num_logs, own->num_windows * num_logs,
                     num_sizes, own->num_columns, (1 + own->num_lags) * own->num_columns, most,
                     others};
  int64_t total = 0, num_channels = own->num_fast + own->num_slow;
  for (int64_t size : sizes) total += size;
  double* space = (double*)malloc(total * sizeof(double) + num_channels * sizeof(bool));
  if (!space) return 1;
  double* memory = run->memory;
  Hop of{*own, *run};
  const int64_t of_memory[] = {1, own->delay * num_logs, own->delay * num_products,
                               (own->step_length - 1) * own->num_slow, own->delay * num_sizes,
                               NUM_FLOORS * num_logs, num_sizes, longest * own->num_columns};
  double** parts[] = {&of.kept.count, &of.kept.logs, &of.kept.products, &of.kept.means,
                      &of.kept.steps, &of.kept.floor, &of.kept.step_floor, &of.kept.scaled};
  for (int i = 0; i < 8; memory += of_memory[i++]) *parts[i] = memory;
  double *next = space, **spaces[] = {&of.frame, &of.heard, &of.logs, &of.products, &of.means,
                                      &of.power, &of.level, &of.steps, &of.columns, &of.scaled,
                                      &of.values, &of.other};
  for (int i = 0; i < 12; next += sizes[i++]) *spaces[i] = next;
  for (int64_t k = 0; k < run->num_hops; ++k) {
    of.block(k * own->hop);
    run->score[k] = NAN;
    run->is_lost[k] = of.is_lost(k * own->hop);
    double* row = run->columns ? run->columns + k * own->num_columns : nullptr;
    for (int64_t i = 0; i < own->num_columns && row; ++i) row[i] = NAN;
    run->num_lost += run->is_lost[k];
    if (run->is_lost[k]) continue;
    if (*of.kept.count == 0.0 || run->num_lost > own->most_lost) of.begin();
    run->num_lost = 0;
    bool is_usable = of.evidence((bool*)next);
    if (row) memcpy(row, of.columns, own->num_columns * sizeof(double));
    double score = of.score();
    if (is_usable) run->score[k] = score;
  }
  free(space);
  return 0;
}
