/* Opens a file damaged in many ways, and pushes whatever a hand may send to what opens:
 *
 *     check detector.tslip [files [seed]]
 *
 * To be built with sanitizers (make sanitized), which stop it at the first wrong access. Most of the
 * damaged files get their right checksum, or nothing behind it would be looked at. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "tactslip.h"

enum { MOST_STATE = 1 << 21, HEAD = 24, NUM_BYTES = 12, CHECKSUM = 16, BEHIND = 20 };
static uint64_t seed = 1;

/* xorshift64*, below a number */
static uint32_t draw(uint64_t below) {
    seed ^= seed >> 12, seed ^= seed << 25, seed ^= seed >> 27;
    return (uint32_t)((seed * 2685821657736338717ull >> 32) * below >> 32);
}

static uint32_t crc32_of(const unsigned char *bytes, size_t count) {
    uint32_t rest = ~0u;
    for (size_t i = 0; i < count; i++) {
        rest ^= bytes[i];
        for (int bit = 0; bit < 8; bit++) rest = rest >> 1 ^ (rest & 1 ? 0xedb88320u : 0);
    }
    return ~rest;
}

/* Another length, bits, words or pieces; the length that it has then. */
static size_t damage(unsigned char *file, size_t size) {
    static const uint32_t words[] = {0, 1, 2, 255, 0x7fffffff, 0x80000000, 0xffffffff, 0x7f800000,
                                     0x7fc00000, 0x00100000, 0x3f800000, 0xbf800000};
    if (!draw(20)) size -= draw(size);
    for (uint32_t num = 1 + draw(4); num-- && size > HEAD;) {
        size_t most = draw(3) ? size : size < 4096 ? size : 4096, at = draw(most); /* sizes stand in front */
        uint32_t word = words[draw(sizeof words / sizeof *words)];
        if (draw(3)) at = at / 4 * 4;
        size_t length = 4 < size - at ? 4 : size - at;
        switch (draw(4)) {
            case 0: file[at] = (unsigned char)(file[at] ^ 1 << draw(8)); break;
            case 1: memcpy(file + at, &word, length); break;
            case 2: file[at] = (unsigned char)(file[at] + draw(7) - 3); break;
            default: memmove(file + at, file + draw(size - length + 1), length);
        }
    }
    if (size < HEAD || !draw(8)) return size;
    uint32_t length = (uint32_t)size;
    memcpy(file, "tactslip\1\0\0\0", 12);
    memcpy(file + NUM_BYTES, &length, 4);
    uint32_t rest = crc32_of(file + BEHIND, size - BEHIND);
    memcpy(file + CHECKSUM, &rest, 4);
    return size;
}

static float sample(uint32_t kind) {
    static const float odd[] = {NAN, INFINITY, -INFINITY, 3e38f, 1e-40f, 0, -0.0f, 1e20f};
    float noise = (float)draw(1 << 24) / (float)(1 << 23) - 1;
    return kind == 0 ? noise : kind == 1 ? 1.0f : kind == 2 ? odd[draw(8)] : draw(50) ? noise : odd[draw(8)];
}

/* As many decisions as some 300 samples bring; how many. */
static uint32_t watch(struct tactslip *slip, const struct tactslip_info *info) {
    struct tactslip_decision decision;
    uint32_t num = 0, kind = draw(4);
    size_t rows = 1 + draw(40), wide = info->num_channels;
    void *samples = malloc(rows * wide * sizeof(double));
    for (int push = 0; push < 10; push++) {
        uint32_t what = draw(6);
        for (size_t i = 0; i < rows * wide; i++) {
            if (what == 0) ((double *)samples)[i] = draw(9) ? sample(kind) : 1e300;
            if (what == 1) ((int16_t *)samples)[i] = (int16_t)draw(1 << 16);
            if (what == 2) ((int32_t *)samples)[i] = (int32_t)draw(1ull << 32);
            if (what > 2) ((float *)samples)[i] = sample(kind);
        }
        if (what == 0) tactslip_push_double(slip, samples, rows);
        if (what == 1) tactslip_push_int16(slip, samples, rows);
        if (what == 2) tactslip_push_int32(slip, samples, rows);
        if (what > 3) tactslip_push(slip, samples, rows);
        if (what == 3) tactslip_push(slip, NULL, rows);
        if (!draw(20)) tactslip_reset(slip);
        if (!draw(20)) tactslip_set_threshold(slip, sample(2));
        for (int most = 0; most < 4 && tactslip_next(slip, &decision); most++) {
            num++;
            for (size_t i = 0; i < wide; i++) num += decision.channels_lost[i] > 1;
        }
    }
    free(samples);
    return num;
}

int main(int count, char **words) {
    uint32_t files = count > 2 ? (uint32_t)atoi(words[2]) : 5000, opened = 0, decisions = 0;
    if (count > 3) seed = strtoull(words[3], NULL, 10) * 2654435761u + 1;
    FILE *from = count > 1 ? fopen(words[1], "rb") : NULL;
    if (!from) return fputs("usage: check detector.tslip [files [seed]]\n", stderr), 2;
    static unsigned char whole[1 << 23];
    size_t size = fread(whole, 1, sizeof whole, from);
    fclose(from);
    uint32_t codes[TACTSLIP_STATE + 1] = {0};
    for (uint32_t i = 0; i < files; i++) {
        struct tactslip_info info;
        unsigned char *file = malloc(size + 1); /* so that what lies behind it is known to be */
        memcpy(file, whole, size);
        size_t length = i ? damage(file, size) : size; /* the first is as it was */
        file = realloc(file, length ? length : 1);
        int code = tactslip_open(file, length, &info);
        codes[code]++;
        if (!*tactslip_error(code)) return 1;
        if (!code && info.state_bytes <= MOST_STATE) {
            struct tactslip *slip;
            char *state = malloc(info.state_bytes);
            if (tactslip_init(file, length, state, info.state_bytes, &slip)) return 1;
            if (tactslip_init(file, length, state, info.state_bytes - 1, &slip) != TACTSLIP_STATE) return 1;
            if (tactslip_init(file, length, state, info.state_bytes, &slip)) return 1;
            decisions += watch(slip, &info);
            opened++;
            free(state);
        } else if (!i) {
            return fprintf(stderr, "error: %s\n", tactslip_error(code)), 1;
        }
        free(file);
    }
    printf("{\"files\": %u, \"opened\": %u, \"decisions\": %u}\n", files, opened, decisions);
    return 0;
}
