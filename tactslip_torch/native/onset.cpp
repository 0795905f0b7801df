// Evidence of onsets and its score, hop by hop: what onset/evidence.py defines, of values alone.
//
// A row of memory is a block: half the log power of each fast channel and filter, then the mean of
// each slow channel. Loops run over the last index, which the compiler makes vectors of.

#include <stdlib.h>

#include "engine.h"
#include "vectors.h"

namespace {

constexpr int64_t FEWEST_SAMPLES = 4;  // of a hop that may be one value

struct Hop {
  const Onset& own;
  const OnsetHops& run;
  int64_t num_filters = own.num_filters, num_logs = own.num_fast * num_filters;
  int64_t width = num_logs + own.num_slow;
  double *frame, *heard, *floor, *level, *steps, *columns, *pull;

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
  void block(int64_t start, double* row) {
    int64_t length = own.context + own.hop, num_heard = num_filters * own.hop;
    for (int64_t f = 0; f < own.num_fast; ++f) {
      for (int64_t i = 0; i < length; ++i) frame[i] = sample(own.fast[f], start + i);
      for (int64_t j = 0; j < num_heard; ++j) heard[j] = 0.0;
      for (int64_t i = 1; i < length; ++i) {
        const double x = frame[i] - frame[0], *weights = own.filters + i * num_heard;
        for (int64_t j = 0; j < num_heard; ++j) heard[j] += x * weights[j];
      }
      for (int64_t b = 0; b < num_filters; ++b) {
        double square = 0.0, scale = own.fast_compression[b];
        for (int64_t i = b * own.hop; i < (b + 1) * own.hop; ++i) square += heard[i] * heard[i];
        row[f * num_filters + b] = 0.5 * log(square / (double)own.hop + scale * scale);
      }
    }
    for (int64_t s = 0; s < own.num_slow; ++s) {
      double sum = 0.0;
      for (int64_t i = own.context; i < length; ++i) sum += sample(own.slow[s], start + i);
      row[num_logs + s] = sum / (double)own.hop;
    }
  }

  // Whether too few fast channels of a block are alive.
  bool is_lost(int64_t start, const double* row) {
    int64_t num_alive = 0;
    for (int64_t f = 0; f < own.num_fast; ++f) {
      double sum = 0.0, rise = -INFINITY;
      for (int64_t i = f * num_filters; i < (f + 1) * num_filters; ++i) {
        sum += row[i];
        rise = row[i] - own.silence[i] > rise ? row[i] - own.silence[i] : rise;
      }
      bool alive = isfinite(sum) && (isinf(rise) || (rise > 0.0 && moves(start, f)));
      num_alive += run.listened[own.fast[f]] && alive;
    }
    return num_alive < own.min_alive;
  }

  // Mean, largest and smallest of rows of values over channels, 0 without any: `_over_channels`.
  double* pool(const double* values, int64_t num_rows, int64_t num, int64_t row_stride,
               int64_t stride, const bool* in_use, double* to) {
    int64_t kinds = num > 1 ? 3 : 1;
    for (int64_t r = 0; r < num_rows; ++r) {
      double sum = 0.0, most = -INFINITY, least = INFINITY, count = 0.0;
      for (int64_t c = 0; c < num; ++c) {
        if (!in_use[c]) continue;
        double value = values[r * row_stride + c * stride];
        sum += value, count += 1.0;
        most = value > most ? value : most;
        least = value < least ? value : least;
      }
      const double found[] = {sum, most, least};
      for (int64_t k = 0; k < kinds; ++k)
        to[k * num_rows + r] = count ? found[k] / (k ? 1.0 : count) : 0.0;
    }
    return to + kinds * num_rows;
  }

