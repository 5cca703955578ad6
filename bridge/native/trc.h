/* Reads the frames of a TRC log (PEAK's text format), whose columns depend on its version or are named in its header.
 */
#ifndef BRIDGE_TRC_H
#define BRIDGE_TRC_H

#include <stdint.h>

#include "common/can_frame.h"

/* Read classic data frames from the beginning of a text, up to a line that is anything else: not complete, another kind
 * of frame or of event, not as many bytes as it says. Those are few, and left to the caller.
 *
 * columns: what stands in each, zero-terminated, by the letters of the format: O time in ms, T type (only DT is read),
 * B channel, I identifier (29-bit with more than 4 digits), d direction (Rx or Tx), L or l length, D data, which are
 * last; any other letter is a column that does not matter.
 * frames, channels, capacity: room for the result; channels receives each frame's channel as it is written, 1 without
 * B. used: receives the number of bytes of the lines read, with their ends. Returns the number of frames, one per line;
 * times are those of the lines, rounded to a microsecond. */
uint32_t trc_read(const char *text, uint32_t length, const char *columns, can_frame *frames, uint16_t *channels,
                  uint32_t capacity, uint32_t *used);

#endif
