/* Slip detection on a stream of tactile samples, for control loops.
 *
 * All memory is taken by slip_open; slip_push takes none. One thread at a time for one handle. */
#ifndef SLIP_H
#define SLIP_H

#include <stdbool.h>
#include <stddef.h>

enum { SLIP_ERROR = 1024 }; /* room for any message */

#ifdef __cplusplus
extern "C" {
#endif

struct slip;

struct slip_facts {
    size_t num_channels;
    size_t hop_samples; /* between two decisions */
    double sample_rate_hz;
    size_t max_samples;   /* of one push */
    size_t max_decisions; /* that one push can bring */
    bool is_double;       /* the graph computes in float64 */
    bool has_onset;       /* alarms come from an onset classifier alone */
    double first_bin_s;   /* from when on decisions speak of a bin */
};

struct slip_decision {
    double time_s;  /* when it could be made, from the first sample */
    double onset_s; /* when the slip that it speaks of began */
    double score;   /* of the bin: at least 0 is slip; NaN: too few channels are alive */
    double probability; /* NaN likewise */
    double statistic;   /* of the sequential rule; NaN likewise */
    bool valid;         /* the decision counts; one that does not raises no alarm */
    bool in_range;      /* the channels move about as much as in training */
    const bool *channels_lost; /* silent or missing, [num_channels]; until the next push */
    bool alarm;                /* raised by this decision */
    bool on;                   /* stands after it */
    double onset_score; /* of fast evidence; NaN: none, or no onset classifier */
    bool by_onset;      /* it reaches its threshold: alarms come from it, where there is one */
    bool hint;          /* it reaches a lower one: a controller may tighten a little */
};

/* Opens an exported stream graph with its sidecar beside it.
 * Returns NULL, and in error one line that says why, if they are not whole or not of this kind. */
struct slip *slip_open(const char *model, size_t max_samples, char error[SLIP_ERROR]);

const struct slip_facts *slip_facts(const struct slip *slip);

/* The name of a channel, UTF-8; NULL behind the last. */
const char *slip_channel(const struct slip *slip, size_t index);

/* Takes the next n instants [n, num_channels], in the unit of the training, NaN where a sample is missing.
 * Returns how many decisions they made possible, which stand in out[max_decisions]; or -1 if n is
 * above max_samples or the graph fails: then nothing was taken, and slip_error says why. */
int slip_push(struct slip *slip, const float *samples, size_t n, struct slip_decision *out);
int slip_push_double(struct slip *slip, const double *samples, size_t n, struct slip_decision *out);
const char *slip_error(const struct slip *slip);

/* From now on alarms are raised at this statistic, or onset score where there is one, instead of the
 * model's own threshold. */
void slip_set_threshold(struct slip *slip, double threshold);

/* Forgets the stream: another begins, or this one anew behind a gap. */
void slip_reset(struct slip *slip);

void slip_close(struct slip *slip); /* NULL is nothing to close */

#ifdef __cplusplus
}
#endif

#endif
