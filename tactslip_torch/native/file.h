// A .tslip file, checked and laid out for the engine: deploy/native.py writes the same in the same
// order. All that stands in a file is used where it lies; nothing in it is trusted.
#pragma once

#include <string.h>

#include "engine.h"
#include "tactslip.h"

constexpr char MAGIC[8] = {'t', 'a', 'c', 't', 's', 'l', 'i', 'p'};
constexpr uint32_t FORMAT = 1;
constexpr int32_t MOST_CHANNELS = 2048, MOST_BIN = 1024, MOST_FRAME = 4001, MOST = 1 << 20;
constexpr int32_t MOST_RULE = 64;  // decisions that a rule looks at
constexpr int32_t NUM_FLOORS = 3;  // of each channel: onset.cpp

// What every file begins with; the checksum (CRC-32, as zlib has it) is of all that comes behind it.
struct Head {
  char magic[8];
  uint32_t format, bytes, checksum, number_bytes;
};

// Memory handed out piece by piece; without a start it is counted.
struct Arena {
  char* start;
  size_t used = 0;

  template <class X> X* take(int64_t count) {
    used = (used + alignof(X) - 1) / alignof(X) * alignof(X);
    X* it = start ? (X*)(start + used) : nullptr;
    used += (size_t)count * sizeof(X);
    return it;
  }
};

// The file from its beginning on, of numbers E. Once something does not fit, all that follows is
// wrong: numbers are the least there are, and arrays null.
template <class E> struct Reader {
  const char* file;
  size_t size, at = sizeof(Head);
  bool is_wrong = false;

  void expect(bool fits) { is_wrong |= !fits; }

  template <class X> const X* array(int64_t count) {
    at = (at + alignof(X) - 1) / alignof(X) * alignof(X);
    expect(at <= size && count <= (int64_t)((size - at) / sizeof(X)));
    if (is_wrong) return nullptr;
    const X* it = (const X*)(file + at);
    at += (size_t)count * sizeof(X);
    return it;
  }

  // An array of which every number passes a test.
  template <class X, class Test> const X* tested(int64_t count, Test test) {
    const X* table = array<X>(count);
    for (int64_t i = 0; table && i < count; ++i) is_wrong |= !test(table[i]);
    return is_wrong ? nullptr : table;
  }

  struct Number {
    int32_t* to;
    int32_t least, most;
  };
  template <int N> void all(const Number (&numbers)[N]) {
    for (const Number& each : numbers) *each.to = number(each.least, each.most);
  }

  int32_t number(int32_t least, int32_t most) {
    const int32_t* it = array<int32_t>(1);
    expect(it && *it >= least && *it <= most);
    return is_wrong ? least : *it;
  }

  struct Numbers {
    const int32_t** to;
    int64_t count;
    int32_t least, most;
  };
  template <int N> void all(const Numbers (&tables)[N]) {
    for (const Numbers& each : tables)
      *each.to = tested<int32_t>(
          each.count, [&](int32_t x) { return x >= each.least && x <= each.most; });
  }

  struct Reals {  // finite ones
    const E** to;
    int64_t count;
  };
  template <int N> void all(const Reals (&tables)[N]) {
    for (const Reals& each : tables)
      *each.to = tested<E>(each.count, [](E x) { return x - x == 0; });
  }

  // In 8 bytes whatever the precision, at any place; may be infinite.
  struct Real {
    double* to;
    double least = (double)-INFINITY;
  };
  template <int N> void all(const Real (&reals)[N]) {
    for (const Real& each : reals) {
      const char* bytes = array<char>(sizeof(double));
      *each.to = each.least;
      if (bytes) memcpy(each.to, bytes, sizeof(double));
      expect(*each.to >= each.least);
    }
  }

  const uint8_t* flags(int64_t count) {
    return tested<uint8_t>(count, [](uint8_t x) { return x <= 1; });
  }
};

