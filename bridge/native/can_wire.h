/* A CAN frame as bits on the wire: its length with stuff bits, its CRC, its rank in arbitration (ISO 11898-1:2015,
 * classic and FD with the ISO's stuff count).
 */
#ifndef RACELOOP_CAN_WIRE_H
#define RACELOOP_CAN_WIRE_H

#include <stdint.h>

#include "common/can_frame.h"

enum {
    CAN_WIRE_INTERFRAME_BITS = 3, /* intermission behind each frame */
    CAN_WIRE_STUFF_STATES = 8,    /* value of the last bit, and how many of them are in a row: 1..4 */
    CAN_WIRE_FD_DATA_MAX = 64,
};

/* Bits of can_frame.flags that only a bus knows; the firmware's frames are classic. */
enum can_wire_flag {
    CAN_WIRE_FLAG_FD = 8,   /* CAN FD; dlc is the number of data bytes, up to 64 */
    CAN_WIRE_FLAG_BRS = 16, /* from the bit rate switch to the CRC delimiter at the data bit rate */
    CAN_WIRE_FLAG_ESI = 32, /* the sender is error-passive */
};

/* Bits of an FD frame from start of frame to end of frame, stuff bits included, intermission not. */
typedef struct can_wire_fd_length {
    uint32_t head;  /* before the bit rate switch, that bit included: at the nominal bit rate */
    uint32_t fast;  /* up to the CRC delimiter, that included: at the data bit rate when the flag says so */
    uint32_t tail;  /* acknowledgement and end of frame: at the nominal bit rate */
    uint32_t stuff; /* stuff bits among them, dynamic and fixed */
} can_wire_fd_length;

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

/* Length of an FD frame. frame: its first 8 data bytes; more: the others, may be null when there are none.
 * frame->dlc: 0..8, 12, 16, 20, 24, 32, 48 or 64; what lies between counts as the next of them. */
can_wire_fd_length can_wire_fd_bits(const can_wire *self, const can_frame *frame, const uint8_t *more);

/* Bits of each of `count` frames as above, with intermission. bits: receives `count` values. */
void can_wire_bits_of_each(const can_wire *self, const can_frame *frames, uint32_t count, uint32_t *bits);

/* Arbitration field as the wire orders it, most significant bit first; the lowest value wins. Error frames: 0. */
uint32_t can_wire_arbitration(const can_frame *frame);

#endif
