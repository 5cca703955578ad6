/* What travels between the hub and a station: packets on a local socket (AF_UNIX, SOCK_SEQPACKET).
 *
 * A station connects once per bus and says hello; the hub welcomes it. From then on every packet in either direction is
 * 1..HUB_BATCH_MAX can_frame. The hub stamps a frame with the time at which the kernel took it in from its sender:
 * time_us on CLOCK_MONOTONIC since boot (not since an epoch); what a sender writes there is ignored. `sender` of a
 * delivered frame is CAN_STATION_NONE, as on a real bus. A frame that does not fit into a receiver's socket is lost for
 * that receiver and counted by the hub: a slow receiver delays nobody.
 */
#ifndef RACELOOP_PORT_HUB_WIRE_H
#define RACELOOP_PORT_HUB_WIRE_H

#include <stdint.h>

#include "ports/linux/can_link.h"

enum {
    HUB_MAGIC = 0x42554852, /* "RHUB" */
    HUB_VERSION = 1,
    HUB_BATCH_MAX = CAN_LINK_RECEIVE_MIN,
};

/* First packet of a station. Shorter by the filters that are not there. */
typedef struct hub_hello {
    uint32_t magic;
    uint32_t version;
    uint32_t bus;          /* enum can_bus */
    uint32_t filter_count; /* CAN_LINK_EVERYTHING: no filter */
    can_link_filter filters[CAN_LINK_FILTERS_MAX];
} hub_hello;

/* The hub's answer. */
typedef struct hub_welcome {
    uint32_t magic;
    uint32_t version;
    int32_t error; /* 0, or an errno; the hub hangs up after it */
} hub_welcome;

/* From the hub to a station: frames lost since the last such packet. */
typedef struct hub_loss {
    uint32_t magic;
    uint32_t version;
    uint64_t frames;
} hub_loss;

#endif
