#include "npy.h"

#include <ctype.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { LONGEST_HEADER = 4096, MOST_AXES = 8, LAST_VERSION = 3 };

struct header {
    char text[LONGEST_HEADER];
    char dtype[16];
    size_t shape[MOST_AXES];
    int num_axes, version; /* 0: no .npy at all */
    bool is_fortran;
};

static bool fail(struct npy *npy, char *error, size_t size, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(error, size, format, arguments);
    va_end(arguments);
    npy_close(npy);
    return false;
}

/* What stands behind a key of the header, a Python dict as numpy writes it, or NULL. */
static const char *value_of(const struct header *header, const char *key) {
    const char *at = strstr(header->text, key);
    return at ? at + strlen(key) + strspn(at + strlen(key), " :") : NULL;
}

static bool read_header(FILE *file, struct header *header) {
    uint8_t start[12]; /* magic, version, length: 2 bytes in version 1, 4 in later ones */
    if (fread(start, 1, 10, file) != 10 || memcmp(start, "\x93NUMPY", 6)) return false;
    header->version = start[6];
    size_t length = start[8] | (size_t)start[9] << 8;
    if (start[6] > 1) {
        if (fread(start + 10, 1, 2, file) != 2) return false;
        length |= (size_t)start[10] << 16 | (size_t)start[11] << 24;
    }
    if (start[6] < 1 || start[6] > LAST_VERSION || length >= LONGEST_HEADER) return false;
    if (fread(header->text, 1, length, file) != length) return false;
    header->text[length] = '\0';

    const char *dtype = value_of(header, "'descr'"), *order = value_of(header, "'fortran_order'");
    const char *shape = value_of(header, "'shape'");
    if (!dtype || !order || !shape || *shape != '(') return false;
    if (sscanf(dtype, "'%15[a-zA-Z0-9<>|=]'", header->dtype) != 1) strcpy(header->dtype, "a record");
    header->is_fortran = !strncmp(order, "True", 4);
    for (header->num_axes = 0, shape++; header->num_axes < MOST_AXES; header->num_axes++) {
        char *end; /* strtoull takes signs, a shape has none */
        unsigned long long axis = strtoull(shape, &end, 10);
        if (!isdigit((unsigned char)*shape)) break;
        header->shape[header->num_axes] = (size_t)axis;
        shape = end + strspn(end, ", ");
    }
    return *shape == ')';
}

static void describe_shape(const struct header *header, char *text, size_t size) {
    size_t used = (size_t)snprintf(text, size, "[");
    for (int axis = 0; axis < header->num_axes && used < size; axis++) {
        const char *between = axis ? ", " : "";
        used += (size_t)snprintf(text + used, size - used, "%s%zu", between, header->shape[axis]);
    }
    if (used < size) snprintf(text + used, size - used, "]");
}

bool npy_open(struct npy *npy, const char *path, size_t num_channels, char *error, size_t size) {
    struct header header = {.num_axes = 0};
    char shape[128];
    *npy = (struct npy){.file = fopen(path, "rb")};
    if (!npy->file)
        return fail(npy, error, size, "no file %s; give a recording that numpy.save wrote", path);
    bool is_read = read_header(npy->file, &header);
    if (header.version > LAST_VERSION)
        return fail(npy, error, size, "%s has .npy version %d, wanted 1 to %d; save it again", path,
                    header.version, LAST_VERSION);
    if (!is_read)
        return fail(npy, error, size, "%s is no .npy file, or cut off; save it again", path);
    npy->is_double = !strcmp(header.dtype, "<f8");
    if (!npy->is_double && strcmp(header.dtype, "<f4"))
        return fail(npy, error, size,
                    "%s holds %s; give volts in little-endian float32 or float64", path,
                    header.dtype);
    describe_shape(&header, shape, sizeof shape);
    if (header.num_axes != 2 || header.shape[1] != num_channels)
        return fail(npy, error, size,
                    "%s is %s; give [T, %zu], a row an instant, a column a channel", path, shape,
                    num_channels);
    if (header.is_fortran)
        return fail(npy, error, size,
                    "%s is in Fortran order; save numpy.ascontiguousarray of it", path);

    npy->num_samples = header.shape[0];
    npy->num_channels = header.shape[1];
    size_t row = num_channels * (npy->is_double ? sizeof(double) : sizeof(float));
    long first = ftell(npy->file);
    bool is_known = first >= 0 && !fseek(npy->file, 0, SEEK_END);
    long end = is_known ? ftell(npy->file) : -1;
    size_t rows = end < first ? 0 : (size_t)(end - first) / row;
    if (rows < npy->num_samples)
        return fail(npy, error, size, "%s is cut off: %zu of %zu instants are there; save it again",
                    path, rows, npy->num_samples);
    if (fseek(npy->file, first, SEEK_SET))
        return fail(npy, error, size, "%s cannot be read twice; give a file", path);
    return true;
}

bool npy_read(struct npy *npy, void *samples, size_t n) {
    size_t row = npy->num_channels * (npy->is_double ? sizeof(double) : sizeof(float));
    return fread(samples, row, n, npy->file) == n;
}

void npy_close(struct npy *npy) {
    if (npy->file) fclose(npy->file);
    npy->file = NULL;
}
