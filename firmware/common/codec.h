/* Codec runtime: what the generated pack and unpack functions leave open.
 *
 * cantools' C packs and unpacks; it saturates nothing, checks no counter and knows no CRC. This module does,
 * driven by the const table `codec_table` that dbc/generate.py makes from the DBC files. Pure functions; all
 * state is in the structs that the caller owns.
 */
#ifndef RACELOOP_CODEC_H
#define RACELOOP_CODEC_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

/* Verdict on a frame or a value. Negative: not to be used. */
typedef enum codec_status {
    CODEC_OK = 0,
    CODEC_UNKNOWN_ID = -1,
    CODEC_REMOTE_FRAME = -2,
    CODEC_ERROR_FRAME = -3,
    CODEC_SHORT_FRAME = -4,   /* fewer data bytes than the DBC says; more is accepted, as public stacks do */
    CODEC_COUNTER_STUCK = -5, /* counter equal to the one before */
    CODEC_CRC_MISMATCH = -6,
    CODEC_NOT_FINITE = -7,
    CODEC_OUT_OF_RANGE = -8,
    CODEC_STATUS_COUNT = 9,
} codec_status;

/* What the DBC files say of one message. */
typedef struct codec_message {
    uint32_t id;
    uint8_t bus;            /* enum can_bus */
    uint8_t extended;       /* 1: 29-bit id */
    uint8_t dlc;            /* data bytes */
    uint8_t counter_start;  /* first bit of the message counter, little-endian bit numbering; it may span bytes */
    uint8_t counter_length; /* bits, at most 8; 0: no counter */
    uint8_t crc_start;      /* first bit of the little-endian CRC; at a byte boundary */
    uint8_t crc_length;     /* bits, 16; 0: no CRC */
    uint8_t sender;         /* enum can_station of the owner */
    uint8_t receivers;      /* bit n: enum can_station n is meant to read it */
    uint16_t cycle_ms;      /* nominal period; 0: on event */
    uint16_t timeout_ms;    /* age after which the content is stale; 0: never */
} codec_message;

/* All messages, sorted by bus, then 11-bit before 29-bit ids, then id. generated/codec_table.h names the rows. */
extern const codec_message codec_table[];
extern const uint32_t codec_table_count;

/* The messages of one layout of CAN1 and of the buses beside it, in the order of codec_table. */
typedef struct codec_profile {
    const codec_message *messages;
    uint32_t count;
} codec_profile;

/* All profiles; generated/codec_table.h names the rows. That of codec_table is the one the firmware is written in; the
 * others are what dbw_profile.h translates from and to. */
extern const codec_profile codec_profiles[];

/* Reception state of one message: zero it to start. */
typedef struct codec_rx {
    uint64_t last_valid_us; /* time of the last frame that passed all checks */
    uint32_t valid;         /* frames that passed */
    uint32_t rejected;      /* frames of this id that failed a check */
    uint8_t counter;        /* last counter seen, valid or not */
    bool seen;              /* at least one frame was valid */
    bool counter_known;     /* `counter` holds a value */
    int8_t last_status;     /* codec_status of the newest frame */
} codec_rx;

/* Row of codec_table for an address, or null. Binary search, at most 8 steps. */
const codec_message *codec_find(uint8_t bus, uint32_t id, bool extended);

/* The same in the messages of a profile. profile: not null. */
const codec_message *codec_find_in(const codec_profile *profile, uint8_t bus, uint32_t id, bool extended);

/* Verdict on the frame as such: known id, data frame, no error frame, enough data.
 * message: receives the row when the id is known, else null; not null itself. */
codec_status codec_accept(const can_frame *frame, const codec_message **message);

/* The same by the messages of a profile. profile: not null. */
codec_status codec_accept_in(const codec_profile *profile, const can_frame *frame, const codec_message **message);

/* Accept the frame and check its counter (it must differ from the one before: public senders count 0..7, 0..15
 * or 0..255, so "plus one" would reject them) and its CRC. now_us: time of reception, monotonic.
 * Only a valid frame refreshes last_valid_us. A frame with a wrong CRC does not move the counter. */
codec_status codec_receive(codec_rx *rx, const can_frame *frame, uint64_t now_us);

/* True when the message was never valid and `since_us` is older than its timeout, or its last valid frame is.
 * since_us: start of supervision. timeout_ms 0: never.
 * A time that lies in the future counts as older: after the clock was set back only a new frame is fresh. */
bool codec_timed_out(const codec_rx *rx, uint16_t timeout_ms, uint64_t since_us, uint64_t now_us);

/* Write the counter (then increment the caller's, wrapping at the field's width) and the CRC of a packed frame. */
void codec_finish(can_frame *frame, const codec_message *message, uint8_t *counter);

/* CRC-16/CCITT-FALSE (poly 0x1021, init 0xFFFF, no reflection, no final xor) over `length` bytes.
 * crc: 0xFFFF to start, or the result so far. */
uint16_t codec_crc16(uint16_t crc, const uint8_t *data, uint32_t length);

/* CRC of a frame as CAN3 carries it: over data bytes before the CRC field, then the id's low and high byte, so
 * that a frame under a wrong address fails (coverage and the id are ours; the public file does not say). */
uint16_t codec_frame_crc(const can_frame *frame, const codec_message *message);

/* Clamp into [minimum, maximum]. NaN gives `minimum` and CODEC_NOT_FINITE, as do infinities at their end;
 * a clamped value CODEC_OUT_OF_RANGE. status: not null. minimum <= maximum. */
float codec_clamp(float value, float minimum, float maximum, codec_status *status);

#endif
