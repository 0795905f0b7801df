/* An exported stream graph as it lies on disk: checked against its sidecar, and read. */
#ifndef MODEL_H
#define MODEL_H

#include <stdbool.h>
#include <stddef.h>

struct model {
    void *bytes; /* of the .onnx file */
    size_t size;
    size_t num_channels, hop_samples, first_samples, frame_samples, tail_samples, state_size;
    size_t onset_hop_samples; /* 0: no onset classifier */
    char **channels; /* names, [num_channels] */
    double sample_rate_hz;
    bool is_double;
};

/* False, and one line that says why, if a file is missing, damaged or of another kind. */
bool model_read(struct model *model, const char *path, char *error, size_t size);

void model_free(struct model *model);

#endif
