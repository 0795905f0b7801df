/* Checks the parts by themselves and, given a model, that pushes take no memory and that chunks
 * make no difference. Ends at the first that does not hold. */
#include <locale.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "sha256.h"
#include "sidecar.h"
#include "slip.h"

static size_t num_taken;
void *__real_malloc(size_t size);
void *__real_calloc(size_t count, size_t size);
void *__real_realloc(void *old, size_t size);
void *__wrap_malloc(size_t size);
void *__wrap_calloc(size_t count, size_t size);
void *__wrap_realloc(void *old, size_t size);
void *__wrap_malloc(size_t size) { return num_taken++, __real_malloc(size); }
void *__wrap_calloc(size_t count, size_t size) { return num_taken++, __real_calloc(count, size); }
void *__wrap_realloc(void *old, size_t size) { return num_taken++, __real_realloc(old, size); }

#define HOLDS(condition)                                                          \
    do {                                                                          \
        if (!(condition)) {                                                       \
            fprintf(stderr, "error: %s:%d: %s\n", __FILE__, __LINE__, #condition); \
            exit(1);                                                              \
        }                                                                         \
    } while (0)

static void holds_digest(const char *text, size_t repeated, const char *expected) {
    size_t length = strlen(text);
    char *bytes = malloc(repeated * length + 1), hex[SHA256_HEX];
    HOLDS(bytes);
    for (size_t i = 0; i < repeated; i++) memcpy(bytes + i * length, text, length);
    sha256_hex(bytes, repeated * length, hex);
    HOLDS(!strcmp(hex, expected));
    free(bytes);
}

/* The standard's examples, and lengths at which the padding turns. */
static void check_sha256(void) {
    holds_digest("", 1, "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
    holds_digest("abc", 1, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    holds_digest("abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq", 1,
                 "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1");
    holds_digest("a", 1000000, "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

static void check_sidecar(void) {
    const char *json = "{\n \"a\": {\"b\": 1, \"t\": \"x,}\"},\n \"list\": [\n  \"p\",\n  \"q, ]\"\n ],"
                       "\n \"pairs\": [[1, 2], [3, 4], [5, 6]], \"none\": [],\n \"quote\": \"a\\\"b\","
                       "\n \"b\": -2.5e1,\n \"t\": \"whole\",\n \"c\": null\n}\n";
    double value;
    size_t count;
    char text[8], said[64], **texts;
    HOLDS(sidecar_number(json, "b", &value) && value == -25.0);
    HOLDS(!sidecar_number("{\"b\": 2,5}", "b", &value) || value == 2.0); /* a comma ends a number */
    sidecar_said(json, "pairs", said, sizeof said);
    HOLDS(!strcmp(said, "[[1, 2], [3, 4], [5, 6]]"));
    sidecar_said(json, "p", said, sizeof said);
    HOLDS(!strcmp(said, "nothing"));
    HOLDS(sidecar_text(json, "t", text, sizeof text) && !strcmp(text, "whole"));
    HOLDS((texts = sidecar_texts(json, "list", &count)) && count == 2);
    HOLDS(!strcmp(texts[0], "p") && !strcmp(texts[1], "q, ]"));
    free(texts);
    HOLDS(!sidecar_texts(json, "pairs", &count) && !sidecar_texts(json, "none", &count));
    HOLDS((texts = sidecar_texts("{\"l\": [\"\\u00b5\\\"\\\\\", \"\\ud83d\\ude00\"]}", "l", &count)));
    HOLDS(!strcmp(texts[0], "\xc2\xb5\"\\") && !strcmp(texts[1], "\xf0\x9f\x98\x80"));
    free(texts);
    HOLDS(!sidecar_texts("{\"l\": [\"\\x\"]}", "l", &count));
    HOLDS(!sidecar_texts("{\"l\": [\"\\u0000\"]}", "l", &count));
    HOLDS(!sidecar_number(json, "c", &value) && !sidecar_number(json, "t", &value));
    HOLDS(!sidecar_number(json, "p", &value) && !sidecar_text(json, "b", text, sizeof text));
    HOLDS(!sidecar_text(json, "quote", text, sizeof text)); /* escapes are not read */
    HOLDS(!sidecar_text(json, "t", text, 5));
    for (size_t length = 0; length < strlen(json); length++) { /* cut anywhere: found whole, or not */
        char cut[256] = {0};
        memcpy(cut, json, length);
        HOLDS(!sidecar_text(cut, "t", text, sizeof text) || !strcmp(text, "whole"));
        HOLDS(!sidecar_number(cut, "b", &value) || value == -25.0);
        texts = sidecar_texts(cut, "list", &count);
        HOLDS(!texts || count == 2);
        free(texts);
    }
}

enum { NUM_SAMPLES = 6000, LARGEST = 333 };

/* All decisions on some samples, in chunks; no memory may be taken behind the opening. */
static size_t push_all(struct slip *slip, const float *samples, size_t chunk,
                       struct slip_decision *all) {
    size_t width = slip_facts(slip)->num_channels, num = 0, before = num_taken;
    slip_reset(slip);
    for (size_t at = 0; at < NUM_SAMPLES; at += chunk) {
        size_t n = NUM_SAMPLES - at < chunk ? NUM_SAMPLES - at : chunk;
        int made = slip_push(slip, samples + at * width, n, all + num);
        HOLDS(made >= 0 && (size_t)made <= slip_facts(slip)->max_decisions);
        num += (size_t)made;
    }
    HOLDS(num_taken == before);
    return num;
}

static void check_pushes(const char *path) {
    static const size_t chunks[] = {LARGEST, 1, 20, 200};
    enum { NUM_CHUNKS = sizeof chunks / sizeof *chunks };
    char error[SLIP_ERROR];
    struct slip *slip = slip_open(path, LARGEST, error);
    if (!slip) fprintf(stderr, "error: %s\n", error);
    HOLDS(slip);
    size_t width = slip_facts(slip)->num_channels, room = NUM_SAMPLES + LARGEST, num[NUM_CHUNKS];
    float *samples = malloc(NUM_SAMPLES * width * sizeof *samples);
    struct slip_decision *all = calloc(NUM_CHUNKS * room, sizeof *all);
    unsigned random = 1;
    HOLDS(samples && all && num_taken > 0);
    for (size_t i = 0; i < NUM_SAMPLES * width; i++) {
        random = random * 1664525u + 1013904223u; /* Numerical Recipes' generator */
        samples[i] = (float)(random >> 8) / 16777216.0f - 0.5f;
    }
    for (int i = 0; i < NUM_CHUNKS; i++) {
        num[i] = push_all(slip, samples, chunks[i], all + (size_t)i * room);
        HOLDS(num[i] > 0 && num[i] == num[0]);
        for (size_t k = 0; k < num[0]; k++) {
            const struct slip_decision *one = all + k, *other = all + (size_t)i * room + k;
            HOLDS(one->time_s == other->time_s && one->valid == other->valid);
            HOLDS(one->in_range == other->in_range && isnan(one->score) == isnan(other->score));
            HOLDS(isnan(one->score) || fabs(one->score - other->score) < 1e-3);
        }
    }
    for (size_t c = 0; c < width; c++) HOLDS(slip_channel(slip, c) && *slip_channel(slip, c));
    HOLDS(!slip_channel(slip, width));
    HOLDS(slip_push(slip, samples, 0, all) == 0);
    HOLDS(slip_push(slip, samples, LARGEST + 1, all) == -1 && strstr(slip_error(slip), "333"));
    slip_close(slip);
    free(samples);
    free(all);
}

int main(int count, char **words) {
    setlocale(LC_NUMERIC, ""); /* as programs do that speak the user's language */
    check_sha256();
    check_sidecar();
    if (count > 1) check_pushes(words[1]);
    puts(count > 1 ? "parts and pushes hold" : "parts hold; MODEL=stream.onnx checks pushes too");
    printf("a half is written %.1f here\n", 0.5);
    slip_close(NULL);
    return 0;
}
