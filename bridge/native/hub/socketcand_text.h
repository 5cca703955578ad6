/* The text of the socketcand protocol, raw mode: requests of a client read, frames for it written. Pure.
 *
 *     < open CAN1 >  < rawmode >  < echo >  < send ID DLC BYTE... >        from the client
 *     < frame ID SECONDS.MICROSECONDS DATA >  < error ID SECONDS.MICROSECONDS >        to it
 *
 * Numbers are hexadecimal but for the seconds. An identifier of 8 digits is 29-bit, one of up to 3 digits 11-bit.
 * There is no text for a remote frame.
 */
#ifndef RACELOOP_SOCKETCAND_TEXT_H
#define RACELOOP_SOCKETCAND_TEXT_H

#include <stdint.h>

#include "common/can_frame.h"

enum {
    SOCKETCAND_REQUEST_MAX = 128, /* characters from '<' to '>' */
    SOCKETCAND_FRAME_MAX = 64,    /* characters of a written frame, and a zero */
};

/* What a client asks for. */
enum socketcand_kind {
    SOCKETCAND_INCOMPLETE = 0, /* the text ends before the request does */
    SOCKETCAND_OPEN = 1,
    SOCKETCAND_UNKNOWN_CHANNEL = 2,
    SOCKETCAND_RAWMODE = 3,
    SOCKETCAND_OTHER_MODE = 4, /* bcmmode, controlmode, isotpmode */
    SOCKETCAND_ECHO = 5,
    SOCKETCAND_SEND = 6,
    SOCKETCAND_BAD_SEND = 7, /* not ID DLC and DLC bytes, or out of range */
    SOCKETCAND_UNKNOWN = 8,  /* in brackets, but no request */
    SOCKETCAND_GARBAGE = 9,  /* not the protocol: where the next request begins cannot be told */
};

typedef struct socketcand_request {
    uint8_t kind;    /* enum socketcand_kind */
    uint8_t bus;     /* of SOCKETCAND_OPEN: enum can_bus */
    can_frame frame; /* of SOCKETCAND_SEND: id, flags, dlc and data, the rest zero */
} socketcand_request;

/* Read the first request of a text; blanks before it and between its words do not matter.
 *
 * Returns the characters that it took: blanks only when it is INCOMPLETE, the whole text when that is GARBAGE. */
uint32_t socketcand_read(const char *text, uint32_t length, socketcand_request *request);

/* Write a received frame and a zero behind it.
 *
 * wall_us: its time, CLOCK_REALTIME, as clients of socketcand expect. text: SOCKETCAND_FRAME_MAX characters.
 * Returns the characters without the zero; 0 for a remote frame. */
uint32_t socketcand_write(char *text, const can_frame *frame, uint64_t wall_us);

#endif
