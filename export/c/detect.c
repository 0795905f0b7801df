/* Watches a recording with an exported stream graph:
 *
 *     detect stream.onnx recording.npy [--rate HZ] [--chunk N] [--threshold T] [--decisions]
 *
 * Prints JSON lines: one an alarm, or with --decisions one a decision, and a summary. */
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "npy.h"
#include "slip.h"

#define USAGE \
    "usage: detect [--rate HZ] [--chunk N] [--threshold T] [--decisions] MODEL recording.npy"
enum { LARGEST_CHUNK = 2000, WRONG = 1, WRONG_USAGE = 2 };

struct options {
    const char *model, *recording;
    double rate, threshold; /* NaN: not given */
    size_t chunk;
    bool all_decisions;
};

struct tally {
    size_t decisions, alarms, not_valid;
    double first_not_valid_s;
};

/* A finite decimal number and nothing else: strtod takes spaces and 0x10 as well. */
static bool read_number(const char *word, double *value) {
    char *end;
    bool is_plain = !word[strspn(word, "+-.0123456789eE")];
    *value = strtod(word, &end);
    return is_plain && end != word && !*end && isfinite(*value);
}

static bool read_chunk(const char *word, size_t *chunk) {
    bool is_whole = *word && !word[strspn(word, "0123456789")];
    unsigned long value = strtoul(word, NULL, 10);
    *chunk = (size_t)value;
    return is_whole && value >= 1 && value <= LARGEST_CHUNK;
}

/* Behind the name of an option: "", "=value", or NULL where it is another option. */
static const char *behind(const char *word, const char *name) {
    size_t length = strlen(name);
    bool is_it = !strncmp(word, name, length) && (!word[length] || word[length] == '=');
    return is_it ? word + length : NULL;
}

static int refuse(int status, const char *format, ...) {
    va_list arguments;
    va_start(arguments, format);
    fputs("error: ", stderr);
    vfprintf(stderr, format, arguments);
    fputs(status == WRONG_USAGE ? "; " USAGE "\n" : "\n", stderr);
    va_end(arguments);
    return status;
}

/* 0, or the exit status once it has said what is wrong. */
static int read_options(int count, char **words, struct options *options) {
    *options = (struct options){.rate = NAN, .threshold = NAN, .chunk = 200};
    for (int i = 1; i < count; i++) {
        const char *word = words[i], *inline_value = NULL;
        if (*word != '-') {
            const char **place = options->model ? &options->recording : &options->model;
            if (*place) return refuse(WRONG_USAGE, "one argument too many, %s", word);
            *place = word;
            continue;
        }
        if (!strcmp(word, "--decisions")) {
            options->all_decisions = true;
            continue;
        }
        static const char *const names[] = {"--rate", "--chunk", "--threshold"};
        int which = 0;
        while (which < 3 && !(inline_value = behind(word, names[which]))) which++;
        if (which == 3) return refuse(WRONG_USAGE, "no option %s", word);
        const char *name = names[which];
        if (!*inline_value && ++i == count) return refuse(WRONG_USAGE, "%s needs a number", name);
        const char *value = *inline_value ? inline_value + 1 : words[i];
        if (which == 1 && !read_chunk(value, &options->chunk))
            return refuse(WRONG_USAGE, "%s: expected 1 to %d samples, got %s", name, LARGEST_CHUNK,
                          value);
        if (which != 1 && !read_number(value, which ? &options->threshold : &options->rate))
            return refuse(WRONG_USAGE, "%s: expected a finite decimal number, got %s", name, value);
    }
    if (!options->recording) return refuse(WRONG_USAGE, "a model and a recording.npy are needed");
    return 0;
}

/* As few digits as read back to the same number, which is a float where is_single. */
static void print_number(const char *before, const char *name, double value, bool is_single) {
    char text[32] = "null"; /* JSON has no NaN; a statistic of too few decisions is -1e30 */
    int most = is_single ? 9 : 17;
    bool is_known = isfinite(value) && value > -0.99e30;
    for (int digits = most - 3; is_known && digits <= most; digits++) {
        snprintf(text, sizeof text, "%.*g", digits, value);
        if (is_single ? strtof(text, NULL) == (float)value : strtod(text, NULL) == value) break;
    }
    printf("%s\"%s\": %s", before, name, text);
}

static void print_flag(const char *before, const char *name, bool flag) {
    printf("%s\"%s\": %s", before, name, flag ? "true" : "false");
}

static void print_text(const char *before, const char *text) {
    printf("%s\"", before);
    for (; *text; text++) {
        if ((unsigned char)*text < ' ')
            printf("\\u%04x", (unsigned)*text);
        else
            printf(*text == '"' || *text == '\\' ? "\\%c" : "%c", *text);
    }
    putchar('"');
}

