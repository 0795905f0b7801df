/* How long decisions take, and what memory the program has:
 *
 *     timing detector.tslip recording.npy [rounds] */
#define _GNU_SOURCE
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#include "../c/npy.h"
#include "tactslip.h"

static double now_us(clockid_t clock) {
    struct timespec at;
    clock_gettime(clock, &at);
    return (double)at.tv_sec * 1e6 + (double)at.tv_nsec * 1e-3;
}

static int in_order(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* The most memory that was resident; getrusage would count the program that started this one. */
static long resident_kb(void) {
    char line[128];
    long kb = -1;
    FILE *status = fopen("/proc/self/status", "r");
    while (status && kb < 0 && fgets(line, sizeof line, status))
        if (sscanf(line, "VmHWM: %ld", &kb) != 1) kb = -1;
    if (status) fclose(status);
    return kb;
}

static int refuse(const char *why) { return fprintf(stderr, "error: %s\n", why), 1; }

int main(int count, char **words) {
    enum { FILE_BYTES = 1 << 22, STATE_BYTES = 1 << 20, MOST = 1 << 20 };
    static uint64_t file[FILE_BYTES / 8], state[STATE_BYTES / 8]; /* pages that are not touched cost nothing */
    static double taken[MOST];
    struct tactslip_info info;
    struct tactslip *slip;
    struct tactslip_decision decision;
    char error[1024];
    FILE *from = count > 2 ? fopen(words[1], "rb") : NULL;
    if (!from) return refuse("usage: timing detector.tslip recording.npy [rounds]");
    size_t bytes = fread(file, 1, sizeof file, from), num = 0;
    fclose(from);
    int code = tactslip_open(file, bytes, &info);
    if (!code) code = tactslip_init(file, bytes, state, sizeof state, &slip);
    if (code) return refuse(tactslip_error(code));
    struct npy npy = {0};
    if (!npy_open(&npy, words[2], info.num_channels, error, sizeof error)) return refuse(error);
    if (npy.is_double) return refuse("expected a recording in float32");
    float row[4096];
    double first_us = 0, score = 0, wall = 0;
    for (int round = 0, rounds = count > 3 ? atoi(words[3]) : 20; round < rounds; round++) {
        npy_close(&npy);
        if (!npy_open(&npy, words[2], info.num_channels, error, sizeof error)) return refuse(error);
        tactslip_reset(slip);
        for (size_t at = 0; at < npy.num_samples; at++) {
            if (!npy_read(&npy, row, 1)) return refuse("the recording was cut");
            for (size_t done = 0; !done;) {
                done = tactslip_push(slip, row, 1);
                for (;;) {
                    double then = now_us(CLOCK_THREAD_CPUTIME_ID);
                    if (!tactslip_next(slip, &decision)) break;
                    double us = now_us(CLOCK_THREAD_CPUTIME_ID) - then;
                    if (!num) first_us = now_us(CLOCK_PROCESS_CPUTIME_ID);
                    if (num < MOST) taken[num++] = us;
                    score = decision.score, wall += us;
                }
            }
        }
    }
    npy_close(&npy);
    if (!num) return refuse("the recording is too short for a decision");
    qsort(taken, num, sizeof *taken, in_order);
    printf("{\"decisions\": %zu, \"first_us\": %.1f, \"p50_us\": %.2f, \"p99_us\": %.2f, \"mean_us\": %.2f, "
           "\"resident_kb\": %ld, \"last_score\": %.17g}\n",
           num, first_us, taken[num / 2], taken[num * 99 / 100], wall / (double)num, resident_kb(), score);
    return 0;
}
