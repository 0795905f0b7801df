#include "model.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sha256.h"
#include "sidecar.h"

#define FORMAT "tactslip_torch onnx 2"
enum { LONGEST_PATH = 4096, LARGEST_COUNT = 1 << 24 };

static bool fail(char *error, size_t size, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(error, size, format, arguments);
    va_end(arguments);
    return false;
}

/* A whole file and a zero behind it, or NULL. */
static char *file_content(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    char *content = NULL;
    long end = -1;
    if (file && !fseek(file, 0, SEEK_END)) end = ftell(file);
    if (end >= 0 && !fseek(file, 0, SEEK_SET)) content = malloc((size_t)end + 1);
    if (content && fread(content, 1, (size_t)end, file) != (size_t)end) {
        free(content);
        content = NULL;
    }
    if (file) fclose(file);
    if (content) content[*size = (size_t)end] = '\0';
    return content;
}

static bool read_count(const char *json, const char *key, size_t *count) {
    double value;
    bool is_count = sidecar_number(json, key, &value) && value >= 0 && value <= LARGEST_COUNT &&
                    value == (double)(size_t)value;
    if (is_count) *count = (size_t)value;
    return is_count;
}

/* The key of the first fact that is missing or wrong, and in wanted what it should be; or NULL. */
static const char *wrong_fact(struct model *model, const char *json, const char **wanted) {
    char text[SHA256_HEX];
    *wanted = "64 hexadecimal digits";
    if (!sidecar_text(json, "onnx_sha256", text, sizeof text)) return "onnx_sha256";
    *wanted = "bin or stream";
    if (!sidecar_text(json, "graph", text, sizeof text) ||
        (strcmp(text, "bin") && strcmp(text, "stream")))
        return "graph";
    if (!strcmp(text, "bin")) return NULL; /* refused as such, whatever else it says */
    *wanted = "float32 or float64";
    if (!sidecar_text(json, "precision", text, sizeof text)) return "precision";
    model->is_double = !strcmp(text, "float64");
    if (!model->is_double && strcmp(text, "float32")) return "precision";
    *wanted = "a list of names";
    model->channels = sidecar_texts(json, "channels", &model->num_channels);
    if (!model->channels) return "channels";
    *wanted = "a positive number";
    if (!sidecar_number(json, "sample_rate_hz", &model->sample_rate_hz) ||
        !(model->sample_rate_hz > 0))
        return "sample_rate_hz";
    *wanted = "a positive whole number";
    if (!read_count(json, "hop_samples", &model->hop_samples) || !model->hop_samples)
        return "hop_samples";
    sidecar_said(json, "onset_hop_samples", text, sizeof text);
    if (strcmp(text, "nothing") &&
        (!read_count(json, "onset_hop_samples", &model->onset_hop_samples) ||
         !model->onset_hop_samples))
        return "onset_hop_samples";
    *wanted = "a whole number";
    if (!read_count(json, "first_samples", &model->first_samples)) return "first_samples";
    if (!read_count(json, "frame_samples", &model->frame_samples)) return "frame_samples";
    if (!read_count(json, "tail_samples", &model->tail_samples)) return "tail_samples";
    if (!read_count(json, "state_size", &model->state_size)) return "state_size";
    return NULL;
}

static bool read_facts(struct model *model, const char *json, const char *path, const char *sidecar,
                       char *error, size_t size) {
    char hex[SHA256_HEX], text[128];
    if (!sidecar_text(json, "format", text, sizeof text) || strcmp(text, FORMAT))
        return fail(error, size, "%s is no sidecar of format '%s'; export the model again", sidecar,
                    FORMAT);
    const char *wanted, *wrong = wrong_fact(model, json, &wanted);
    if (wrong) {
        sidecar_said(json, wrong, text, sizeof text);
        return fail(error, size, "%s says %s %s, wanted %s; export the model again", sidecar, wrong,
                    text, wanted);
    }
    sha256_hex(model->bytes, model->size, hex);
    if (!sidecar_text(json, "onnx_sha256", text, sizeof text) || strcmp(text, hex))
        return fail(error, size,
                    "%s is cut off or altered: its SHA-256 is not the onnx_sha256 of %s; copy both "
                    "again",
                    path, sidecar);
    if (!sidecar_text(json, "graph", text, sizeof text) || strcmp(text, "stream"))
        return fail(error, size, "%s is a bin graph, no stream graph; give stream.onnx", path);
    return true;
}

bool model_read(struct model *model, const char *path, char *error, size_t size) {
    char sidecar[LONGEST_PATH];
    size_t unused;
    *model = (struct model){0};
    if (snprintf(sidecar, sizeof sidecar, "%s.json", path) >= (int)sizeof sidecar)
        return fail(error, size, "the path of the model is longer than %d bytes", LONGEST_PATH);
    model->bytes = file_content(path, &model->size);
    char *json = file_content(sidecar, &unused);
    bool is_read = model->bytes && json;
    if (!is_read)
        fail(error, size, "no file %s; give a model with its .onnx.json beside it",
             model->bytes ? sidecar : path);
    else
        is_read = read_facts(model, json, path, sidecar, error, size);
    free(json);
    if (!is_read) model_free(model);
    return is_read;
}

void model_free(struct model *model) {
    free(model->bytes);
    free(model->channels);
    *model = (struct model){0};
}
