/* ../c/slip.h on libtactslip in place of ONNX Runtime: all that a host needs, on one page. */
#include "../c/slip.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tactslip.h"

struct slip {
    struct slip_facts facts;
    struct tactslip *detector;
    void *file, *state;
    bool *lost; /* [max_decisions, num_channels] */
    char error[SLIP_ERROR];
};

static void *read_file(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    char *content = NULL;
    long length = -1;
    if (file && !fseek(file, 0, SEEK_END) && (length = ftell(file)) >= 0 && !fseek(file, 0, SEEK_SET))
        content = malloc((size_t)length + 1);
    *size = content ? fread(content, 1, (size_t)length, file) : 0;
    if (file) fclose(file);
    return content;
}

/* All of slip_open but the message; NULL, or what is wrong. */
static const char *open_in(struct slip *slip, const char *path, size_t max_samples) {
    struct tactslip_info info;
    size_t size = 0;
    slip->file = read_file(path, &size);
    if (!slip->file) return "cannot be read";
    int code = tactslip_open(slip->file, size, &info);
    if (code) return tactslip_error(code);
    size_t most = (max_samples + info.first_samples) / info.hop_samples + 2;
    slip->state = malloc(info.state_bytes);
    slip->lost = malloc(most * info.num_channels);
    if (!slip->state || !slip->lost) return "no memory";
    slip->facts = (struct slip_facts){
        .num_channels = info.num_channels, .hop_samples = info.hop_samples,
        .sample_rate_hz = info.sample_rate_hz, .max_samples = max_samples,
        .max_decisions = most, .is_double = info.is_double, .has_onset = info.has_onset,
        .first_bin_s = info.first_samples / info.sample_rate_hz,
    };
    code = tactslip_init(slip->file, size, slip->state, info.state_bytes, &slip->detector);
    return code ? tactslip_error(code) : NULL;
}

struct slip *slip_open(const char *path, size_t max_samples, char error[SLIP_ERROR]) {
    struct slip *slip = calloc(1, sizeof *slip);
    const char *wrong = slip ? open_in(slip, path, max_samples) : "no memory";
    if (!wrong) return slip;
    snprintf(error, SLIP_ERROR, "%s: %s", path, wrong);
    slip_close(slip);
    return NULL;
}

const struct slip_facts *slip_facts(const struct slip *slip) { return &slip->facts; }
const char *slip_error(const struct slip *slip) { return slip->error; }
void slip_reset(struct slip *slip) { tactslip_reset(slip->detector); }

const char *slip_channel(const struct slip *slip, size_t index) {
    return tactslip_channel(slip->detector, (uint32_t)index);
}

void slip_set_threshold(struct slip *slip, double threshold) {
    tactslip_set_threshold(slip->detector, threshold);
}

/* Decisions that wait, behind those that a push brought so far. */
static int take(struct slip *slip, struct slip_decision *out, int num) {
    struct tactslip_decision made;
    for (; tactslip_next(slip->detector, &made); num++) {
        bool *lost = slip->lost + (size_t)num * slip->facts.num_channels;
        memcpy(lost, made.channels_lost, slip->facts.num_channels);
        out[num] = (struct slip_decision){
            .time_s = made.time_s, .onset_s = made.onset_s, .score = made.score,
            .probability = made.probability, .statistic = made.statistic,
            .valid = made.is_valid, .in_range = made.in_range, .channels_lost = lost,
            .alarm = made.is_alarm, .on = made.is_on, .onset_score = made.onset_score,
            .by_onset = made.by_onset, .hint = made.is_hint,
        };
    }
    return num;
}

int slip_push(struct slip *slip, const float *samples, size_t n, struct slip_decision *out) {
    int num = 0;
    for (size_t at = 0; at < n; num = take(slip, out, num))
        at += tactslip_push(slip->detector, samples + at * slip->facts.num_channels, n - at);
    return num;
}

int slip_push_double(struct slip *slip, const double *samples, size_t n,
                     struct slip_decision *out) {
    int num = 0;
    for (size_t at = 0; at < n; num = take(slip, out, num))
        at += tactslip_push_double(slip->detector, samples + at * slip->facts.num_channels, n - at);
    return num;
}

void slip_close(struct slip *slip) {
    if (!slip) return;
    free(slip->lost);
    free(slip->state);
    free(slip->file);
    free(slip);
}
