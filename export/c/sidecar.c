/* Finds a key by walking over the object, past every value that is not wanted. It reads what
 * json.dumps writes; of a text that is no JSON it finds what comes before the fault, or nothing. */
#include "sidecar.h"

#include <locale.h>
#include <stdlib.h>
#include <string.h>

static const char *past_space(const char *at) { return at + strspn(at, " \t\r\n"); }

/* From an opening quote to behind the closing one, or NULL. */
static const char *past_text(const char *at) {
    for (at++; *at != '"'; at++) {
        if (*at == '\\') at++;
        if (!*at) return NULL;
    }
    return at + 1;
}

/* From the start of a value to the comma or bracket behind it, or NULL; commas are counted. */
static const char *past_value(const char *at, size_t *commas) {
    int depth = 0;
    *commas = 0;
    while (*at) {
        if (*at == '"') {
            if (!(at = past_text(at))) return NULL;
            continue;
        }
        if (depth == 0 && (*at == ',' || *at == '}' || *at == ']')) return at;
        if (*at == '[' || *at == '{') depth++;
        if (*at == ']' || *at == '}') depth--;
        if (*at == ',' && depth == 1) (*commas)++;
        at++;
    }
    return NULL;
}

/* Where the value of a key begins, or NULL. */
static const char *value_of(const char *json, const char *key) {
    size_t length = strlen(key), commas;
    const char *at = past_space(json);
    if (*at != '{') return NULL;
    do {
        const char *name = past_space(at + 1), *behind;
        if (*name != '"' || !(behind = past_text(name))) return NULL;
        at = past_space(behind);
        if (*at != ':') return NULL;
        at = past_space(at + 1);
        bool is_it = (size_t)(behind - name) == length + 2 && !memcmp(name + 1, key, length);
        if (is_it) return at;
        at = past_value(at, &commas);
    } while (at && *at == ',');
    return NULL;
}

/* strtod knows the decimal mark of the program's locale alone, which need not be JSON's point. */
bool sidecar_number(const char *json, const char *key, double *value) {
    const char *at = value_of(json, key), *mark = localeconv()->decimal_point;
    if (!at || !strchr("-0123456789", *at)) return false;
    char text[64] = "", *end;
    size_t length = strspn(at, "-+.0123456789eE"), whole = strcspn(at, "."), used = strlen(mark);
    if (length + used >= sizeof text) return false;
    memcpy(text, at, length);
    if (whole < length) {
        memcpy(text + whole, mark, used);
        memcpy(text + whole + used, at + whole + 1, length - whole - 1);
    }
    *value = strtod(text, &end);
    at = past_space(at + length);
    return !*end && (*at == ',' || *at == '}');
}

bool sidecar_text(const char *json, const char *key, char *text, size_t size) {
    const char *at = value_of(json, key), *end;
    if (!at || *at != '"' || !(end = past_text(at))) return false;
    size_t length = (size_t)(end - at) - 2;
    if (length >= size || memchr(at + 1, '\\', length)) return false;
    memcpy(text, at + 1, length);
    text[length] = '\0';
    return true;
}

void sidecar_said(const char *json, const char *key, char *text, size_t size) {
    const char *at = value_of(json, key), *end;
    size_t commas, length = 0;
    if (at && (end = past_value(at, &commas))) length = (size_t)(end - at);
    while (length && strchr(" \t\r\n", at[length - 1])) length--;
    if (length >= size) length = size - 1;
    if (length) memcpy(text, at, length);
    text[length] = '\0';
    for (char *each = text; (each = strpbrk(each, "\r\n"));) *each = ' ';
    if (!length && size > strlen("nothing")) strcpy(text, "nothing");
}

/* The number of four hexadecimal digits, or -1. */
static long hex_digits(const char *at) {
    long value = 0;
    for (int i = 0; i < 4; i++) {
        const char *digits = "0123456789abcdef", *found;
        char letter = at[i] >= 'A' && at[i] <= 'F' ? (char)(at[i] + 'a' - 'A') : at[i];
        if (!letter || !(found = strchr(digits, letter))) return -1;
        value = 16 * value + (found - digits);
    }
    return value;
}

/* Writes a code point in UTF-8, and gives the place behind it. */
static char *put_code(char *out, long code) {
    static const int heads[] = {0, 0, 0xc0, 0xe0, 0xf0};
    int size = code < 0x80 ? 1 : code < 0x800 ? 2 : code < 0x10000 ? 3 : 4;
    for (int i = size - 1; i > 0; i--, code >>= 6) out[i] = (char)(0x80 | (code & 0x3f));
    *out = (char)(heads[size] | code);
    return out + size;
}

/* Reads a text, of which end lies behind the closing quote, without its escapes; gives the place
 * behind the zero that ends it, or NULL for an escape that is none, or a zero within. */
static char *put_text(char *out, const char *at, const char *end) {
    static const char letters[] = "\"\\/bfnrt", values[] = "\"\\/\b\f\n\r\t";
    for (at++; at < end - 1; at++) {
        const char *found;
        if (*at != '\\') {
            *out++ = *at;
        } else if (*++at != 'u') {
            if (!(found = strchr(letters, *at))) return NULL;
            *out++ = values[found - letters];
        } else {
            long code = hex_digits(at + 1), low;
            if (code <= 0) return NULL;
            at += 4;
            bool is_high = code >= 0xd800 && code < 0xdc00 && at[1] == '\\' && at[2] == 'u';
            if (is_high && (low = hex_digits(at + 3)) >= 0xdc00 && low < 0xe000) {
                code = 0x10000 + ((code - 0xd800) << 10) + (low - 0xdc00);
                at += 6;
            }
            out = put_code(out, code);
        }
    }
    *out = '\0';
    return out + 1;
}

char **sidecar_texts(const char *json, const char *key, size_t *count) {
    const char *at = value_of(json, key), *end;
    size_t commas;
    if (!at || *at != '[' || !(end = past_value(at, &commas))) return NULL;
    *count = commas + 1; /* what is read is never longer than what stands there */
    char **texts = malloc(*count * sizeof *texts + (size_t)(end - at));
    char *out = texts ? (char *)(texts + *count) : NULL;
    for (size_t i = 0; out && i < *count; i++) {
        const char *first = past_space(at + 1), *behind = *first == '"' ? past_text(first) : NULL;
        texts[i] = out;
        out = behind ? put_text(out, first, behind) : NULL;
        at = out ? past_space(behind) : at;
        if (*at != (i + 1 < *count ? ',' : ']')) out = NULL;
    }
    if (out) return texts;
    free(texts);
    return NULL;
}
