/* Volts [T, C] from a .npy file (version 1 to 3, little-endian float32 or float64, C order). */
#ifndef NPY_H
#define NPY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdio.h>

struct npy {
    FILE *file;
    size_t num_samples, num_channels;
    bool is_double;
};

/* Opens a file that holds all of [T, num_channels]; else false, and says why. */
bool npy_open(struct npy *npy, const char *path, size_t num_channels, char *error, size_t size);

/* Reads the next n instants, or tells that the file was cut meanwhile. */
bool npy_read(struct npy *npy, void *samples, size_t n);

void npy_close(struct npy *npy);

#endif
