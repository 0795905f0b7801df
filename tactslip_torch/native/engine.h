// What the engine is given; native/__init__.py has the same fields, and fills them.
//
// E is the number type, float or double, of all that is computed. Nothing here is written but what
// `Bins`, `OnsetHops` and `BristleRun` are for, so that all else may lie in constant memory.
#pragma once
#include <stddef.h>
#include <stdint.h>

enum Descriptor {
  MEAN, MEDIAN, MODE, RANGE, MEAN_DEVIATION, STD, CV, IQR, SKEWNESS, KURTOSIS, ENERGY, ENTROPY,
  PEAK_FACTOR, CORRELATION, SPECTRAL_CENTROID, SPECTRAL_SPREAD, RMS, MEAN_ABS_CHANGE, NUM_DESCRIPTORS
};
constexpr int MAX_BRANCHES = 32;  // and at least NUM_DESCRIPTORS, whose place band energy ratios take

constexpr int ROWS = 8;  // of a block of a matrix

// Blocks of rows, of each of which `width` columns from `first` on are not zero.
template <class E> struct Matrix {
  const E* values;       // [num_blocks, width, ROWS]; null: nothing reads it
  const int32_t* first;  // [num_blocks]
  int32_t num_blocks, num_columns, width;
};

template <class E> struct Plan {
  int32_t num_channels, num_samples, num_lines, num_branches;
  int32_t num_features, num_coefficients, num_slow, num_fast, num_points;
  const int32_t *slow, *fast;  // channels that are read
  // of each channel and row (branches, their spectra, band energy ratios, the bin itself): where its part of descriptor and column starts, and which bits it has
  const int32_t *first, *descriptor, *column;
  const uint32_t* need;
  // from a bin, or an approximation's coefficients, to those one level coarser; to branches; to lines
  const Matrix<E> *low, *high, *out, *lines;
  // of a Fourier transform to the lines of branches for which `lines` has no matrix; num_points = 0:
  // there is none. Cosines of angles, which num_points of make a turn, and the gain of each line.
  const E *cosines, *line_gains;  // [num_points 5 / 4], [num_lines]
  const E* ones;  // [2 num_lines] spectrum of the constant 1
  const E *frequency_hz, *gain_time, *gain_lines;  // gains: what one more value in a cell adds
};

// Weights of a channel's filter, and where the frame of a bin's first sample begins.
template <class E> struct Filter {
  const E* weights;  // [length]
  int32_t length, start;
};

// What is known of channels that work: Sensing, one number a channel.
template <class E> struct Sensing {
  const E* inverse_span;  // one over the least span above rounding, as a part of the loudest sample
  const E *floor, *low, *high;  // span of silence; least and largest span in range
  const uint8_t* counted;       // whether it counts among those that must be alive
  int32_t min_alive;
};

// Bins to be described, and where what is found is written; a null pointer: it is not wanted.
template <class E> struct Bins {
  const void* samples;  // those of a channel lie side by side; without a plan: inputs of a machine, E
  int32_t is_float, num_bins, bin_stride, channel_stride;  // in samples
  const Filter<E>* filters;  // [channels]
  void* features;            // [M, features]
  int32_t features_are_float;
  uint8_t* is_odd;  // [M] a magnitude is out of range: what is found is of no meaning
  // for a machine
  E *scaled, *score;          // [M, columns], [M]
  const Sensing<E>* sensing;  // null: what is missing makes a score NaN
  uint8_t *is_lost, *is_valid, *in_range;  // [M, C], [M], [M]; without a plan is_lost is given
  E* span;                                 // [M, C], NaN where missing
  int32_t score_as_float;                  // so is it bounded
};

enum Statistic { POOLED_MEAN, POOLED_STD, POOLED_MIN, POOLED_MAX, POOLED_ORDER };

// Arrays of families, scaled columns and rows of a head are filled up to a multiple of this, so that
// any vector reads whole.
constexpr int WHOLE = 16;

// Descriptors of the channels of one kind, whose statistics over these channels are columns.
template <class E> struct Pool {
  int32_t num_channels, num_families, num_statistics;
  const int32_t *channels, *inputs;  // in the hand; [channels, families]
  const int32_t *statistics, *columns;  // [statistics]; [statistics, families], -1: not wanted
  const E *fractions, *scales;  // of orders among ascending values, from 0 to 1; [families]
};

