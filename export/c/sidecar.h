/* What stands in a model's sidecar: one flat JSON object of scalars and lists. */
#ifndef SIDECAR_H
#define SIDECAR_H

#include <stdbool.h>
#include <stddef.h>

/* Each reads the value of a key of the outermost object; false if there is none of that type. */
bool sidecar_number(const char *json, const char *key, double *value);
bool sidecar_text(const char *json, const char *key, char *text, size_t size); /* no escapes */

/* A list of texts in UTF-8, in memory that one free() gives back; NULL if there is no such list, it is
 * empty, or there is no memory. */
char **sidecar_texts(const char *json, const char *key, size_t *count);

/* What stands there, on one line and cut to the size, or "nothing": for messages. */
void sidecar_said(const char *json, const char *key, char *text, size_t size);

#endif
