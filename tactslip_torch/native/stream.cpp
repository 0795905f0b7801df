// libtactslip (tactslip.h): a stream of samples to decisions and alarms, as onset/streaming.py makes
// them, in memory of the caller.

#include <math.h>
#include <string.h>

#include "file.h"

namespace {

constexpr double NOTHING_YET = -1e30;  // onset/rules.py
constexpr double LARGEST_LLR = 1e30, LARGEST_SCORE = 1e300;
constexpr int64_t LONG_AGO = (int64_t)1 << 62;
constexpr int MEAN_HOPS = 3;

// Which decisions raise an alarm: latch and _StreamRule of onset/.
struct Latch {
  int64_t since = LONG_AGO, run = 0;  // decisions since the last alarm; where positive ratios began
  int32_t below = 0, lost = 0;        // decisions in a row that are low, that are not valid
  bool is_on = false;
  int32_t rearm, refractory, most;

  // Whether what was gathered before the next valid decision is forgotten.
  bool begins_anew() const { return lost > most; }

  // Of the next decision; whether it raises an alarm.
  bool take(int64_t number, bool is_valid, bool is_high, bool is_positive) {
    if (since < LONG_AGO) ++since;
    if (!is_valid) {
      if (lost >= most) is_on = false, below = 0, run = number + 1;
      lost += lost <= most;
      return false;
    }
    lost = 0;
    if (!is_positive) run = number + 1;
    below = is_high ? 0 : below < MOST ? below + 1 : below;
    if (below >= (rearm > 1 ? rearm : 1)) is_on = false;
    if (is_on || !is_high || since < refractory) return false;
    is_on = true, since = 0;
    return true;
  }
};

int32_t most_lost(int64_t window, int64_t hold, int64_t hop) {
  return (int32_t)((window + hold + hop - 1) / hop);
}

}  // namespace

struct tactslip {
  bool is_double;
};

