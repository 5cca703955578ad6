/* Reads the log format of candump (-L, -l): `(seconds.microseconds) channel identifier#data`, a frame a line. */
#ifndef BRIDGE_CANDUMP_H
#define BRIDGE_CANDUMP_H

#include <stdint.h>

#include "common/can_frame.h"

enum { CANDUMP_NAME_SIZE = 16 };

typedef struct candump_channel {
    char name[CANDUMP_NAME_SIZE]; /* as in the log, zero-terminated */
    uint8_t bus;                  /* enum can_bus */
} candump_channel;

/* Read data frames from the beginning of a text, up to a line that is anything else: not complete, of a channel that is
 * not among those given, a remote or an error frame, not a frame at all. Those are few, and left to the caller.
 *
 * channels, channel_count: names and buses.
 * frames, capacity: room for the result.
 * used: receives the number of bytes of the lines read, with their ends.
 * Returns the number of frames, one per line. */
uint32_t candump_read(const char *text, uint32_t length, const candump_channel *channels, uint32_t channel_count,
                      can_frame *frames, uint32_t capacity, uint32_t *used);

#endif
