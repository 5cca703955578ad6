/* What can_link.c asks of SocketCAN and of the hub. */
#ifndef RACELOOP_PORT_LINK_DRIVER_H
#define RACELOOP_PORT_LINK_DRIVER_H

#include "ports/linux/can_link.h"

/* One kind of link. No function blocks. */
typedef struct link_driver {
    const char *scheme; /* before the colon of an address */

    /* Attach, or go on doing so. place: what follows the colon. Returns 0 when attached, EINPROGRESS when the other
     * side has still to answer (fd tells when it did), else an errno. fd is kept or -1. */
    int32_t (*attach)(can_link *self, const char *place);

    /* Read frames that are waiting, in the order of arrival, with time_us filled in. Returns 0 or the errno of a lost
     * attachment; `count` receives the number of frames in either case. */
    int32_t (*receive)(can_link *self, can_frame *frames, uint32_t capacity, uint32_t *count);

    /* Send frames of this bus. Returns 0 or an errno; `count` receives the number of frames taken in either case. */
    int32_t (*send)(can_link *self, const can_frame *frames, uint32_t frame_count, uint32_t *count);
} link_driver;

extern const link_driver socketcan_driver;
extern const link_driver hub_driver;

enum {
    LINK_SEND_BATCH = CAN_LINK_RECEIVE_MIN, /* frames that `send` gets at once, at most: one packet of the hub */
};

/* Time since the epoch of the run in us; 0 before it. monotonic_time_ns: CLOCK_MONOTONIC. */
uint64_t link_time_us(const can_link *self, uint64_t monotonic_time_ns);

#endif
