// What the door hands to the engine; native/__init__.py has the same fields.
#pragma once
#include <stdint.h>

enum Descriptor {
  MEAN, MEDIAN, MODE, RANGE, MEAN_DEVIATION, STD, CV, IQR, SKEWNESS, KURTOSIS, ENERGY, ENTROPY,
  PEAK_FACTOR, CORRELATION, SPECTRAL_CENTROID, SPECTRAL_SPREAD, NUM_DESCRIPTORS
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
  int64_t num_features, num_coefficients, num_slow, num_fast, num_unused;
  const int64_t *slow, *fast, *unused;  // channels that are read, and the others
  // of each channel and row: where its part of descriptor and column starts, and which bits it has
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
  uint8_t *is_missing, *is_valid;  // [M, C], [M]; if given, channels with a NaN or Inf are left out
  const double* inverse_span;  // [C] one over the least span that can be trusted, by the loudest sample
  int64_t given_as_float;      // so is a score bounded
};

enum Statistic { POOLED_MEAN, POOLED_STD, POOLED_MIN, POOLED_MAX, POOLED_ORDER };

// Descriptors of the channels of one kind, whose statistics over these channels are columns.
struct Pool {
  int64_t num_channels, num_families, num_statistics;
  const int64_t *channels, *ranges;  // in the hand; inputs that tell whether a channel moves
  const int64_t* inputs;             // [families, channels]
  const int64_t *statistics, *columns;  // [statistics]; [statistics, families], -1: not wanted
  const double *fractions, *knees;  // of orders among ascending values, from 0 to 1; [families]
  double least_range;
};

// From inputs (features) to columns, to scaled columns, and to a score.
struct Machine {
  int64_t num_channels, num_inputs, num_columns, num_singles, num_pools, most_channels;
  const int64_t *single_inputs, *single_columns;  // inputs that are columns as they are
  const Pool* pools;
  const double *fill, *minimum, *maximum, *knee;  // [columns]; null: not pooled, scaled, compressed
  const double *quadratic, *linear;  // lower triangle, off its diagonal twice; null: none
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

// Evidence of onsets, and the machine on it: OnsetClassifier.
struct Onset {
  int64_t num_fast, num_slow, num_filters, num_windows, num_steps, num_columns;
  int64_t hop, context, memory, step_length;  // samples, samples, blocks, blocks
  const int64_t *fast, *slow, *windows;       // channels; blocks, ascending
  const double *filters, *steps;  // [context + hop, filters, hop], [step_length, steps]
  const double *fast_knee, *slow_knee, *slope, *offset, *quadratic, *linear;  // quadratic may be null
  double constant;
};

// Hops to be scored, and the memory of blocks, to which theirs are written.
struct OnsetHops {
  const void* samples;  // from `context` before the first hop; those of a channel lie side by side
  int64_t is_float, channel_stride, num_hops, num_before;  // blocks that are there
  double* rows;             // [before + hops, fast * filters + slow]
  const uint8_t* listened;  // [channels]
  double* score;            // [hops], NaN without evidence
};
