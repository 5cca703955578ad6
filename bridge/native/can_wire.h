/* A classic CAN frame as bits on the wire: its length with stuff bits, its CRC, its rank in arbitration
 * (ISO 11898-1).
 */
#ifndef RACELOOP_CAN_WIRE_H
#define RACELOOP_CAN_WIRE_H

#include <stdint.h>

#include "common/can_frame.h"

enum {
    CAN_WIRE_INTERFRAME_BITS = 3, /* intermission behind each frame */
    CAN_WIRE_STUFF_STATES = 8,    /* value of the last bit, and how many of them are in a row: 1..4 */
};

/* Tables that take the wire a byte at a time. Constant once made. */
typedef struct can_wire {
    uint16_t crc[256];
    uint8_t stuffing[CAN_WIRE_STUFF_STATES][256]; /* state behind the byte, and stuff bits in it times 8 */
} can_wire;

void can_wire_init(can_wire *self);

/* CRC-15/CAN (poly 0x4599, init 0) over whole bytes, most significant bit first. */
uint16_t can_wire_crc15(const can_wire *self, const uint8_t *bytes, uint32_t length);

/* Bits from start of frame to end of frame, stuff bits included, intermission not.
 * stuff_bits: receives their number; not null. An error frame counts 20: flag, its echo and delimiter. */
uint32_t can_wire_bits(const can_wire *self, const can_frame *frame, uint32_t *stuff_bits);

/* Bits of each of `count` frames as above, with intermission. bits: receives `count` values. */
void can_wire_bits_of_each(const can_wire *self, const can_frame *frames, uint32_t count, uint32_t *bits);

/* Arbitration field as the wire orders it, most significant bit first; the lowest value wins. Error frames: 0. */
uint32_t can_wire_arbitration(const can_frame *frame);

#endif
