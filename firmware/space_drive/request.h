/* Receiver of one channel for the position requests of one axis: counter, CRC, range and age of every request.
 *
 * Each channel has its own, so that three channels judge every frame independently.
 */
#ifndef RACELOOP_SPACE_DRIVE_REQUEST_H
#define RACELOOP_SPACE_DRIVE_REQUEST_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"

/* What the requests of an axis are worth now. Zero is the state before the first good one. */
enum space_drive_request_state {
    SPACE_DRIVE_REQUEST_WAITING = 0, /* none was valid yet: nothing moves */
    SPACE_DRIVE_REQUEST_FRESH = 1,
    SPACE_DRIVE_REQUEST_LOST = 2, /* stopped, or too many bad in a row; a good one makes it fresh again */
};

/* State of one receiver: zero it to start. */
typedef struct space_drive_request {
    codec_rx rx;
    uint64_t last_valid_us;
    uint16_t counts;    /* position of the last valid request */
    uint16_t speed_kmh; /* vehicle speed in it; only the steering request carries one */
    uint16_t bad_in_row;
    uint8_t state; /* enum space_drive_request_state */
} space_drive_request;

/* Judge one request frame (id 0x20 or 0x21). It is bad when the codec rejects it (short, remote, counter stuck,
 * CRC wrong) or when its position is above counts_max: 0xFFFF says itself that it is not valid.
 * bad_limit: bad requests in a row that lose the axis, at least 1. now_us: monotonic. */
void space_drive_request_receive(space_drive_request *self, const can_frame *frame, uint16_t counts_max,
                                 uint16_t bad_limit, uint64_t now_us);

/* Once per tick after reception: an axis whose last good request is older than timeout_us is lost. */
void space_drive_request_age(space_drive_request *self, uint32_t timeout_us, uint64_t now_us);

#endif
