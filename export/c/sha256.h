/* SHA-256 (FIPS 180-4) of bytes in memory. */
#ifndef SHA256_H
#define SHA256_H

#include <stddef.h>

enum { SHA256_HEX = 65 }; /* 64 digits and the closing zero */

void sha256_hex(const void *bytes, size_t size, char hex[SHA256_HEX]);

#endif