namespace {

template <class E> struct Stream : tactslip {
  Model<E> model;
  int level;
  E *held, *last;  // [channels, capacity] from sample `begin` on; [channels], the latest as it came
  int32_t *run;    // [channels] how many were equal to it
  int64_t begin, seen;
  int32_t capacity, num_held;
  int64_t number, hop;  // of the next bin, of the next hop of the onset classifier
  Latch of_bins, of_alarm;
  E recent[MOST_RULE];  // ratios of the last decisions; or the sum
  E scores[MEAN_HOPS - 1];
  uint8_t *is_lost, *used;  // [channels]; used: all ones
  E *span, *memory;
  int32_t num_lost;
  double hint;
  tactslip_decision bin;  // the last one
  void* space;  // of the engine, to work in

  // Reads the file, and gives all parts of the state their place in the arena, whose start may be
  // null: then they are counted, and not to be used.
  bool lay_out(Reader<E>& in, Arena& arena) {
    if (!model.read(in, arena)) return false;
    const Model<E>& m = model;
    int64_t reach = m.before + (m.frame > m.bin + m.after ? m.frame : m.bin + m.after);
    int64_t of_hop = m.has_onset ? m.onset.hop : 0, num_kept = 0, for_onset = 0;
    is_double = sizeof(E) == 8, level = tactslip_level(), hint = m.onset_hint;
    if (m.has_onset) {
      reach = m.onset.context > reach ? m.onset.context : reach;
      num_kept = (int64_t)OF_LEVEL(level, onset_memory<E>(&m.onset));
      for_onset = (int64_t)OF_LEVEL(level, onset_space<E>(&m.onset));
    }
    capacity = (int32_t)(reach + of_hop + (m.hop < m.bin ? m.hop : m.bin));
    Plan<E> numbers = m.plan;  // what the space depends on
    numbers.num_channels = 1;
    const Filter<E> longest = {nullptr, m.longest, 0};
    Bins<E> one = {};
    one.num_bins = 1, one.filters = &longest;
    auto for_features = (int64_t)OF_LEVEL(level, features_space<E>(&numbers, &m.machine, &one));
    space = arena.take<uint64_t>(((for_features > for_onset ? for_features : for_onset) + 7) / 8);
    held = arena.take<E>((int64_t)m.num_channels * capacity);
    last = arena.take<E>(m.num_channels);
    span = arena.take<E>(m.num_channels);
    memory = arena.take<E>(num_kept);
    run = arena.take<int32_t>(m.num_channels);
    is_lost = arena.take<uint8_t>(m.num_channels);
    used = arena.take<uint8_t>(m.num_channels);
    return true;
  }

  void reset() {
    const Model<E>& m = model;
    begin = -m.before, num_held = m.before, seen = 0;
    number = hop = 0, num_lost = 0;
    for (int32_t c = 0; c < m.num_channels; ++c) last[c] = (E)NAN, run[c] = 0, used[c] = 1;
    int64_t window = m.before + m.bin + m.after;
    of_bins = Latch{}, of_alarm = Latch{};
    of_bins.rearm = m.rearm, of_bins.refractory = m.refractory;
    of_bins.most = most_lost(window, m.hold, m.hop);
    forget();
    memset(is_lost, 0, (size_t)m.num_channels);
    bin = {};
    bin.score = bin.probability = bin.statistic = bin.onset_score = NAN;
    bin.onset_s = INFINITY, bin.channels_lost = is_lost;
    if (!m.has_onset) return;
    of_alarm.rearm = m.rearm, of_alarm.refractory = m.refractory;
    of_alarm.most = most_lost(window, m.hold, m.onset.hop);
    for (E& each : scores) each = (E)NAN;
    memset(memory, 0, OF_LEVEL(level, onset_memory<E>(&m.onset)) * sizeof(E));
  }

  // Of the alarm, whose hint, if there is one, is never the higher one.
  void set_threshold(double value) {
    (model.has_onset ? model.onset_threshold : model.threshold) = value;
    hint = isfinite(model.onset_hint) && value < model.onset_hint ? value : model.onset_hint;
  }

  // What the rule gathered.
  void forget() {
    for (E& each : recent) each = model.n ? (E)NOTHING_YET : 0;
  }

  // -- Samples --------------------------------------------------------------------------------------

  template <class X> size_t push(const X* rows, size_t n) {
    constexpr bool are_counts = (X)0.5 == 0;
    const Model<E>& m = model;
    int64_t room = capacity - num_held;
    if (room < (int64_t)n) room += drop();
    if (room < (int64_t)n) n = (size_t)room;
    for (size_t i = 0; i < n; ++i)
      for (int32_t c = 0; c < m.num_channels; ++c) {
        E x = rows ? (E)rows[i * (size_t)m.num_channels + (size_t)c] : (E)NAN;
        if (are_counts) x = m.scale[c] * x + m.zero[c];
        run[c] = x == last[c] ? run[c] < MOST ? run[c] + 1 : run[c] : 1;
        last[c] = x;
        held[(int64_t)c * capacity + num_held + (int64_t)i] = run[c] > m.stuck ? (E)NAN : x;
      }
    num_held += (int32_t)n, seen += (int64_t)n;
    return n;
  }

  // Forget samples that no decision to come needs; how many.
  int32_t drop() {
    const Model<E>& m = model;
    int64_t first = number * m.hop - m.before;
    if (m.has_onset) {
      int64_t block = hop > first_block() ? hop : first_block();
      int64_t own = block * m.onset.hop - m.onset.context;
      first = own < first ? own : first;
    }
    int64_t surplus = first - begin < num_held ? first - begin : num_held;
    if (surplus <= 0) return 0;
    for (int32_t c = 0; c < m.num_channels; ++c) {
      E* row = held + (int64_t)c * capacity;
      memmove(row, row + surplus, (size_t)(num_held - surplus) * sizeof(E));
    }
    begin += surplus, num_held -= (int32_t)surplus;
    return (int32_t)surplus;
  }

  // The first hop that has its context.
  int64_t first_block() const {
    return (model.onset.context + model.onset.hop - 1) / model.onset.hop;
  }

  // What filters take to lie before a stream: signals/filtering.py, past_of.
  void make_past() {
    const Model<E>& m = model;
    for (int32_t c = 0; c < m.num_channels; ++c) {
      E *row = held + (int64_t)c * capacity, *x = row + m.before;
      if (m.frame_of[c] < 0) continue;
      const Frame<E>& frame = m.frames[m.frame_of[c]];
      for (int32_t i = 0; i < frame.reach; ++i) {
        E sum = 0;
        for (int32_t j = 0; j < frame.length; ++j)
          sum += (x[j] - x[0]) * frame.past[i * frame.length + j];
        row[m.before - frame.reach + i] = x[0] + sum;
      }
    }
  }

  // -- Decisions ------------------------------------------------------------------------------------

  int next(tactslip_decision* out) {
    const Model<E>& m = model;
    if (!m.has_onset) {
      if (seen < known_at(number)) return 0;
      decide(known_at(number));
      *out = bin;
      return 1;
    }
    int64_t end = (hop + 1) * m.onset.hop;
    if (seen < end) return 0;
    while (known_at(number) <= end) decide(number * m.hop + m.bin + m.after);
    *out = bin;
    join(out, end);
    return 1;
  }

  // Samples that must have come for a decision on a bin.
  int64_t known_at(int64_t of) const {
    int64_t end = of * model.hop + model.bin + model.after;
    return end < model.frame ? model.frame : end;
  }

  // The next decision on a bin: Decider.decide.
  void decide(int64_t end) {
    const Model<E>& m = model;
    if (!number) make_past();
    E score = (E)NAN;
    uint8_t is_valid = 0, in_range = 0, is_odd = 0;
    Bins<E> bins = {};
    bins.samples = held + (number * m.hop - m.before - begin);
    bins.is_float = sizeof(E) == 4, bins.num_bins = 1, bins.channel_stride = capacity;
    bins.filters = m.filters, bins.is_odd = &is_odd, bins.score = &score;
    bins.sensing = &m.sensing, bins.is_lost = is_lost, bins.is_valid = &is_valid;
    bins.in_range = &in_range, bins.span = span, bins.score_as_float = sizeof(E) == 4;
    OF_LEVEL(level, features<E>(&m.plan, &m.machine, &bins, space));
    is_valid = is_valid && !is_odd && score - score == 0;
    E ratio = is_valid ? ratio_of(score) : (E)NAN, statistic = (E)NAN;
    if (is_valid && of_bins.begins_anew()) forget();
    if (is_valid) statistic = m.n ? kth_largest(ratio) : sum_with(ratio);
    bool is_high = statistic >= (E)m.threshold;
    bin.number = (uint64_t)number;
    bin.is_alarm = of_bins.take(number, is_valid, is_high, ratio > 0);
    bin.is_on = of_bins.is_on;
    bin.time_s = (double)end / m.rate_hz;
    int64_t began = of_bins.run < number ? of_bins.run : number;
    double lasted_s = (double)((number - began) * m.hop) / m.rate_hz + m.lead_s;
    bin.onset_s = bin.time_s - (lasted_s > 0 ? lasted_s : 0);
    bin.score = is_valid ? (double)score : NAN;
    bin.probability = (double)(E)(1 / (1 + exp(-(double)(E)(ratio + (E)m.log_odds))));
    bin.statistic = (double)statistic;
    bin.is_valid = is_valid, bin.in_range = is_valid && in_range;
    ++number;
  }

  // Log likelihood ratio of a score: Platt.llr.
  E ratio_of(E score) const {
    double x = (double)score;
    x = x < -LARGEST_SCORE ? -LARGEST_SCORE : x > LARGEST_SCORE ? LARGEST_SCORE : x;
    double line = model.slope * x + model.offset;
    return (E)(line < -LARGEST_LLR ? -LARGEST_LLR : line > LARGEST_LLR ? LARGEST_LLR : line);
  }

  // KOfN: how many are larger, or equal and earlier, says the place of each.
  E kth_largest(E latest) {
    int32_t n = model.n;
    recent[n - 1] = latest;
    E found = latest;
    for (int32_t i = 0; i < n; ++i) {
      int32_t place = 0;
      for (int32_t j = 0; j < n; ++j)
        place += recent[j] > recent[i] || (recent[j] == recent[i] && j < i);
      if (place == model.k - 1) found = recent[i];
    }
    memmove(recent, recent + 1, (size_t)(n - 1) * sizeof(E));
    return found;
  }

  // Cusum
  E sum_with(E latest) {
    E sum = recent[0] + (E)model.evidence * (latest - (E)model.drift);
    double bounded = sum > 0 ? (double)sum : 0;
    return recent[0] = (E)(bounded < model.ceiling ? bounded : model.ceiling);
  }

  // The next decision of the onset classifier, at a sample: Decider.join.
  void join(tactslip_decision* out, int64_t end) {
    const Model<E>& m = model;
    double score = hop < first_block() ? NOTHING_YET : onset_score();
    bool is_known = score > NOTHING_YET, is_high = score >= m.onset_threshold;
    out->number = (uint64_t)hop++;
    out->is_alarm = of_alarm.take(0, is_known, is_high, is_high);
    out->is_on = of_alarm.is_on;
    out->time_s = (double)end / m.rate_hz;
    if (is_high) out->onset_s = out->time_s - m.onset_lead_s;
    if (!(out->onset_s < out->time_s)) out->onset_s = out->time_s;
    out->is_valid |= is_known;
    out->onset_score = is_known ? score : NAN;
    out->by_onset = is_high;
    out->is_hint = score >= hint;
  }

  // OnsetStream: mean over the last hops that are not lost.
  double onset_score() {
    const Model<E>& m = model;
    E score = (E)NAN;
    uint8_t lost = 0;
    OnsetHops<E> run_of = {};
    run_of.samples = held + (hop * m.onset.hop - m.onset.context - begin);
    run_of.is_float = sizeof(E) == 4, run_of.channel_stride = capacity, run_of.num_hops = 1;
    run_of.num_lost = num_lost, run_of.memory = memory, run_of.in_use = used;
    run_of.score = &score, run_of.is_lost = &lost;
    OF_LEVEL(level, onset<E>(&m.onset, &run_of, space));
    num_lost = run_of.num_lost;
    if (lost) return NOTHING_YET;
    double sum = (double)scores[0] + (double)scores[1] + (double)score;
    scores[0] = scores[1], scores[1] = score;
    return sum - sum == 0 ? sum / MEAN_HOPS : NOTHING_YET;
  }
};

// -- Files ----------------------------------------------------------------------------------------------

struct Remainders {
  uint32_t of[256] = {};
  constexpr Remainders() {
    for (uint32_t i = 0; i < 256; ++i) {
      of[i] = i;
      for (int bit = 0; bit < 8; ++bit) of[i] = of[i] >> 1 ^ (of[i] & 1 ? 0xedb88320u : 0);
    }
  }
};

// CRC-32 as in zlib.
uint32_t checksum_of(const char* bytes, size_t count) {
  static constexpr Remainders remainders;
  uint32_t rest = ~0u;
  for (size_t i = 0; i < count; ++i)
    rest = rest >> 8 ^ remainders.of[(rest ^ (uint8_t)bytes[i]) & 255];
  return ~rest;
}

int check_head(const void* file, size_t bytes, Head& head) {
  if (!file || bytes < sizeof(Head)) return TACTSLIP_NO_FILE;
  memcpy(&head, file, sizeof(Head));
  if (memcmp(head.magic, MAGIC, sizeof MAGIC) != 0) return TACTSLIP_NO_FILE;
  if (head.format != FORMAT) return TACTSLIP_VERSION;
  if (head.bytes != bytes) return TACTSLIP_DAMAGED;
  if (head.number_bytes != 4 && head.number_bytes != 8) return TACTSLIP_INVALID;
#ifdef TACTSLIP_FLOAT
  if (head.number_bytes == 8) return TACTSLIP_PRECISION;
#endif
  return (uintptr_t)file % head.number_bytes ? TACTSLIP_ALIGNMENT : TACTSLIP_OK;
}

// One of several texts, one behind the other.
const char* text_of(const char* texts, uint32_t index) {
  while (index--) texts += strlen(texts) + 1;
  return texts;
}

constexpr size_t aligned_up(size_t bytes) { return (bytes + 7) / 8 * 8; }

template <class E> int describe(const char* file, size_t bytes, tactslip_info* info) {
  Stream<E> stream;
  Reader<E> in = {file, bytes};
  Arena arena = {nullptr};
  if (!stream.lay_out(in, arena)) return TACTSLIP_INVALID;
  if (!info) return TACTSLIP_OK;
  const Model<E>& model = stream.model;
  info->state_bytes = aligned_up(sizeof(Stream<E>)) + arena.used;
  info->num_channels = (uint32_t)model.num_channels;
  info->hop_samples = (uint32_t)(model.has_onset ? model.onset.hop : model.hop);
  int32_t first = model.bin + model.after;
  info->first_samples = (uint32_t)(first > model.frame ? first : model.frame);
  info->bin_samples = (uint32_t)model.bin;
  info->sample_rate_hz = model.rate_hz;
  info->is_double = sizeof(E) == 8, info->has_onset = model.has_onset;
  info->unit = text_of(model.names, info->num_channels);
  return TACTSLIP_OK;
}

template <class E>
int make(const char* file, size_t bytes, char* state, size_t state_bytes, tactslip** to) {
  tactslip_info info;
  int code = describe<E>(file, bytes, &info);
  if (code) return code;
  if (!state || state_bytes < info.state_bytes) return TACTSLIP_STATE;
  if ((uintptr_t)state % 8) return TACTSLIP_ALIGNMENT;
  auto* stream = (Stream<E>*)state;
  memset(state, 0, info.state_bytes);
  Reader<E> in = {file, bytes};
  Arena arena = {state + aligned_up(sizeof(Stream<E>))};
  stream->lay_out(in, arena);
  stream->reset();
  *to = stream;
  return TACTSLIP_OK;
}

#ifdef TACTSLIP_FLOAT
#define OF(self, call) ((Stream<float>*)(self))->call
#define OF_NUMBERS(head, function, arguments) function<float> arguments
#else
#define OF(self, call) \
  ((self)->is_double ? ((Stream<double>*)(self))->call : ((Stream<float>*)(self))->call)
#define OF_NUMBERS(head, function, arguments) \
  (head.number_bytes == 8 ? function<double> arguments : function<float> arguments)
#endif

}  // namespace