static void print_lost(const struct slip *slip, const bool *lost) {
    const char *before = "";
    printf(", \"channels_lost\": [");
    for (size_t i = 0; i < slip_facts(slip)->num_channels; i++) {
        if (!lost[i]) continue;
        print_text(before, slip_channel(slip, i));
        before = ", ";
    }
    putchar(']');
}

static void print_decision(const struct slip_decision *decision, const struct slip *slip,
                           bool is_whole) {
    const struct slip_facts *facts = slip_facts(slip);
    bool is_single = !facts->is_double;
    print_number("{", "time_s", decision->time_s, false);
    print_number(", ", "onset_s", decision->onset_s, false);
    print_number(", ", "score", decision->score, is_single);
    print_number(", ", "probability", decision->probability, is_single);
    print_flag(", ", "valid", decision->valid);
    print_flag(", ", "in_range", decision->in_range);
    print_lost(slip, decision->channels_lost);
    if (is_whole) {
        print_number(", ", "statistic", decision->statistic, is_single);
        print_flag(", ", "alarm", decision->alarm);
        print_flag(", ", "on", decision->on);
    }
    if (facts->has_onset) {
        if (is_whole) {
            print_number(", ", "onset_score", decision->onset_score, false);
            print_flag(", ", "hint", decision->hint);
        }
        const char *by = decision->by_onset ? "\"onset\"" : "\"status\"";
        printf(", \"raised_by\": %s", decision->alarm ? by : "null");
    }
    puts("}");
}

static void take(const struct slip_decision *decision, const struct options *options,
                 const struct slip *slip, struct tally *tally) {
    tally->decisions++;
    tally->alarms += decision->alarm;
    bool is_known = decision->time_s >= slip_facts(slip)->first_bin_s; /* what a bin says */
    if (is_known && !decision->valid && !tally->not_valid++)
        tally->first_not_valid_s = decision->time_s;
    if (options->all_decisions || decision->alarm)
        print_decision(decision, slip, options->all_decisions);
}

static int watch(struct slip *slip, struct npy *recording, const struct options *options) {
    const struct slip_facts *facts = slip_facts(slip);
    size_t width = recording->is_double ? sizeof(double) : sizeof(float);
    void *samples = malloc(options->chunk * facts->num_channels * width);
    struct slip_decision *decisions = malloc((facts->max_decisions + 1) * sizeof *decisions);
    struct tally tally = {0};
    int status = 0;
    if (!samples || !decisions) status = refuse(WRONG, "no memory for a chunk; give a smaller one");
    for (size_t at = 0, n; !status && at < recording->num_samples; at += n) {
        size_t rest = recording->num_samples - at;
        n = rest < options->chunk ? rest : options->chunk;
        if (!npy_read(recording, samples, n)) {
            status = refuse(WRONG, "%s was cut while it was read; save it again",
                            options->recording);
            break;
        }
        int num = recording->is_double ? slip_push_double(slip, samples, n, decisions)
                                       : slip_push(slip, samples, n, decisions);
        if (num < 0) status = refuse(WRONG, "%s: %s", options->model, slip_error(slip));
        for (int i = 0; i < num; i++) take(decisions + i, options, slip, &tally);
    }
    free(samples);
    free(decisions);
    if (status) return status;
    printf("{\"decisions\": %zu, \"alarms\": %zu", tally.decisions, tally.alarms);
    print_number(", ", "seconds", (double)recording->num_samples / facts->sample_rate_hz, false);
    puts("}");
    fflush(stdout);
    if (ferror(stdout)) return refuse(WRONG, "the output cannot be written; is the disk full?");
    if (tally.not_valid)
        fprintf(stderr,
                "warning: %zu of %zu decisions are not valid, the first at %.3f s: too few "
                "channels are alive\n",
                tally.not_valid, tally.decisions, tally.first_not_valid_s);
    return 0;
}

int main(int count, char **words) {
    struct options options;
    char error[SLIP_ERROR];
    int status = read_options(count, words, &options);
    if (status) return status;
    struct slip *slip = slip_open(options.model, options.chunk, error);
    if (!slip) return refuse(WRONG, "%s", error);
    const struct slip_facts *facts = slip_facts(slip);
    struct npy recording = {0};
    if (!isnan(options.threshold)) slip_set_threshold(slip, options.threshold);
    if (!isnan(options.rate) && options.rate != facts->sample_rate_hz)
        status = refuse(WRONG, "%s is at %g Hz, the model at %g; resample it", options.recording,
                        options.rate, facts->sample_rate_hz);
    else if (!npy_open(&recording, options.recording, facts->num_channels, error, sizeof error))
        status = refuse(WRONG, "%s", error);
    else
        status = watch(slip, &recording, &options);
    npy_close(&recording);
    slip_close(slip);
    return status;
}
