/* Reads the objects inside the containers of a BLF log (Vector's binary format), once they are decompressed.
 *
 * An object begins with "LOBJ", the length of its header, the version of the header (1 or 2), its own length and its
 * type; a rest of the header with flags and time follows. Objects are padded to four bytes, and may go on in the next
 * container. All numbers are little-endian.
 */
#ifndef BRIDGE_BLF_H
#define BRIDGE_BLF_H

#include <stdint.h>

#include "common/can_frame.h"

enum {
    /* No object is larger; one that says so is damaged, and would hide all that comes behind it. */
    BLF_OBJECT_MAX = 1 << 20,
};

/* Why reading ended. */
enum blf_end {
    BLF_INCOMPLETE = 0, /* the data end before the next object does */
    BLF_FULL = 1,       /* no room for another frame */
    BLF_DAMAGED = 2,    /* no object where one must be */
};

typedef struct blf_progress {
    uint32_t used;  /* bytes read */
    uint32_t count; /* frames found */
    uint32_t end;   /* enum blf_end */
} blf_progress;

/* Read frames from the beginning of decompressed data: CAN messages, error frames and CAN FD messages, of which the
 * first 8 data bytes are kept. Other objects are passed over. dlc is the number of data bytes, even beyond 8.
 *
 * start_us: time of the log's beginning, added to the times of the objects, which are rounded to a microsecond. A sum
 * beyond 63 bits becomes INT64_MAX.
 * frames, channels, capacity: room for the result; channels receives each frame's channel as it is stored, from 1. */
blf_progress blf_read(const uint8_t *data, uint32_t length, uint64_t start_us, can_frame *frames, uint16_t *channels,
                      uint32_t capacity);

#endif
