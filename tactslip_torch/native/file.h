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

// The file from its beginning on. Once something does not fit, all that follows is wrong: numbers
// are the least there are, and arrays null.
struct Reader {
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

  int32_t number(int32_t least, int32_t most) {
    const int32_t* it = array<int32_t>(1);
    expect(it && *it >= least && *it <= most);
    return is_wrong ? least : *it;
  }

  const int32_t* numbers(int64_t count, int32_t least, int32_t most) {
    const int32_t* all = array<int32_t>(count);
    for (int64_t i = 0; all && i < count; ++i) is_wrong |= all[i] < least || all[i] > most;
    return is_wrong ? nullptr : all;
  }

  // Finite ones.
  template <class E> const E* reals(int64_t count) {
    const E* all = array<E>(count);
    for (int64_t i = 0; all && i < count; ++i) is_wrong |= !(all[i] - all[i] == 0);
    return is_wrong ? nullptr : all;
  }

  // In 8 bytes whatever the precision, at any place; least > -infinity refuses NaN too.
  double real(double least, double most) {
    const char* bytes = array<char>(sizeof(double));
    double value = least;
    if (bytes) memcpy(&value, bytes, sizeof(double));
    expect(value >= least && value <= most);
    return value;
  }

  const uint8_t* flags(int64_t count) {
    const uint8_t* all = array<uint8_t>(count);
    for (int64_t i = 0; all && i < count; ++i) is_wrong |= all[i] > 1;
    return is_wrong ? nullptr : all;
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
  bool read(Reader& in, Arena& arena) {
    read_stream(in);
    read_filters(in, arena);
    if (!in.is_wrong) read_plan(in, arena);
    if (!in.is_wrong) read_machine(in, arena);
    if (!in.is_wrong && has_onset) read_onset(in);
    in.expect((in.at + 7) / 8 * 8 == in.size);
    return !in.is_wrong;
  }

 private:
  void read_stream(Reader& in) {
    num_channels = in.number(1, MOST_CHANNELS);
    bin = in.number(2, MOST_BIN);
    before = in.number(0, MOST_FRAME);
    after = in.number(0, MOST_FRAME);
    frame = in.number(1, MOST_FRAME);
    hop = in.number(1, MOST);
    stuck = in.number(1, MOST);
    hold = in.number(0, MOST);
    n = in.number(0, MOST_RULE);
    k = in.number(n ? 1 : 0, n);
    rearm = in.number(0, MOST);
    refractory = in.number(0, MOST);
    has_onset = in.number(0, 1);
    const double most = 1.7e308, inf = (double)INFINITY;
    rate_hz = in.real(1e-9, most);
    slope = in.real(0, most);
    offset = in.real(-most, most);
    log_odds = in.real(-most, most);
    drift = in.real(-most, most);
    evidence = in.real(0, 1);
    ceiling = in.real(0, inf);
    threshold = in.real(-inf, inf);
    lead_s = in.real(-most, most);
    onset_threshold = in.real(-inf, inf);
    onset_hint = in.real(-inf, inf);
    onset_lead_s = in.real(-most, most);
    int32_t num_bytes = in.number(1, MOST), num_ends = 0;
    names = in.array<char>(num_bytes);
    for (int32_t i = 0; names && i < num_bytes; ++i) num_ends += !names[i];
    in.expect(names && num_ends == num_channels + 1 && !names[num_bytes - 1]);
    scale = in.template reals<E>(num_channels);
    zero = in.template reals<E>(num_channels);
  }

  void read_filters(Reader& in, Arena& arena) {
    int32_t num = in.number(1, num_channels), width = before + bin + after;
    Frame<E>* own = arena.take<Frame<E>>(num);
    Filter<E>* made = arena.take<Filter<E>>(num_channels);
    longest = 1;
    for (int32_t i = 0; i < num && !in.is_wrong; ++i) {
      Frame<E> each = {};
      each.length = in.number(1, MOST_FRAME);
      each.reach = in.number(0, each.length - 1);
      each.weights = in.template reals<E>(each.length);
      each.past = in.template reals<E>((int64_t)each.reach * each.length);
      in.expect(each.reach <= before && each.length <= frame &&
                each.length - each.reach - 1 <= after && width >= bin + each.length - 1);
      longest = each.length > longest ? each.length : longest;
      put(own, i, each);
    }
    frame_of = in.numbers(num_channels, -1, num - 1);  // -1: a channel that is not read
    const E* one = in.template reals<E>(1);
    for (int32_t c = 0; made && frame_of && c < num_channels; ++c) {
      if (frame_of[c] < 0) {
        put(made, c, Filter<E>{one, 1, 0});
      } else {
        const Frame<E>& each = own[frame_of[c]];
        put(made, c, Filter<E>{each.weights, each.length, before - each.reach});
      }
    }
    frames = own, filters = made;
    sensing.inverse_span = in.template reals<E>(num_channels);
    sensing.floor = in.template reals<E>(num_channels);
    sensing.low = in.template reals<E>(num_channels);
    sensing.high = in.template reals<E>(num_channels);
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

  // R rows a block; 0 blocks where `may_lack` it.
  template <int R> Matrix<E> matrix(Reader& in, int32_t num_rows, int32_t most_columns,
                                    bool may_lack) {
    Matrix<E> own = {};
    own.num_blocks = in.number(may_lack ? 0 : 1, (num_rows + R - 1) / R);
    own.num_columns = in.number(own.num_blocks ? 1 : 0, most_columns);
    own.width = in.number(own.num_blocks ? 1 : 0, own.num_columns);
    own.first = in.numbers(own.num_blocks, 0, own.num_columns - own.width);
    own.values = in.template reals<E>((int64_t)own.num_blocks * own.width * R);
    if (!own.num_blocks) own.values = nullptr;
    return own;
  }

  void read_plan(Reader& in, Arena& arena) {
    Plan<E>& p = plan;
    p.num_channels = num_channels, p.num_samples = bin;
    p.num_lines = in.number(1, MOST_BIN);
    int32_t num_levels = in.number(0, MAX_BRANCHES / 2);
    p.num_branches = 2 * num_levels;
    p.num_features = in.number(1, MOST);
    p.num_slow = in.number(0, num_channels);
    p.num_fast = in.number(0, num_channels);
    p.slow = in.numbers(p.num_slow, 0, num_channels - 1);
    p.fast = in.numbers(p.num_fast, 0, num_channels - 1);
    in.expect(p.num_slow + p.num_fast > 0 && (num_levels || !p.num_fast));
    in.expect(!in.is_wrong && is_apart(p.slow, p.num_slow, p.fast, p.num_fast));
    int64_t num_rows = 2 * p.num_branches + 2, num_places = num_rows * num_channels;
    p.first = in.numbers(num_places + 1, 0, p.num_features);
    p.descriptor = in.numbers(p.num_features, 0, MAX_BRANCHES - 1);
    p.column = in.numbers(p.num_features, 0, p.num_features - 1);
    p.need = in.array<uint32_t>(num_places);
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
      Matrix<E> of_low = matrix<4>(in, bin + 64, num, false);
      num = 4 * of_low.num_blocks;
      p.num_coefficients += num + 8;
      put(low, m, of_low);
      put(high, m, matrix<4>(in, num, of_low.num_columns, false));
      for (int32_t b = 2 * m; b < 2 * m + 2; ++b) {
        put(out, b, matrix<4>(in, bin, num, false));
        int32_t most = num < bin ? num : bin;
        put(lines, b, matrix<8>(in, 2 * p.num_lines, most, true));
      }
    }
    p.ones = in.template reals<E>(2 * p.num_lines);
    p.frequency_hz = in.template reals<E>(p.num_lines);
    p.gain_time = in.template reals<E>(bin);
    p.gain_lines = in.template reals<E>(p.num_lines);
  }

  static int32_t filled(int32_t num) { return (num + WHOLE - 1) / WHOLE * WHOLE; }

  void read_machine(Reader& in, Arena& arena) {
    Machine<E>& m = machine;
    m = {};
    m.num_channels = num_channels, m.num_inputs = plan.num_features;
    m.num_columns = in.number(1, MOST);
    m.num_scaled = in.number(1, MOST);
    m.num_singles = in.number(0, m.num_columns);
    m.num_pools = in.number(0, num_channels);
    m.single_inputs = in.numbers(m.num_singles, 0, m.num_inputs - 1);
    m.single_columns = in.numbers(m.num_singles, 0, m.num_columns - 1);
    Pool<E>* pools = arena.take<Pool<E>>(m.num_pools);
    for (int32_t i = 0; i < m.num_pools && !in.is_wrong; ++i) put(pools, i, pool(in));
    m.pools = pools;
    if (m.num_pools) m.fill = in.template reals<E>(m.num_columns);
    int64_t num = filled(m.num_scaled);
    m.sources = in.numbers(num, 0, m.num_columns - 1);
    m.minimum = in.template reals<E>(num);
    m.maximum = in.template reals<E>(num);
    if (in.number(0, 1)) m.compression = in.template reals<E>(num);
    m.imputation = in.template reals<E>(m.num_scaled);
    m.channels = in.numbers(m.num_scaled, -1, num_channels - 1);
    m.linear = in.template reals<E>(num);
    m.constant = (E)in.real(-1.7e308, 1.7e308);
    m.num_factors = in.number(0, MOST);
    m.num_quadratic = in.number(0, filled(m.num_scaled));
    int32_t num_rows = m.num_factors ? m.num_factors : m.num_quadratic;
    in.expect(m.num_factors ? m.num_quadratic % WHOLE == 0 : m.num_quadratic <= m.num_scaled);
    if (m.num_factors) m.signs = in.template reals<E>(filled(m.num_factors));
    if (m.num_quadratic)
      m.quadratic = in.template reals<E>((int64_t)filled(num_rows) * m.num_quadratic);
  }

  Pool<E> pool(Reader& in) {
    Pool<E> p = {};
    p.num_channels = in.number(1, num_channels);
    p.num_families = in.number(1, MOST);
    p.num_statistics = in.number(1, 256);
    int64_t num = filled(p.num_families);
    p.channels = in.numbers(p.num_channels, 0, num_channels - 1);
    p.inputs = in.numbers(p.num_channels * num, 0, machine.num_inputs - 1);
    p.statistics = in.numbers(p.num_statistics, 0, POOLED_ORDER);
    p.columns = in.numbers(p.num_statistics * num, -1, machine.num_columns - 1);
    p.fractions = in.template reals<E>(p.num_statistics);
    p.scales = in.template reals<E>(num);
    if (p.num_channels > machine.most_channels) machine.most_channels = p.num_channels;
    return p;
  }

  void read_onset(Reader& in) {
    Onset<E>& o = onset;
    o = {};
    o.num_fast = in.number(0, num_channels);
    o.num_slow = in.number(0, num_channels);
    o.num_filters = in.number(1, 16);
    o.num_windows = in.number(2, 16);
    o.num_pairs = in.number(0, MOST_BIN * 4);
    o.num_steps = in.number(1, 64);
    o.num_lags = in.number(0, 16);
    o.num_columns = in.number(1, MOST);
    o.num_layers = in.number(0, 8);
    o.hop = in.number(1, MOST_BIN);
    o.context = in.number(0, MOST_FRAME);
    o.delay = in.number(1, MOST_BIN);
    o.step_length = in.number(1, MOST_FRAME);
    o.blind = in.number(0, MOST);
    o.min_alive = in.number(1, num_channels);
    o.most_lost = in.number(0, MOST);
    in.expect(o.num_fast + o.num_slow > 0 && o.num_columns == num_onset_columns());
    if (in.is_wrong) return;
    int64_t num_fast = o.num_fast, num_filters = o.num_filters, num_columns = o.num_columns;
    o.fast = in.numbers(num_fast, 0, num_channels - 1);
    o.slow = in.numbers(o.num_slow, 0, num_channels - 1);
    o.windows = in.numbers(o.num_windows, 1, o.delay);
    o.first = in.numbers(o.num_pairs, 0, o.num_fast - 1);
    o.second = in.numbers(o.num_pairs, 0, o.num_fast - 1);
    o.lags = in.numbers(o.num_lags, 1, 256);
    o.widths = in.numbers(o.num_layers ? o.num_layers + 1 : 0, 1, MOST);
    for (int32_t i = 1; !in.is_wrong && i < o.num_lags; ++i) in.expect(o.lags[i - 1] < o.lags[i]);
    o.filters = in.template reals<E>((o.context + o.hop) * num_filters * o.hop);
    o.steps = in.template reals<E>((int64_t)o.step_length * o.num_steps);
    o.rounding = in.template reals<E>(num_filters * num_fast);
    o.silence = in.template reals<E>(num_filters * num_fast);
    o.least_step = in.template reals<E>(o.num_slow);
    o.rates = in.template reals<E>(NUM_FLOORS);
    o.slope = in.template reals<E>(num_columns);
    o.offset = in.template reals<E>(num_columns);
    if (o.num_layers) {
      int64_t num_weights = 0, num_biases = 0;
      for (int32_t i = 0; !in.is_wrong && i < o.num_layers; ++i) {
        num_weights += (int64_t)o.widths[i] * o.widths[i + 1];
        num_biases += o.widths[i + 1];
        in.expect(num_weights <= MOST);
      }
      in.expect(!in.is_wrong && o.widths[o.num_layers] == 1 &&
                o.widths[0] == num_columns * (1 + o.num_lags));
      o.weights = in.template reals<E>(num_weights);
      o.biases = in.template reals<E>(num_biases);
    } else {
      in.expect(!o.num_lags);
      if (in.number(0, 1)) o.quadratic = in.template reals<E>(num_columns * num_columns);
      o.linear = in.template reals<E>(num_columns);
      o.constant = (E)in.real(-1.7e308, 1.7e308);
    }
    o.is_still = in.flags(num_fast);
  }

  // As many as onset.cpp writes.
  int64_t num_onset_columns() const {
    const Onset<E>& o = onset;
    int64_t num = 0, rows = (int64_t)o.num_windows * o.num_filters;
    bool many_fast = o.num_fast > 1, many_slow = o.num_slow > 1;
    if (o.num_fast) num += (many_fast ? 4 : 1) * rows + (many_fast ? 2 : 1) * 4 * o.num_filters;
    if (many_fast) num += 2 * rows;
    if (o.num_slow) num += 2 * (many_slow ? 3 : 1) * o.num_steps + many_slow * o.num_steps;
    return num;
  }
};
