/* One classic CAN bus: arbitration by identifier, frame time by the exact number of bits on the wire, load.
 *
 * The bus lives in slots, one per tick of the bench. What is pending when the bus transmits competes by
 * arbitration; a frame that cannot end inside the slot stays pending for the next one, so a time stamp always
 * lies in the slot in which receivers see the frame. Propagation, error handling and retransmission are not
 * modelled; of two buses, each runs on its own, so stamps of different buses in one slot carry no causality.
 */
#ifndef RACELOOP_CAN_BUS_H
#define RACELOOP_CAN_BUS_H

#include <stdbool.h>
#include <stdint.h>

#include "can_wire.h"
#include "common/can_frame.h"

enum {
    CAN_BUS_PENDING_MAX = 512, /* frames waiting at once */
};

/* A frame that waits, with its rank: arbitration first, then order of submission. */
typedef struct can_bus_pending {
    uint64_t rank;
    can_frame frame;
} can_bus_pending;

/* Counts since the start. Bits and times include the intermission. */
typedef struct can_bus_statistics {
    uint64_t frames;
    uint64_t bits;
    uint64_t stuff_bits;
    uint64_t busy_ns;
    uint64_t busiest_slot_ns; /* most busy time in one slot */
    uint64_t deferred;        /* times that pending frames had to wait for the next slot, per frame and slot */
    uint64_t lost;            /* frames refused because the queue was full */
} can_bus_statistics;

/* State of one bus: start it with can_bus_init. */
typedef struct can_bus_model {
    can_wire wire;
    uint32_t bit_ns;
    uint32_t pending_count;
    uint64_t sequence;
    uint64_t free_ns;       /* when the bus is idle again */
    uint64_t slot_start_us; /* slot that slot_busy_ns counts */
    uint64_t slot_busy_ns;
    can_bus_statistics statistics;
    can_bus_pending pending[CAN_BUS_PENDING_MAX]; /* lowest rank last */
} can_bus_model;

/* bit_rate: bit/s, 1000..1000000 and a divisor of 1e9; anything else gives a bus that never delivers. */
void can_bus_init(can_bus_model *self, uint32_t bit_rate);

/* Queue a frame; it is copied. False when the queue is full (counted as lost). */
bool can_bus_submit(can_bus_model *self, const can_frame *frame);

/* Transmit what is pending and fits before slot_end_us, in arbitration order, with time_us at each end of frame.
 * slot_start_us..slot_end_us: the slot, not before the one of the last call; several calls per slot are fine.
 * out: receives at most `capacity` frames. Returns how many. */
uint32_t can_bus_transmit(can_bus_model *self, uint64_t slot_start_us, uint64_t slot_end_us, can_frame *out,
                          uint32_t capacity);

/* Close a slot: count what stays pending. */
void can_bus_end_slot(can_bus_model *self);

#endif