extern "C" {

int tactslip_open(const void* file, size_t bytes, tactslip_info* info) {
  Head head;
  int code = check_head(file, bytes, head);
  if (code) return code;
  constexpr size_t begin = offsetof(Head, number_bytes);
  if (checksum_of((const char*)file + begin, bytes - begin) != head.checksum)
    return TACTSLIP_DAMAGED;
  return OF_NUMBERS(head, describe, ((const char*)file, bytes, info));
}

int tactslip_init(
    const void* file, size_t bytes, void* state, size_t state_bytes, tactslip** detector) {
  Head head;
  int code = check_head(file, bytes, head);
  if (code) return code;
  return OF_NUMBERS(head, make, ((const char*)file, bytes, (char*)state, state_bytes, detector));
}

size_t tactslip_push(tactslip* self, const float* samples, size_t n) {
  return OF(self, push(samples, n));
}
size_t tactslip_push_double(tactslip* self, const double* samples, size_t n) {
  return OF(self, push(samples, n));
}
size_t tactslip_push_int16(tactslip* self, const int16_t* counts, size_t n) {
  return OF(self, push(counts, n));
}
size_t tactslip_push_int32(tactslip* self, const int32_t* counts, size_t n) {
  return OF(self, push(counts, n));
}
int tactslip_next(tactslip* self, tactslip_decision* decision) { return OF(self, next(decision)); }
void tactslip_set_threshold(tactslip* self, double value) { OF(self, set_threshold(value)); }
void tactslip_reset(tactslip* self) { OF(self, reset()); }

const char* tactslip_channel(const tactslip* self, uint32_t index) {
  if (index >= (uint32_t)OF(self, model.num_channels)) return nullptr;
  return text_of(OF(self, model.names), index);
}

const char* tactslip_version() { return "libtactslip, file format 1"; }

const char* tactslip_error(int code) {
  static const char* const texts[] = {
      "no error",
      "not a .tslip file; write one with tactslip export graph=native",
      "a file of another format version; export the detector again",
      "the file is damaged: another length or checksum; copy it again",
      "the file's numbers do not fit each other; export it again",
      "a float64 file in a library for float32; export it with precision=float32",
      "file or state must begin at a multiple of 8 bytes",
      "the state has fewer bytes than tactslip_open says",
  };
  return code >= 0 && code <= TACTSLIP_STATE ? texts[code] : "no such code";
}
}
