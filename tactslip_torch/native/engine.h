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
  int64_t num_features, num_coefficients, num_slow, num_fast;
  const int64_t *slow, *fast;  // channels that are read
  // of each channel and row: where its part of descriptor and column starts, and which bits it has
  const int64_t *first, *descriptor, *column;
  const uint32_t* need;
  // from a bin, or an approximation's coefficients, to those one level coarser; to branches; to lines
  const Matrix *low, *high, *out, *lines;
  const void* ones;  // [2 num_lines] spectrum of the constant 1
  const double *frequency_hz, *gain_time, *gain_lines;
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
