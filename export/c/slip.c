/* How many decisions a push brings follows from the samples so far. So every value that the graph
 * can read or write is made once, in slip_open, over memory of ours: one for each number of samples
 * in, one for each number of decisions out. */
#include "slip.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"
#include "ort.h"

enum { SAMPLES, TAIL, STATE, THRESHOLD, NUM_INPUTS };
static const char *const INPUTS[NUM_INPUTS] = {"samples", "tail", "state", "threshold"};

enum { NEXT_TAIL, NEXT_STATE, FIRST_COLUMN };
enum { SCORE, PROBABILITY, STATISTIC, TIME, ONSET, VALID, IN_RANGE, ALARM, ON, LOST };
enum { ONSET_SCORE = LOST + 1, BY_ONSET, HINT, NUM_COLUMNS, NUM_BIN_COLUMNS = ONSET_SCORE };
static const char *const OUTPUTS[FIRST_COLUMN + NUM_COLUMNS] = {
    "next_tail", "next_state", "score", "probability", "statistic",     "time_s",      "onset_s",
    "valid",     "in_range",   "alarm", "on",          "channels_lost", "onset_score", "by_onset",
    "hint"};
static const double NO_EVIDENCE = -1e30; /* onset score of the graph */

enum { NOTHING, ONE, OTHER, NUM_HELD }; /* what is remembered: nothing yet, or one of two copies */

struct slip {
    struct slip_facts facts;
    struct model model;
    uint64_t count; /* samples so far */
    int held;
    bool has_threshold;
    double threshold;
    int type; /* of samples and scores */
    void *samples, *tails[NUM_HELD], *columns[NUM_COLUMNS];
    double *states[NUM_HELD];
    OrtValue **samples_of;              /* by number of samples */
    OrtValue **columns_of[NUM_COLUMNS]; /* by number of decisions */
    OrtValue *tail_of[NUM_HELD], *state_of[NUM_HELD], *threshold_of[2];
    const OrtApi *api;
    OrtEnv *env;
    OrtSessionOptions *options;
    OrtMemoryInfo *memory;
    OrtSession *session;
    char error[SLIP_ERROR];
};

static bool fine(struct slip *slip, OrtStatus *status) {
    if (!status) return true;
    snprintf(slip->error, sizeof slip->error, "ONNX Runtime: %s", slip->api->GetErrorMessage(status));
    for (char *at = slip->error; (at = strpbrk(at, "\r\n"));) *at = ' ';
    slip->api->ReleaseStatus(status);
    return false;
}

/* Samples after which the first bin is known. */
static size_t first_bin(const struct model *model) {
    size_t first = model->first_samples, frame = model->frame_samples;
    return first > frame ? first : frame;
}

static uint64_t decisions_after(const struct model *model, uint64_t count) {
    if (model->onset_hop_samples) return count / model->onset_hop_samples;
    if (count < first_bin(model)) return 0;
    return (count - model->first_samples) / model->hop_samples + 1;
}

/* Most decisions of n samples: those that a first frame, longer than a bin, kept waiting too. */
static size_t most_decisions(const struct model *model, size_t n) {
    size_t start = model->onset_hop_samples ? model->onset_hop_samples : first_bin(model);
    return n ? (size_t)decisions_after(model, start + n - 1) : 0;
}

static size_t size_of(int type) {
    return type == ORT_BOOL ? sizeof(bool) : type == ORT_FLOAT ? sizeof(float) : sizeof(double);
}

static int column_type(const struct slip *slip, int column) {
    if (column >= VALID && column != ONSET_SCORE) return ORT_BOOL;
    return column >= TIME ? ORT_DOUBLE : slip->type;
}

/* Flags of channels are [decisions, channels], the other columns [decisions]. */
static size_t column_width(const struct slip *slip, int column) {
    return column == LOST ? slip->facts.num_channels : 0;
}

/* A value [rows, columns], or [rows] where columns is 0. */
static bool make_value(struct slip *slip, void *data, int type, size_t rows, size_t columns,
                       OrtValue **value) {
    int64_t shape[2] = {(int64_t)rows, (int64_t)columns};
    size_t size = rows * (columns ? columns : 1) * size_of(type);
    return fine(slip, slip->api->CreateTensorWithDataAsOrtValue(
                          slip->memory, data, size, shape, columns ? 2 : 1, type, value));
}

static bool open_session(struct slip *slip) {
    slip->api = OrtGetApiBase()->GetApi(ORT_API_VERSION);
    if (!slip->api) {
        snprintf(slip->error, sizeof slip->error, "ONNX Runtime %s is too old; give 1.11 or later",
                 OrtGetApiBase()->GetVersionString());
        return false;
    }
    const OrtApi *api = slip->api;
    return fine(slip, api->CreateEnv(ORT_LOG_FATAL, "slip", &slip->env)) &&
           fine(slip, api->CreateSessionOptions(&slip->options)) &&
           fine(slip, api->SetIntraOpNumThreads(slip->options, 1)) &&
           fine(slip, api->CreateSessionFromArray(slip->env, slip->model.bytes, slip->model.size,
                                                  slip->options, &slip->session)) &&
           fine(slip, api->CreateCpuMemoryInfo(ORT_DEVICE_ALLOCATOR, ORT_MEMORY_DEFAULT,
                                               &slip->memory));
}