// From inputs (features) to columns, to scaled columns, and to a score.
template <class E> struct Machine {
  int32_t num_channels, num_inputs, num_columns, num_scaled, num_quadratic;
  int32_t num_factors, num_singles, num_pools, most_channels;
  const int32_t *single_inputs, *single_columns;  // of columns that are not pooled
  const Pool<E>* pools;
  const E* fill;           // [columns], where no channel is in use; null: nothing is pooled
  const int32_t* sources;  // [scaled], the column that each is made of
  // [scaled]; null: not scaled, not compressed. In float, columns and their minimum are less a centre
  // where their range is narrow, or its digits are lost.
  const E *minimum, *width, *compression, *centre;
  const E* imputation;      // [scaled], of a lost channel; null: they stay as they are
  const int32_t* channels;  // [scaled], -1: of several; null without imputation
  // of the first num_quadratic scaled columns, [blocks, columns, WHOLE rows of a block]; null: none.
  // Without signs: lower triangle, off its diagonal twice. With them: factors, as many columns as a
  // multiple of WHOLE has.
  const E* quadratic;
  const E* signs;   // [factors], 1 or -1; null: there are no factors
  const E* linear;  // [scaled]; null: no score
  double constant;
};

// Lanes of skin and bristles to be carried through time; a lane's numbers lie num_lanes apart.
struct BristleRun {
  int64_t num_lanes, num_bristles, num_steps, every, patience;
  double step_s, gamma;
  const double *table, *pressure;  // [12, L], [n]
  double *states, *bristles;       // [3, L] and [L, n], taken on
  const double *arm, *load;        // [2 steps, L]
  double* out;                     // [3, steps / every, L]
};

// Evidence of slip, and the head on it: OnsetClassifier.
template <class E> struct Onset {
  int32_t num_fast, num_slow, num_filters, num_windows, num_pairs, num_steps, num_lags, num_columns;
  int32_t num_layers;  // of a network; 0: the quadratic form
  int32_t hop, context, delay, step_length;  // samples, samples, blocks, blocks
  int32_t blind, min_alive, most_lost;       // blocks; channels; lost blocks until all begins anew
  const int32_t *fast, *slow, *windows;      // channels; blocks, ascending
  const int32_t *first, *second, *lags, *widths;  // [pairs] twice; hops, ascending; [layers + 1]
  const E *filters, *steps;        // [context + hop, filters, hop], [step_length, steps]
  const E *rounding, *silence;     // [filters, fast]: power, half the log power
  const E *least_step, *rates;     // [slow], [floors]
  const E *slope, *offset;         // [columns]
  const E *weights, *biases;       // of layers, one behind the other, [in, out] and [out]
  const E *quadratic, *linear;     // quadratic may be null
  const uint8_t* is_still;         // [fast]
  double constant;
};

// Hops to be scored, and what is kept between them: Memory.
template <class E> struct OnsetHops {
  const void* samples;  // from `context` before the first hop; those of a channel lie side by side
  int32_t is_float, channel_stride, num_hops, num_lost;  // the last: lost blocks so far, updated
  E* memory;              // zeros at first
  const uint8_t* in_use;  // [channels]
  E* score;               // [hops], NaN without evidence
  uint8_t* is_lost;       // [hops]
  E* columns;             // [hops, columns], NaN of lost blocks; may be null
};

// The engine of one instruction set. `space` is memory to work in, anywhere and of any content, of
// as many bytes as `..._space` says, which looks at numbers alone (and at windows, lags and widths).
#define ENGINE_OF(level)                                                                           \
  namespace level {                                                                                \
  template <class E> size_t features_space(const Plan<E>*, const Machine<E>*, const Bins<E>*);     \
  template <class E> void features(const Plan<E>*, const Machine<E>*, const Bins<E>*, void* space); \
  template <class E> size_t scores_space(const Machine<E>*, int32_t num_bins);                     \
  template <class E>                                                                               \
  void scores(const Machine<E>*, const Bins<E>*, const E* inputs, int32_t stride, int32_t start,   \
             int32_t num, void* space); /* of features: what features() calls */                   \
  template <class E> size_t onset_memory(const Onset<E>*); /* in numbers */                        \
  template <class E> size_t onset_space(const Onset<E>*);                                          \
  template <class E> void onset(const Onset<E>*, OnsetHops<E>*, void* space);                      \
  size_t bristles_space(const BristleRun*);                                                        \
  void bristles(const BristleRun*, void* space);                                                   \
  }

// OF_LEVEL(level, features(...)) calls that of level 2, 3 or 4, as in x86-64-v3; elsewhere there is one.
#if defined(__x86_64__) && !defined(TACTSLIP_PORTABLE)
ENGINE_OF(v2)
ENGINE_OF(v3)
ENGINE_OF(v4)
#define OF_LEVEL(level, call) ((level) >= 4 ? v4::call : (level) == 3 ? v3::call : v2::call)
#else
ENGINE_OF(v1)
#define OF_LEVEL(level, call) ((void)(level), v1::call)
#endif

extern "C" int tactslip_level();  // the best of this processor
