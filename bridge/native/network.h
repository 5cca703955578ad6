/* The car's network: buses, the stations that sit on them with their inboxes, and a log of all that was sent.
 *
 * A station submits frames to buses; transmitting a bus puts them into the inbox of every other station on it.
 * Everything is bounded; what does not fit is counted, never silently dropped.
 */
#ifndef RACELOOP_NETWORK_H
#define RACELOOP_NETWORK_H

#include <stdbool.h>
#include <stdint.h>

#include "can_bus.h"
#include "common/can_frame.h"

enum {
    NETWORK_INBOX_MAX = 512,
    NETWORK_LOG_MAX = 8192,
    NETWORK_WATCH_MAX = 16,
    NETWORK_SCRATCH_MAX = 64,
    NETWORK_DIVERTED_MAX = 1024,
};

/* What a station has received and not taken yet, oldest first. */
typedef struct network_inbox {
    uint32_t count;
    uint32_t lost;
    can_frame frames[NETWORK_INBOX_MAX];
} network_inbox;

/* Newest frame of one identifier. */
typedef struct network_watch {
    can_frame frame;
    uint32_t updates; /* frames seen */
} network_watch;

/* State of the network: start it with network_init. */
typedef struct network {
    uint64_t slot_start_ns;
    uint64_t slot_end_ns;
    uint64_t misaddressed; /* frames submitted for a bus that does not exist */
    uint32_t log_lost;
    uint32_t log_count;
    uint32_t watch_count;
    uint32_t diverted_count;
    uint32_t diverted_lost;
    bool diverting;                 /* what stations submit goes to `diverted`, not to the buses */
    uint8_t members[CAN_BUS_COUNT]; /* bit n: station n sits on the bus */
    network_watch watches[NETWORK_WATCH_MAX];
    can_bus_model buses[CAN_BUS_COUNT];
    network_inbox inboxes[CAN_STATION_COUNT];
    /* From here on nothing lasts once the log is drained and the tick is over: it need not be saved. */
    can_frame log[NETWORK_LOG_MAX];             /* transmitted since the last drain, per bus in order of time */
    can_bus_frame scratch[NETWORK_SCRATCH_MAX]; /* on their way through */
    can_frame diverted[NETWORK_DIVERTED_MAX];   /* submitted and held back, in order */
} network;

/* An empty network with the stations of the car on their buses. bit_rates: bit/s per bus, see can_bus_init. */
void network_init(network *self, const uint32_t bit_rates[CAN_BUS_COUNT]);

/* Start the slot [start_us, end_us): a tick of the bench. Monotonic. */
void network_begin_slot(network *self, uint64_t start_us, uint64_t end_us);

/* End the slot: close the account of every bus. */
void network_end_slot(network *self);

/* Queue frames on the buses that they name, or hold them back while `diverting`.
 * station: enum can_station, stamped as their sender. */
void network_submit(network *self, uint8_t station, const can_frame *frames, uint32_t count);

/* Queue frames on the buses that they name, each at the station that is its sender, whether `diverting` or not. */
void network_forward(network *self, const can_frame *frames, uint32_t count);

/* Transmit one bus: into inboxes, watches and the log. */
void network_transmit(network *self, uint8_t bus);

/* Forget what the station has received. */
void network_clear_inbox(network *self, uint8_t station);

/* Keep the newest frame of a standard identifier. Returns the place in `watches`, or NETWORK_WATCH_MAX when full. */
uint32_t network_add_watch(network *self, uint8_t bus, uint32_t id);

#endif