  // OnsetEvidence.columns and the head: of a block, behind whose memory its row lies.
  double score(const double* row, bool* in_use) {
    int64_t longest = own.windows[own.num_windows - 1], num_floor = own.memory - longest;
    const double* oldest = row - (own.memory - 1) * width;
    for (int64_t i = 0; i < num_logs; ++i) floor[i] = 0.0;
    for (int64_t r = 0; r < num_floor; ++r)
      for (int64_t i = 0; i < num_logs; ++i) floor[i] += oldest[r * width + i];
    for (int64_t i = 0; i < num_logs; ++i) floor[i] /= (double)num_floor;
    double* power = heard;  // summed from this block back
    for (int64_t i = 0; i < num_logs; ++i) power[i] = 0.0;
    for (int64_t w = 0, r = 0; w < own.num_windows; ++w) {
      for (; r < own.windows[w]; ++r)
        for (int64_t i = 0; i < num_logs; ++i) power[i] += exp(2.0 * row[i - r * width]);
      for (int64_t i = 0; i < num_logs; ++i)
        level[w * num_logs + i] = 0.5 * log(power[i] / (double)own.windows[w]) - floor[i];
    }
    int64_t num_alive = 0;
    for (int64_t f = 0; f < own.num_fast; ++f) {
      double rise = -INFINITY, sum = 0.0;
      for (int64_t b = 0; b < num_filters; ++b) {
        double over = floor[f * num_filters + b] - own.silence[f * num_filters + b];
        rise = over > rise ? over : rise;
        for (int64_t w = 0; w < own.num_windows; ++w) sum += level[w * num_logs + f * num_filters + b];
      }
      in_use[f] = run.listened[own.fast[f]] && rise > 0.0 && isfinite(sum);
      num_alive += in_use[f];
    }
    if (num_alive < own.min_alive) return NAN;
    double* to = columns;
    // rows of a window and a filter; their statistics lie in the order of `pooled`
    int64_t num_rows = own.num_windows * num_filters, kinds = own.num_fast > 1 ? 3 : 1;
    for (int64_t w = 0; w < own.num_windows; ++w) {
      pool(level + w * num_logs, num_filters, own.num_fast, 1, num_filters, in_use, pull);
      for (int64_t k = 0; k < kinds; ++k)
        memcpy(to + k * num_rows + w * num_filters, pull + k * num_filters,
               num_filters * sizeof(double));
    }
    to += kinds * num_rows;
    if (own.num_slow) {
      int64_t num_slow = own.num_slow, num_steps = own.num_steps;
      double* way = steps + num_steps * num_slow;
      for (int64_t i = 0; i < num_steps * num_slow; ++i) steps[i] = 0.0;
      oldest = row + num_logs - (own.step_length - 1) * width;
      for (int64_t r = 1; r < own.step_length; ++r)
        for (int64_t d = 0; d < num_steps; ++d)
          for (int64_t s = 0; s < num_slow; ++s)
            steps[d * num_slow + s] +=
                own.steps[r * num_steps + d] * (oldest[r * width + s] - oldest[s]);
      for (int64_t d = 0; d < num_steps; ++d)
        for (int64_t s = 0; s < num_slow; ++s) {
          double& step = steps[d * num_slow + s];
          double scale = own.slow_compression[d], size = log(fabs(step) + scale), over = size - log(scale);
          way[d * num_slow + s] = step > 0.0 ? over : step < 0.0 ? -over : 0.0 * over;
          step = size;
        }
      for (int64_t s = 0; s < num_slow; ++s) {
        double sum = 0.0;
        for (int64_t d = 0; d < num_steps; ++d) sum += steps[d * num_slow + s];
        in_use[s] = run.listened[own.slow[s]] && isfinite(sum);
      }
      to = pool(steps, num_steps, num_slow, num_slow, 1, in_use, to);
      to = pool(way, num_steps, num_slow, num_slow, 1, in_use, to);
    }
    int64_t num = own.num_columns;
    for (int64_t i = 0; i < num; ++i) {
      double z = columns[i] * own.slope[i] + own.offset[i];
      columns[i] = z < -1.0 ? -1.0 : z > 1.0 ? 1.0 : z;
      pull[i] = own.linear[i];
    }
    for (int64_t i = 0; i < num && own.quadratic; ++i)
      for (int64_t j = 0; j < num; ++j) pull[j] += own.quadratic[i * num + j] * columns[i];
    double score = own.constant;
    for (int64_t i = 0; i < num; ++i) score += pull[i] * columns[i];
    return score;
  }
};

}  // namespace

extern "C" int ONSET_ENTRY(const Onset* own, OnsetHops* run) {
  int64_t num_logs = own->num_fast * own->num_filters, num_heard = own->num_filters * own->hop;
  int64_t sizes[] = {own->context + own->hop,
                     num_logs > num_heard ? num_logs : num_heard,
                     num_logs,
                     own->num_windows * num_logs,
                     2 * own->num_steps * own->num_slow,
                     own->num_columns,
                     own->num_columns};
  int64_t total = 0, num_channels = own->num_fast + own->num_slow;
  for (int64_t size : sizes) total += size;
  double* memory = (double*)malloc(total * sizeof(double) + num_channels * sizeof(bool));
  if (!memory) return 1;
  Hop of{*own, *run};
  double *next = memory,
         **parts[] = {&of.frame, &of.heard, &of.floor, &of.level, &of.steps, &of.columns, &of.pull};
  for (int i = 0; i < 7; next += sizes[i++]) *parts[i] = next;
  for (int64_t k = 0; k < run->num_hops; ++k) {
    double* row = run->rows + run->num_rows * of.width;
    of.block(k * own->hop, row);
    run->score[k] = NAN;
    run->is_lost[k] = of.is_lost(k * own->hop, row);
    run->num_lost += run->is_lost[k];
    if (run->is_lost[k]) continue;
    if (run->num_lost > own->most_lost) {  // as at the beginning of a stream
      memmove(run->rows, row, of.width * sizeof(double));
      run->num_rows = 0;
    }
    run->num_lost = 0;
    if (++run->num_rows >= own->memory) run->score[k] = of.score(row, (bool*)next);
  }
  free(memory);
  return 0;
}
