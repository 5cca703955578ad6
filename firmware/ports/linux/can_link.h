/* A link: one station's attachment to one CAN bus, non-blocking. Behind it is SocketCAN or the hub on this machine.
 *
 * Frames carry the bus of the link, and time_us = microseconds since the epoch of the run at which the kernel took the
 * frame in on the bus (CLOCK_MONOTONIC; the kernel's wall-clock stamp is converted, so a step of the wall clock
 * moves no frame). A station does not hear its own frames.
 *
 * Addresses: "socketcan:INTERFACE" and "hub:PATH", where PATH is the hub's local socket.
 */
#ifndef RACELOOP_PORT_CAN_LINK_H
#define RACELOOP_PORT_CAN_LINK_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

enum {
    CAN_LINK_ADDRESS_MAX = 128, /* with its final zero; a hub's path is at most 107 bytes long */
    CAN_LINK_FILTERS_MAX = 128,
    CAN_LINK_RECEIVE_MIN = 64, /* frames to have room for when receiving: what one packet of the hub can hold */
    CAN_LINK_RETRY_MS = 100,   /* between attempts to come up again */
};

/* filter_count: no filter. */
#define CAN_LINK_EVERYTHING 0xFFFFFFFFU

/* Kind of link. */
enum can_link_kind {
    CAN_LINK_SOCKETCAN = 1,
    CAN_LINK_HUB = 2,
};

/* State of a link. */
enum can_link_state {
    CAN_LINK_CLOSED = 0,
    CAN_LINK_UP = 1,
    CAN_LINK_DOWN = 2, /* interface down or gone, or the hub has ended; receive and send try again by themselves */
};

/* One accepted identifier, for data frames: remote frames pass CAN_LINK_EVERYTHING only. */
typedef struct can_link_filter {
    uint32_t id;      /* without flag bits */
    uint8_t extended; /* 1: 29-bit */
    uint8_t reserved[3];
} can_link_filter;

/* Counts since opening. */
typedef struct can_link_statistics {
    uint64_t received;
    uint64_t sent;
    uint64_t refused;      /* send queue full: dropped, because a late command is worse than none */
    uint64_t undelivered;  /* not sent because the link was down */
    uint64_t overflows;    /* frames lost in the receive queue of the kernel or hub, where it tells */
    uint64_t error_frames; /* received with CAN_FLAG_ERROR; they are delivered too */
    uint64_t outages;      /* times the link went down */
    uint64_t clock_steps;  /* steps of the wall clock seen */
} can_link_statistics;

/* A link: zero it before opening. */
typedef struct can_link {
    int32_t fd;         /* -1: none */
    uint8_t kind;       /* enum can_link_kind */
    uint8_t state;      /* enum can_link_state */
    uint8_t bus;        /* enum can_bus */
    bool stamps;        /* the kernel stamps frames; else they carry the time at which they were read */
    bool attaching;     /* the other side has still to answer */
    int32_t last_error; /* errno of the newest failure */
    uint64_t epoch_ns;
    uint64_t earliest_ns;    /* frames that are still to be read came in after this */
    uint64_t retry_ns;       /* when to try again to come up, or to give up waiting for the hub's welcome */
    int64_t clock_offset_ns; /* CLOCK_REALTIME - CLOCK_MONOTONIC when the receive queue was last empty */
    uint32_t kernel_drops;   /* the kernel's own count of frames lost, modulo 2^32 */
    uint32_t filter_count;
    can_link_statistics statistics;
    can_link_filter filters[CAN_LINK_FILTERS_MAX];
    char address[CAN_LINK_ADDRESS_MAX];
} can_link;

/* Attach to a bus. address: see above. bus: enum can_bus. epoch_ns: of the run, CLOCK_MONOTONIC.
 * filters: identifiers to receive, filter_count of them at most CAN_LINK_FILTERS_MAX; 0: receive nothing;
 * CAN_LINK_EVERYTHING: all. Error frames come in any case. Waits for a hub's welcome, 1 s at most.
 * Returns 0 or an errno: EINVAL for an address that is none or for too many filters, ENODEV or ENETDOWN for a missing
 * interface or one that is down, EAFNOSUPPORT without CAN in the kernel, ENOENT or ECONNREFUSED without a hub, EPROTO
 * for a hub of another version, ETIMEDOUT for one that does not answer, or what else the kernel says.
 * On an error the link stays closed. */
int32_t can_link_open(can_link *self, const char *address, uint8_t bus, uint64_t epoch_ns,
                      const can_link_filter *filters, uint32_t filter_count);

/* Take what has arrived, oldest first; never blocks. capacity: frames that fit, CAN_LINK_RECEIVE_MIN or more.
 * Returns the number of frames; 0 from a link that is down, which tries to come up again, or closed. */
uint32_t can_link_receive(can_link *self, can_frame *frames, uint32_t capacity);

/* Hand frames to the bus in order; never blocks. Frames of other buses are skipped. Returns how many were taken; the
 * others of this bus are counted as refused (EAGAIN, ENOBUFS, ENOMEM, EBUSY: no room, later frames have a chance) or
 * undelivered (any other error: the link goes down). */
uint32_t can_link_send(can_link *self, const can_frame *frames, uint32_t count);

/* Detach. The statistics stay readable. */
void can_link_close(can_link *self);

/* What went wrong, for people, in one line: text for an errno of can_link_open or last_error. Static storage. */
const char *can_link_error_text(int32_t error);

#endif
