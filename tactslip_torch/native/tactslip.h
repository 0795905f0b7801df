/* libtactslip: samples of a hand in, decisions on slip and alarms out, from a file that
 * `tactslip export graph=native` writes. Plain C; no allocation, no system call, no global data.
 *
 * A detector lies in memory of the caller. Several may be used side by side, each by one thread at a
 * time. The file is read in place, so it may lie in flash. It and the state must begin at a multiple
 * of 8 bytes (4 for a float32 file), and stay where they are.
 *
 *     struct tactslip_info info;
 *     struct tactslip *slip;
 *     int code = tactslip_open(file, file_bytes, &info);
 *     if (!code) code = tactslip_init(file, file_bytes, state, sizeof state, &slip);
 *     if (code) puts(tactslip_error(code));
 *     for (size_t at = 0; at < num_samples;) {
 *         at += tactslip_push(slip, samples + at * info.num_channels, num_samples - at);
 *         while (tactslip_next(slip, &decision))
 *             if (decision.is_alarm) stop_the_hand();
 *     } */
#ifndef TACTSLIP_H
#define TACTSLIP_H

#include <stddef.h>
#include <stdint.h>

#if defined(_WIN32)
#define TACTSLIP_API __declspec(dllexport)
#else
#define TACTSLIP_API __attribute__((visibility("default")))
#endif

#ifdef __cplusplus
extern "C" {
#endif

struct tactslip; /* a detector and its stream */

enum tactslip_code {
    TACTSLIP_OK,
    TACTSLIP_NO_FILE,   /* not a .tslip file */
    TACTSLIP_VERSION,   /* of another version of the format */
    TACTSLIP_DAMAGED,   /* shorter than it says, or another checksum */
    TACTSLIP_INVALID,   /* whole, but its numbers do not fit each other */
    TACTSLIP_PRECISION, /* float64, and the library was built for float32 alone */
    TACTSLIP_ALIGNMENT, /* file or state begin at no multiple of what they need */
    TACTSLIP_STATE      /* the state has too few bytes */
};

struct tactslip_info {
    size_t state_bytes;     /* that tactslip_init wants */
    uint32_t num_channels;  /* of the hand */
    uint32_t hop_samples;   /* between two decisions */
    uint32_t first_samples; /* that must have come before the first decision on a bin */
    uint32_t bin_samples;
    double sample_rate_hz;
    int is_double;    /* numbers of the file and of scores: float64, not float32 */
    int has_onset;    /* alarms come from the classifier of slipping now, bins say the status */
    const char *unit; /* of samples, as in training; lies in the file */
};

struct tactslip_decision {
    uint64_t number;    /* in its stream, from 0 */
    double time_s;      /* of the last sample that it needed, from the first sample */
    double onset_s;     /* when the slip began, if this is one */
    double score;       /* of the last bin: at least 0 is slip; NaN where the bin is not valid */
    double probability; /* of slip, by that bin alone; NaN likewise */
    double statistic;   /* of the rule; NaN likewise, -1e30 before there are enough bins */
    double onset_score; /* of the onset classifier; NaN without evidence, or without classifier */
    uint8_t is_valid;   /* enough channels are alive; if not, it raises no alarm */
    uint8_t in_range;   /* the channels move about as much as in training */
    uint8_t is_alarm;   /* it raises an alarm */
    uint8_t is_on;      /* an alarm stands behind it */
    uint8_t by_onset;   /* the onset score reaches its threshold */
    uint8_t is_hint;    /* it reaches the lower one, at which a grip may tighten a little */
    const uint8_t *channels_lost; /* [num_channels], 1: missing or silent; until the next push */
};

/* Check a file, whatever its bytes, and say what is in it. `info` may be null. */
TACTSLIP_API int tactslip_open(const void *file, size_t bytes, struct tactslip_info *info);

/* Make a detector of a file that tactslip_open found whole; its stream begins. */
TACTSLIP_API int tactslip_init(const void *file, size_t bytes, void *state, size_t state_bytes,
                               struct tactslip **detector);

/* Take samples [n, num_channels], one row an instant, in the unit of training; NaN, or a null
 * pointer for whole rows, where one is missing. How many rows were taken: fewer than n where a
 * decision waits for tactslip_next. */
TACTSLIP_API size_t tactslip_push(struct tactslip *, const float *samples, size_t n);
TACTSLIP_API size_t tactslip_push_double(struct tactslip *, const double *samples, size_t n);
/* The same as counts of a converter; the file has scale and offset of each channel. */
TACTSLIP_API size_t tactslip_push_int16(struct tactslip *, const int16_t *counts, size_t n);
TACTSLIP_API size_t tactslip_push_int32(struct tactslip *, const int32_t *counts, size_t n);

/* The next decision, if its samples are there: 1, else 0. This is where the time is spent. */
TACTSLIP_API int tactslip_next(struct tactslip *, struct tactslip_decision *decision);

/* Another threshold of the alarm, at once: of the onset classifier, if there is one. */
TACTSLIP_API void tactslip_set_threshold(struct tactslip *, double threshold);

/* Forget the stream: before another recording, and behind a gap too long to fill with NaN. */
TACTSLIP_API void tactslip_reset(struct tactslip *);

TACTSLIP_API const char *tactslip_channel(const struct tactslip *, uint32_t index); /* its name */
TACTSLIP_API const char *tactslip_version(void); /* of the package and of the file format */
TACTSLIP_API const char *tactslip_error(int code);

#ifdef __cplusplus
}
#endif
#endif
