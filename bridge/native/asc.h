/* Reads the frames of an ASC log (Vector's text format) with hexadecimal numbers:
 *
 *     SECONDS CHANNEL IDENTIFIER[x] Rx|Tx d LENGTH BYTE... anything
 */
#ifndef BRIDGE_ASC_H
#define BRIDGE_ASC_H

#include <stdint.h>

#include "common/can_frame.h"

/* Read classic data frames from the beginning of a text, up to a line that is anything else: not complete, another kind
 * of frame or of event, fewer bytes than it says. Those are few, and left to the caller.
 *
 * frames, channels, capacity: room for the result; channels receives each frame's channel as it is written, from 1.
 * used: receives the number of bytes of the lines read, with their ends.
 * Returns the number of frames, one per line; times are rounded to a microsecond. */
uint32_t asc_read(const char *text, uint32_t length, can_frame *frames, uint16_t *channels, uint32_t capacity,
                  uint32_t *used);

#endif
