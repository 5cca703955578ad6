/* One episode of an ECU: it starts in the middle of a recorded healthy run, which goes on around it while the fuzzer
 * loses, breaks, repeats and invents frames, bends wired signals and the clock.
 *
 * Input: a byte that picks the start, then for each tick a byte
 *     bits 0..1 changes to recorded frames, each: place, kind, 2 bytes
 *     bits 2..3 new frames, each: row of codec_table (255: 24 raw bytes) and 8 data bytes; counter and CRC become good
 *     bit 4 all recorded frames are lost
 *     bit 5 a wired number: place, 4 bytes (0xFF as the first: one of the odd values)
 *     bit 6 a wrong step of the clock: its kind
 *     bit 7 a byte: so many ticks without change follow
 */
#ifndef RACELOOP_FUZZ_ECU_EPISODE_H
#define RACELOOP_FUZZ_ECU_EPISODE_H

#include <stdbool.h>

#include "common/can_frame.h"
#include "hil_tests/fuzz/fuzz_bytes.h"

enum {
    ECU_EPISODE_STARTS = 6,
    ECU_EPISODE_TICKS_MAX = 200,
    ECU_EPISODE_OUTBOX = 64,
};

/* An ECU as the episode sees it. All functions not null. */
typedef struct ecu_episode {
    const char *recording; /* file that corpus.py made */
    uint8_t station;       /* enum can_station: what it sends must be its own */
    void *state;
    size_t state_size;
    void *wired; /* may be null with 0 */
    size_t wired_size;
    size_t wired_floats; /* numbers at its beginning that the fuzzer may bend */
    void (*init)(void);
    void (*tick)(uint64_t now_us, const can_frame *in, uint32_t count, can_outbox *out);
    void (*begin)(void);                   /* an episode starts from a copied state */
    void (*check)(const can_outbox *sent); /* behind each tick */
    bool (*ready)(void);                   /* the recording has reached what it is for */
} ecu_episode;

/* The ECU of a target, which defines it. */
extern const ecu_episode ecu_under_test;

#endif