// A filter, how far it reaches back, and what makes samples before a stream of its first ones.
template <class E> struct Frame {
  int32_t length, reach;
  const E *weights, *past;  // [length], [reach, length]
};

template <class X> void put(X* array, int64_t place, const X& value) {
  if (array) array[place] = value;
}

// What a file holds, of numbers E.
template <class E> struct Model {
  int32_t num_channels, bin, before, after, frame, hop, stuck, hold;
  int32_t k, n;  // the k-th largest of n decisions; n = 0: a cumulative sum
  int32_t rearm, refractory, has_onset;
  double rate_hz, slope, offset, log_odds, drift, evidence, ceiling, threshold, lead_s;
  double onset_threshold, onset_hint, onset_lead_s;
  const char* names;  // of the channels, then the unit, each with a zero behind it
  const E *scale, *zero;  // of the converter: volts = scale * count + zero
  const Frame<E>* frames;
  const int32_t* frame_of;  // [channels]
  int32_t longest;          // of the filters
  const Filter<E>* filters;
  Plan<E> plan;
  Machine<E> machine;
  Sensing<E> sensing;
  Onset<E> onset;

  // Whether all fits. Structures lie in the arena; nothing is written where it only counts.
  bool read(Reader<E>& in, Arena& arena) {
    read_stream(in);
    read_filters(in, arena);
    if (!in.is_wrong) read_plan(in, arena);
    if (!in.is_wrong) read_machine(in, arena);
    if (!in.is_wrong && has_onset) read_onset(in);
    in.expect((in.at + 7) / 8 * 8 == in.size);
    return !in.is_wrong;
  }

 private:
  void read_stream(Reader<E>& in) {
    in.all({{&num_channels, 1, MOST_CHANNELS}, {&bin, 2, MOST_BIN}, {&before, 0, MOST_FRAME},
            {&after, 0, MOST_FRAME}, {&frame, 1, MOST_FRAME}, {&hop, 1, MOST}, {&stuck, 1, MOST},
            {&hold, 0, MOST}, {&n, 0, MOST_RULE}, {&k, 0, MOST_RULE}, {&rearm, 0, MOST},
            {&refractory, 0, MOST}, {&has_onset, 0, 1}});
    in.expect(k <= n && (k || !n));
    in.all({{&rate_hz, 1e-9}, {&slope, 0}, {&offset}, {&log_odds}, {&drift}, {&evidence, 0},
            {&ceiling, 0}, {&threshold}, {&lead_s}, {&onset_threshold}, {&onset_hint},
            {&onset_lead_s}});
    int32_t num_bytes = in.number(1, MOST), num_ends = 0;
    names = in.template array<char>(num_bytes);
    for (int32_t i = 0; names && i < num_bytes; ++i) num_ends += !names[i];
    in.expect(names && num_ends == num_channels + 1 && !names[num_bytes - 1]);
    in.all({{&scale, num_channels}, {&zero, num_channels}});
  }

  void read_filters(Reader<E>& in, Arena& arena) {
    int32_t num = in.number(1, num_channels);
    Frame<E>* own = arena.take<Frame<E>>(num);
    Filter<E>* made = arena.take<Filter<E>>(num_channels);
    longest = 1;
    for (int32_t i = 0; i < num && !in.is_wrong; ++i) {
      Frame<E> each = {};
      in.all({{&each.length, 1, MOST_FRAME}, {&each.reach, 0, MOST_FRAME}});
      in.all({{&each.weights, each.length}, {&each.past, (int64_t)each.reach * each.length}});
      in.expect(each.reach <= before && each.reach < each.length && each.length <= frame &&
                each.length - each.reach - 1 <= after);
      longest = each.length > longest ? each.length : longest;
      put(own, i, each);
    }
    const E* one;
    in.all({{&frame_of, num_channels, -1, num - 1}});  // -1: a channel that is not read
    in.all({{&one, 1}});
    for (int32_t c = 0; made && frame_of && c < num_channels; ++c) {
      Frame<E> each = frame_of[c] < 0 ? Frame<E>{1, before, one, nullptr} : own[frame_of[c]];
      made[c] = {each.weights, each.length, before - each.reach};
    }
    frames = own, filters = made;
    in.all({{&sensing.inverse_span, num_channels}, {&sensing.floor, num_channels},
            {&sensing.low, num_channels}, {&sensing.high, num_channels}});
    sensing.counted = in.flags(num_channels);
    sensing.min_alive = in.number(1, num_channels);
  }

  // Whether both ascend, and have nothing in common.
  static bool is_apart(const int32_t* a, int32_t num_a, const int32_t* b, int32_t num_b) {
    int32_t i = 0, j = 0, last = -1;
    while (i < num_a || j < num_b) {
      int32_t next = j == num_b || (i < num_a && a[i] < b[j]) ? a[i++] : b[j++];
      if (next <= last) return false;
      last = next;
    }
    return true;
  }

  // 0 blocks where `may_lack` it.
  Matrix<E> matrix(Reader<E>& in, int32_t num_rows, int32_t most_columns, bool may_lack) {
    Matrix<E> own = {};
    own.num_blocks = in.number(may_lack ? 0 : 1, (num_rows + ROWS - 1) / ROWS);
    own.num_columns = in.number(own.num_blocks ? 1 : 0, most_columns);
    own.width = in.number(own.num_blocks ? 1 : 0, own.num_columns);
    in.all({{&own.first, own.num_blocks, 0, own.num_columns - own.width}});
    in.all({{&own.values, (int64_t)own.num_blocks * own.width * ROWS}});
    if (!own.num_blocks) own.values = nullptr;
    return own;
  }

  void read_plan(Reader<E>& in, Arena& arena) {
    Plan<E>& p = plan;
    p.num_channels = num_channels, p.num_samples = bin;
    int32_t num_levels, last = num_channels - 1;
    in.all({{&p.num_lines, 1, MOST_BIN}, {&num_levels, 0, MAX_BRANCHES / 2},
            {&p.num_features, 1, MOST}, {&p.num_slow, 0, num_channels},
            {&p.num_fast, 0, num_channels}, {&p.num_points, 0, 2 * MOST_BIN}});
    in.expect(p.num_points % 4 == 0);
    in.expect(!p.num_points || (p.num_points >= bin && p.num_points / 2 + 1 >= p.num_lines));
    p.num_branches = 2 * num_levels;
    in.all({{&p.slow, p.num_slow, 0, last}, {&p.fast, p.num_fast, 0, last}});
    in.expect(p.num_slow + p.num_fast > 0 && (num_levels || !p.num_fast));
    in.expect(!in.is_wrong && is_apart(p.slow, p.num_slow, p.fast, p.num_fast));
    int64_t num_rows = 2 * p.num_branches + 2, num_places = num_rows * num_channels;
    in.all({{&p.first, num_places + 1, 0, p.num_features},
            {&p.descriptor, p.num_features, 0, MAX_BRANCHES - 1},
            {&p.column, p.num_features, 0, p.num_features - 1}});
    p.need = in.template array<uint32_t>(num_places);
    for (int64_t at = 0; !in.is_wrong && at < num_places; ++at) {
      bool is_ratios = at % num_rows == num_rows - 2;  // the descriptor is a branch there
      int32_t most = is_ratios ? p.num_branches : NUM_DESCRIPTORS;
      uint32_t need = 0;
      in.expect(p.first[at] <= p.first[at + 1] && (at || !p.first[0]));
      for (int32_t w = p.first[at]; !in.is_wrong && w < p.first[at + 1]; ++w) {
        in.expect(p.descriptor[w] < most);
        need |= 1u << p.descriptor[w];
      }
      in.expect(need == p.need[at]);
    }
    in.expect(!in.is_wrong && p.first[num_places] == p.num_features);
    auto* low = arena.take<Matrix<E>>(num_levels);
    auto* high = arena.take<Matrix<E>>(num_levels);
    auto* out = arena.take<Matrix<E>>(p.num_branches);
    auto* lines = arena.take<Matrix<E>>(p.num_branches);
    p.low = low, p.high = high, p.out = out, p.lines = lines;
    p.num_coefficients = 16;
    for (int32_t m = 0, num = bin; m < num_levels && !in.is_wrong; ++m) {
      Matrix<E> of_low = matrix(in, bin + 64, num, false);
      num = ROWS * of_low.num_blocks;
      p.num_coefficients += num + 8;
      put(low, m, of_low);
      put(high, m, matrix(in, num, of_low.num_columns, false));
      for (int32_t b = 2 * m; b < 2 * m + 2; ++b) {
        put(out, b, matrix(in, bin, num, false));
        int32_t most = num < bin ? num : bin;
        put(lines, b, matrix(in, 2 * p.num_lines, most, true));
      }
    }
    in.all({{&p.cosines, p.num_points / 4 * 5}, {&p.line_gains, p.num_points ? p.num_lines : 0}});
    in.all({{&p.ones, 2 * p.num_lines}, {&p.frequency_hz, p.num_lines}, {&p.gain_time, bin},
            {&p.gain_lines, p.num_lines}});
  }

  static int32_t filled(int32_t num) { return (num + WHOLE - 1) / WHOLE * WHOLE; }

  void read_machine(Reader<E>& in, Arena& arena) {
    Machine<E>& m = machine;
    m = {};
    m.num_channels = num_channels, m.num_inputs = plan.num_features;
    in.all({{&m.num_columns, 1, MOST}, {&m.num_scaled, 1, MOST}, {&m.num_singles, 0, MOST},
            {&m.num_pools, 0, num_channels}});
    in.all({{&m.single_inputs, m.num_singles, 0, m.num_inputs - 1},
            {&m.single_columns, m.num_singles, 0, m.num_columns - 1}});
    Pool<E>* pools = arena.take<Pool<E>>(m.num_pools);
    for (int32_t i = 0; i < m.num_pools && !in.is_wrong; ++i) put(pools, i, pool(in));
    m.pools = pools;
    if (m.num_pools) in.all({{&m.fill, m.num_columns}});
    int64_t num = filled(m.num_scaled);
    in.all({{&m.sources, num, 0, m.num_columns - 1}});
    in.all({{&m.minimum, num}, {&m.width, num}});
    if (in.number(0, 1)) in.all({{&m.compression, num}});
    if (in.number(0, 1)) in.all({{&m.centre, num}});
    in.all({{&m.imputation, m.num_scaled}});
    in.all({{&m.channels, m.num_scaled, -1, num_channels - 1}});
    in.all({{&m.linear, num}});
    in.all({{&m.constant}});
    in.all({{&m.num_factors, 0, MOST}, {&m.num_quadratic, 0, filled(m.num_scaled)}});
    int32_t num_rows = m.num_factors ? m.num_factors : m.num_quadratic;
    in.expect(m.num_factors ? m.num_quadratic % WHOLE == 0 : m.num_quadratic <= m.num_scaled);
    if (m.num_factors) in.all({{&m.signs, filled(m.num_factors)}});
    if (m.num_quadratic) in.all({{&m.quadratic, (int64_t)filled(num_rows) * m.num_quadratic}});
  }

  Pool<E> pool(Reader<E>& in) {
    Pool<E> p = {};
    in.all({{&p.num_channels, 1, num_channels}, {&p.num_families, 1, MOST},
            {&p.num_statistics, 1, 256}});
    int64_t num = filled(p.num_families);
    in.all({{&p.channels, p.num_channels, 0, num_channels - 1},
            {&p.inputs, p.num_channels * num, 0, machine.num_inputs - 1},
            {&p.statistics, p.num_statistics, 0, POOLED_ORDER},
            {&p.columns, p.num_statistics * num, -1, machine.num_columns - 1}});
    in.all({{&p.fractions, p.num_statistics}, {&p.scales, num}});
    if (p.num_channels > machine.most_channels) machine.most_channels = p.num_channels;
    return p;
  }

  void read_onset(Reader<E>& in) {
    Onset<E>& o = onset;
    o = {};
    in.all({{&o.num_fast, 0, num_channels}, {&o.num_slow, 0, num_channels}, {&o.num_filters, 1, 16},
            {&o.num_windows, 2, 16}, {&o.num_pairs, 0, 4096}, {&o.num_steps, 1, 64},
            {&o.num_lags, 0, 16}, {&o.num_columns, 1, MOST}, {&o.num_layers, 0, 8},
            {&o.hop, 1, MOST_BIN}, {&o.context, 0, MOST_FRAME}, {&o.delay, 1, MOST_BIN},
            {&o.step_length, 1, MOST_FRAME}, {&o.blind, 0, MOST}, {&o.min_alive, 1, num_channels},
            {&o.most_lost, 0, MOST}});
    in.expect(o.num_fast + o.num_slow > 0 && o.num_columns == num_onset_columns());
    if (in.is_wrong) return;
    int64_t num_logs = (int64_t)o.num_filters * o.num_fast, num_columns = o.num_columns;
    int32_t last = num_channels - 1, last_fast = o.num_fast - 1;
    in.all({{&o.fast, o.num_fast, 0, last}, {&o.slow, o.num_slow, 0, last},
            {&o.windows, o.num_windows, 1, o.delay}, {&o.first, o.num_pairs, 0, last_fast},
            {&o.second, o.num_pairs, 0, last_fast}, {&o.lags, o.num_lags, 1, 256},
            {&o.widths, o.num_layers ? o.num_layers + 1 : 0, 1, MOST}});
    for (int32_t i = 1; !in.is_wrong && i < o.num_lags; ++i) in.expect(o.lags[i - 1] < o.lags[i]);
    in.all({{&o.filters, (int64_t)(o.context + o.hop) * o.num_filters * o.hop},
            {&o.steps, (int64_t)o.step_length * o.num_steps}, {&o.rounding, num_logs},
            {&o.silence, num_logs}, {&o.least_step, o.num_slow}, {&o.rates, NUM_FLOORS},
            {&o.slope, num_columns}, {&o.offset, num_columns}});
    if (o.num_layers) {
      int64_t num_weights = 0, num_biases = 0;
      for (int32_t i = 0; !in.is_wrong && i < o.num_layers; ++i) {
        num_weights += (int64_t)o.widths[i] * o.widths[i + 1];
        num_biases += o.widths[i + 1];
        in.expect(num_weights <= MOST);
      }
      in.expect(!in.is_wrong && o.widths[o.num_layers] == 1 &&
                o.widths[0] == num_columns * (1 + o.num_lags));
      in.all({{&o.weights, num_weights}, {&o.biases, num_biases}});
    } else {
      in.expect(!o.num_lags);
      if (in.number(0, 1)) in.all({{&o.quadratic, num_columns * num_columns}});
      in.all({{&o.linear, num_columns}});
      in.all({{&o.constant}});
    }
    o.is_still = in.flags(o.num_fast);
  }

  // As many as onset.cpp writes.
  int64_t num_onset_columns() const {
    const Onset<E>& o = onset;
    int64_t num = 0, rows = (int64_t)o.num_windows * o.num_filters;
    bool many_fast = o.num_fast > 1, many_slow = o.num_slow > 1;
    if (o.num_fast) num += (many_fast ? 4 : 1) * rows + (many_fast ? 2 : 1) * 4 * o.num_filters;
    if (many_fast) num += 3 * rows;
    if (o.num_slow) num += 2 * (many_slow ? 3 : 1) * o.num_steps + many_slow * o.num_steps;
    return num;
  }
};
