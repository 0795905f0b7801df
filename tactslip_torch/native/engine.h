// What the door hands to the engine; native/__init__.py has the same fields.
#pragma once
#include <stdint.h>

enum Descriptor {
  MEAN, MEDIAN, MODE, RANGE, MEAN_DEVIATION, STD, CV, IQR, SKEWNESS, KURTOSIS, ENERGY, ENTROPY,
  PEAK_FACTOR, CORRELATION, SPECTRAL_CENTROID, SPECTRAL_SPREAD, RMS, MEAN_ABS_CHANGE, NUM_DESCRIPTORS
};
constexpr int MAX_BRANCHES = 32;  // and at least NUM_DESCRIPTORS, whose place band energy ratios take

// Blocks of rows, 4 or 8; of each block `width` columns from `first` on are not zero.
struct Matrix {
  const void* values;    // [num_blocks, width, rows of a block]
  const int64_t* first;  // [num_blocks]
  int64_t num_blocks, num_columns, width;
};

struct Plan {
  int64_t is_float;  // statistics in float, of rows scaled to order one
  int64_t num_channels, num_samples, num_lines, num_branches;
  int64_t num_features, num_coefficients, num_slow, num_fast;
  const int64_t *slow, *fast;  // channels that are read
  // of each channel and row (branches, their spectra, band energy ratios, the bin itself): where its part of descriptor and column starts, and which bits it has
  const int64_t *first, *descriptor, *column;
  const uint32_t* need;
  // from a bin, or an approximation's coefficients, to those one level coarser; to branches; to lines
  const Matrix *low, *high, *out, *lines;
  const void* ones;  // [2 num_lines] spectrum of the constant 1
  const double *frequency_hz, *gain_time, *gain_lines;
};

// Weights of a channel's filter, and where the frame of a bin's first sample begins.
struct Filter {
  const double* weights;  // [length]
  int64_t length, start;
};

// What is known of channels that work: Sensing, one number a channel.
struct Sensing {
  const double* inverse_span;  // one over the least span above rounding, as a part of the loudest sample
  const double *floor, *low, *high;  // span of silence; least and largest span in range
  const uint8_t* counted;            // whether it counts among those that must be alive
  int64_t min_alive;
};

// Bins to be described, and where what is found is written; a null pointer: it is not wanted.
struct Bins {
  const void* samples;  // those of a channel lie side by side; without a plan: inputs of a machine, double
  int64_t is_float, num_bins, bin_stride, channel_stride;  // in samples
  const Filter* filters;  // [channels]
  void* features;         // [M, features]
  int64_t features_are_float;
  uint8_t* is_odd;  // [M] a magnitude is out of range: what is found is of no meaning
  // for a machine
  double *scaled, *score;  // [M, columns], [M]
  const Sensing* sensing;  // null: what is missing makes a score NaN
  uint8_t *is_lost, *is_valid, *in_range;  // [M, C], [M], [M]; without a plan is_lost is given
  double* span;                            // [M, C], NaN where missing
  int64_t score_as_float;                  // so is it bounded
};

enum Statistic { POOLED_MEAN, POOLED_STD, POOLED_MIN, POOLED_MAX, POOLED_ORDER };

// Arrays of families, scaled columns and rows of a head are filled up to a multiple of this, so that
// any vector reads whole.
constexpr int WHOLE = 8;

// Descriptors of the channels of one kind, whose statistics over these channels are columns.
struct Pool {
  int64_t num_channels, num_families, num_statistics;
  const int64_t *channels, *inputs;  // in the hand; [channels, families]
  const int64_t *statistics, *columns;  // [statistics]; [statistics, families], -1: not wanted
  const double *fractions, *scales;  // of orders among ascending values, from 0 to 1; [families]
};

// From inputs (features) to columns, to scaled columns, and to a score.
struct Machine {
  int64_t num_channels, num_inputs, num_columns, num_scaled, num_quadratic;
  int64_t num_factors, num_singles, num_pools, most_channels;
  const int64_t *single_inputs, *single_columns;  // of columns that are not pooled
  const Pool* pools;
  const double* fill;       // [columns], where no channel is in use; null: nothing is pooled
  const int64_t* sources;   // [scaled], the column that each is made of
  const double *minimum, *maximum, *compression;  // [scaled]; null: not scaled, not compressed
  const double* imputation;  // [scaled], of a lost channel; null: they stay as they are
  const int64_t* channels;   // [scaled], -1: of several; null without imputation
  // of the first num_quadratic scaled columns, [blocks, columns, WHOLE rows of a block]; null: none.
  // Without signs: lower triangle, off its diagonal twice. With them: factors, as many columns as a
  // multiple of WHOLE has.
  const double* quadratic;
  const double* signs;   // [factors], 1 or -1; null: there are no factors
  const double* linear;  // [scaled]; null: no score
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
struct Onset {
  int64_t num_fast, num_slow, num_filters, num_windows, num_pairs, num_steps, num_lags, num_columns;
  int64_t num_layers;  // of a network; 0: the quadratic form
  int64_t hop, context, delay, step_length;  // samples, samples, blocks, blocks
  int64_t blind, min_alive, most_lost;       // blocks; channels; lost blocks until all begins anew
  const int64_t *fast, *slow, *windows;      // channels; blocks, ascending
  const int64_t *first, *second, *lags, *widths;  // [pairs] twice; hops, ascending; [layers + 1]
  const double *filters, *steps;  // [context + hop, filters, hop], [step_length, steps]
  const double *rounding, *silence;  // [filters, fast]: power, half the log power
  const double *least_step, *rates;  // [slow], [floors]
  const double *slope, *offset;      // [columns]
  const double *weights, *biases;    // of layers, one behind the other, [in, out] and [out]
  const double *quadratic, *linear;  // quadratic may be null
  const uint8_t* is_still;           // [fast]
  double constant;
};

// Hops to be scored, and what is kept between them: Memory.
struct OnsetHops {
  const void* samples;  // from `context` before the first hop; those of a channel lie side by side
  int64_t is_float, channel_stride, num_hops, num_lost;  // the last: lost blocks so far, updated
  double* memory;
  const uint8_t* in_use;  // [channels]
  double* score;          // [hops], NaN without evidence
  uint8_t* is_lost;       // [hops]
  double* columns;        // [hops, columns], NaN of lost blocks; may be null
};
