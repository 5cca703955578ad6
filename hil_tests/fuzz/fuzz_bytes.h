/* The input of a fuzz target as a stream, and how it complains. */
#ifndef RACELOOP_FUZZ_BYTES_H
#define RACELOOP_FUZZ_BYTES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* What must hold; else libFuzzer keeps the input. */
#define FUZZ_CHECK(condition)                                                                                          \
    do {                                                                                                               \
        if (!(condition)) {                                                                                            \
            (void)fprintf(stderr, "%s:%d: not %s\n", __FILE__, __LINE__, #condition);                                  \
            abort();                                                                                                   \
        }                                                                                                              \
    } while (false)

typedef struct fuzz_bytes {
    const uint8_t *at;
    size_t left;
} fuzz_bytes;

/* The next bytes; zeros behind the end. */
static inline void fuzz_take(fuzz_bytes *self, void *out, size_t size)
{
    const size_t taken = size < self->left ? size : self->left;
    memset(out, 0, size);
    memcpy(out, self->at, taken);
    self->at += taken;
    self->left -= taken;
}

static inline uint8_t fuzz_u8(fuzz_bytes *self)
{
    uint8_t value;
    fuzz_take(self, &value, sizeof value);
    return value;
}

static inline uint16_t fuzz_u16(fuzz_bytes *self)
{
    uint16_t value;
    fuzz_take(self, &value, sizeof value);
    return value;
}

static inline uint32_t fuzz_u32(fuzz_bytes *self)
{
    uint32_t value;
    fuzz_take(self, &value, sizeof value);
    return value;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);
int LLVMFuzzerInitialize(int *argc, char ***argv);

#endif