static bool take_memory(struct slip *slip) {
    const struct model *model = &slip->model;
    size_t num_samples = slip->facts.max_samples, num_decisions = slip->facts.max_decisions;
    size_t row = model->num_channels * size_of(slip->type);
    bool is_there = (slip->samples = calloc(num_samples + 1, row)) &&
                    (slip->samples_of = calloc(num_samples + 1, sizeof *slip->samples_of));
    for (int held = 0; held < NUM_HELD; held++) {
        is_there = is_there && (slip->tails[held] = calloc(model->tail_samples + 1, row)) &&
                   (slip->states[held] = calloc(model->state_size + 1, sizeof(double)));
    }
    for (int i = 0; i < NUM_COLUMNS; i++) {
        size_t width = column_width(slip, i);
        size_t size = size_of(column_type(slip, i)) * (width ? width : 1);
        is_there = is_there && (slip->columns[i] = calloc(num_decisions + 1, size)) &&
                   (slip->columns_of[i] = calloc(num_decisions + 1, sizeof(OrtValue *)));
    }
    if (!is_there)
        snprintf(slip->error, sizeof slip->error, "no memory for pushes of %zu samples", num_samples);
    return is_there;
}

static bool make_values(struct slip *slip) {
    const struct model *model = &slip->model;
    size_t width = model->num_channels;
    bool is_made = true;
    for (size_t n = 0; n <= slip->facts.max_samples && is_made; n++)
        is_made = make_value(slip, slip->samples, slip->type, n, width, slip->samples_of + n);
    for (int i = 0; i < NUM_COLUMNS; i++)
        for (size_t k = 0; k <= slip->facts.max_decisions && is_made; k++)
            is_made = make_value(slip, slip->columns[i], column_type(slip, i), k,
                                 column_width(slip, i), slip->columns_of[i] + k);
    for (int held = 0; held < NUM_HELD && is_made; held++) {
        size_t rows = held ? model->tail_samples : 0, size = held ? model->state_size : 0;
        is_made = make_value(slip, slip->tails[held], slip->type, rows, width,
                             slip->tail_of + held) &&
                  make_value(slip, slip->states[held], ORT_DOUBLE, size, 0, slip->state_of + held);
    }
    for (int given = 0; given < 2 && is_made; given++)
        is_made = make_value(slip, &slip->threshold, ORT_DOUBLE, (size_t)given, 0,
                             slip->threshold_of + given);
    return is_made;
}

struct slip *slip_open(const char *model, size_t max_samples, char error[SLIP_ERROR]) {
    struct slip *slip = calloc(1, sizeof *slip);
    if (!slip) {
        snprintf(error, SLIP_ERROR, "no memory");
        return NULL;
    }
    bool is_open = model_read(&slip->model, model, slip->error, sizeof slip->error);
    if (is_open) {
        slip->type = slip->model.is_double ? ORT_DOUBLE : ORT_FLOAT;
        slip->facts = (struct slip_facts){
            .num_channels = slip->model.num_channels,
            .hop_samples = slip->model.onset_hop_samples ? slip->model.onset_hop_samples
                                                         : slip->model.hop_samples,
            .sample_rate_hz = slip->model.sample_rate_hz,
            .max_samples = max_samples,
            .max_decisions = most_decisions(&slip->model, max_samples),
            .is_double = slip->model.is_double,
            .has_onset = slip->model.onset_hop_samples > 0,
            .first_bin_s = (double)first_bin(&slip->model) / slip->model.sample_rate_hz,
        };
        is_open = open_session(slip) && take_memory(slip) && make_values(slip);
        free(slip->model.bytes); /* the session has what it needs of them */
        slip->model.bytes = NULL;
    }
    if (is_open) return slip;
    memcpy(error, slip->error, SLIP_ERROR);
    slip_close(slip);
    return NULL;
}

const struct slip_facts *slip_facts(const struct slip *slip) { return &slip->facts; }

const char *slip_channel(const struct slip *slip, size_t index) {
    return index < slip->facts.num_channels ? slip->model.channels[index] : NULL;
}

const char *slip_error(const struct slip *slip) { return slip->error; }

void slip_set_threshold(struct slip *slip, double threshold) {
    slip->threshold = threshold;
    slip->has_threshold = true;
}

void slip_reset(struct slip *slip) {
    slip->count = 0;
    slip->held = NOTHING;
}

static double number(const struct slip *slip, int column, size_t i) {
    bool is_single = column_type(slip, column) == ORT_FLOAT;
    return is_single ? (double)((float *)slip->columns[column])[i]
                     : ((double *)slip->columns[column])[i];
}

static const bool *flags(const struct slip *slip, int column, size_t i) {
    return (const bool *)slip->columns[column] + i;
}

static double onset_score(const struct slip *slip, size_t i) {
    double score = slip->facts.has_onset ? number(slip, ONSET_SCORE, i) : NAN;
    return score > NO_EVIDENCE ? score : NAN;
}

/* Runs the graph on the n samples in slip->samples. */
static int run(struct slip *slip, size_t n, struct slip_decision *out) {
    uint64_t made = decisions_after(&slip->model, slip->count);
    size_t k = (size_t)(decisions_after(&slip->model, slip->count + n) - made);
    int next = slip->held == ONE ? OTHER : ONE;
    const OrtValue *inputs[NUM_INPUTS] = {
        slip->samples_of[n], slip->tail_of[slip->held], slip->state_of[slip->held],
        slip->threshold_of[slip->has_threshold]};
    OrtValue *outputs[FIRST_COLUMN + NUM_COLUMNS] = {slip->tail_of[next], slip->state_of[next]};
    int num = slip->facts.has_onset ? NUM_COLUMNS : NUM_BIN_COLUMNS;
    for (int i = 0; i < num; i++) outputs[FIRST_COLUMN + i] = slip->columns_of[i][k];
    if (!fine(slip, slip->api->Run(slip->session, NULL, INPUTS, inputs, NUM_INPUTS, OUTPUTS,
                                   (size_t)(FIRST_COLUMN + num), outputs)))
        return -1;
    slip->held = next;
    slip->count += n;
    for (size_t i = 0; i < k; i++) {
        out[i] = (struct slip_decision){
            .time_s = number(slip, TIME, i),
            .onset_s = number(slip, ONSET, i),
            .score = number(slip, SCORE, i),
            .probability = number(slip, PROBABILITY, i),
            .statistic = number(slip, STATISTIC, i),
            .valid = *flags(slip, VALID, i),
            .in_range = *flags(slip, IN_RANGE, i),
            .channels_lost = flags(slip, LOST, i * slip->facts.num_channels),
            .alarm = *flags(slip, ALARM, i),
            .on = *flags(slip, ON, i),
            .onset_score = onset_score(slip, i),
            .by_onset = *flags(slip, BY_ONSET, i),
            .hint = *flags(slip, HINT, i),
        };
    }
    return (int)k;
}

static bool has_room(struct slip *slip, size_t n) {
    if (n <= slip->facts.max_samples) return true;
    snprintf(slip->error, sizeof slip->error, "%zu samples in one push; at most %zu, as opened", n,
             slip->facts.max_samples);
    return false;
}

int slip_push(struct slip *slip, const float *samples, size_t n, struct slip_decision *out) {
    if (!has_room(slip, n)) return -1;
    size_t size = n * slip->facts.num_channels;
    double *wide = slip->samples;
    if (!n) return 0;
    if (!slip->facts.is_double) memcpy(slip->samples, samples, size * sizeof *samples);
    for (size_t i = 0; slip->facts.is_double && i < size; i++) wide[i] = samples[i];
    return run(slip, n, out);
}

int slip_push_double(struct slip *slip, const double *samples, size_t n,
                     struct slip_decision *out) {
    if (!has_room(slip, n)) return -1;
    size_t size = n * slip->facts.num_channels;
    float *narrow = slip->samples;
    if (!n) return 0;
    if (slip->facts.is_double) memcpy(slip->samples, samples, size * sizeof *samples);
    for (size_t i = 0; !slip->facts.is_double && i < size; i++) narrow[i] = (float)samples[i];
    return run(slip, n, out);
}

static void release(const struct slip *slip, OrtValue **values, size_t count) {
    for (size_t i = 0; values && i < count; i++)
        if (values[i]) slip->api->ReleaseValue(values[i]);
}

void slip_close(struct slip *slip) {
    if (!slip) return;
    release(slip, slip->samples_of, slip->facts.max_samples + 1);
    release(slip, slip->tail_of, NUM_HELD);
    release(slip, slip->state_of, NUM_HELD);
    release(slip, slip->threshold_of, 2);
    for (int i = 0; i < NUM_COLUMNS; i++) {
        release(slip, slip->columns_of[i], slip->facts.max_decisions + 1);
        free(slip->columns_of[i]);
        free(slip->columns[i]);
    }
    for (int held = 0; held < NUM_HELD; held++) {
        free(slip->tails[held]);
        free(slip->states[held]);
    }
    free(slip->samples_of);
    free(slip->samples);
    if (slip->session) slip->api->ReleaseSession(slip->session);
    if (slip->memory) slip->api->ReleaseMemoryInfo(slip->memory);
    if (slip->options) slip->api->ReleaseSessionOptions(slip->options);
    if (slip->env) slip->api->ReleaseEnv(slip->env);
    model_free(&slip->model);
    free(slip);
}
