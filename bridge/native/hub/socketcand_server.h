/* The hub's door for everybody else: the socketcand protocol over TCP on 127.0.0.1, raw mode only.
 *
 * A client that asks for what does not exist gets an error text; one that does not speak the protocol is sent away. A
 * client whose buffer is full loses frames, and hears an error frame "receive overflow" when there is room again, as
 * from a CAN controller.
 */
#ifndef RACELOOP_SOCKETCAND_SERVER_H
#define RACELOOP_SOCKETCAND_SERVER_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

enum {
    SOCKETCAND_CLIENTS_MAX = 32,
    SOCKETCAND_IN_MAX = 4096,     /* characters read at once */
    SOCKETCAND_OUT_MAX = 1 << 16, /* characters that wait for the kernel to take them */
    SOCKETCAND_BATCH_MAX = 64,    /* frames taken from the text at once */
};

/* What a client has come to. */
enum socketcand_state {
    SOCKETCAND_GREETED = 0,
    SOCKETCAND_ON_BUS = 1, /* has opened a channel */
    SOCKETCAND_RAW = 2,    /* hears and sends */
};

/* One connection. */
typedef struct socketcand_client {
    int32_t fd;            /* -1: free place */
    uint16_t port;         /* its own, to name it */
    uint8_t state;         /* enum socketcand_state */
    uint8_t bus;           /* from SOCKETCAND_ON_BUS on */
    bool complained;       /* a mistake of it was logged */
    bool waits_for_room;   /* the kernel did not take everything */
    uint64_t quiet_end_ns; /* until then what is for it is held back; 0: not */
    uint64_t lost;         /* frames that did not fit */
    uint64_t untold;       /* of these, not told yet */
    uint32_t in_count;
    uint32_t out_start;
    uint32_t out_end;
    char in[SOCKETCAND_IN_MAX];
    char out[SOCKETCAND_OUT_MAX];
} socketcand_client;

/* The door: start it with socketcand_server_open. */
typedef struct socketcand_server {
    int32_t epoll;
    int32_t listener; /* -1: closed */
    uint16_t port;
    uint32_t quiet_count;            /* clients that are held back */
    uint32_t members[CAN_BUS_COUNT]; /* bit n: place n is on the bus in raw mode */
    socketcand_client clients[SOCKETCAND_CLIENTS_MAX];
} socketcand_server;

/* Nothing open. epoll: where to wait. */
void socketcand_server_init(socketcand_server *self, int32_t epoll);

/* Listen on 127.0.0.1. port: 0 for any free one. Returns 0 or an errno, EADDRINUSE for a port in use. */
int32_t socketcand_server_open(socketcand_server *self, uint16_t port);

/* Take in one who connects. */
void socketcand_server_accept(socketcand_server *self);

/* Read what a client has said; socketcand_server_next takes it apart. */
void socketcand_server_read(socketcand_server *self, uint32_t place);

/* Answer what a client has said, up to a batch of frames that it sends.
 *
 * now_ns: CLOCK_MONOTONIC. frames: receives at most SOCKETCAND_BATCH_MAX, all for the bus of the client.
 * Returns their number; 0 when all is answered. */
uint32_t socketcand_server_next(socketcand_server *self, uint32_t place, uint64_t now_ns, can_frame *frames);

/* Hand frames to the clients of a bus.
 *
 * except: place of their sender, SOCKETCAND_CLIENTS_MAX for none. offset_us: CLOCK_REALTIME - CLOCK_MONOTONIC. */
void socketcand_server_deliver(socketcand_server *self, uint8_t bus, uint32_t except, const can_frame *frames,
                               uint32_t count, int64_t offset_us);

/* Send on what waits for a client. */
void socketcand_server_flush(socketcand_server *self, uint32_t place);

/* Let go what was held back long enough. Returns the ns until the next client's time, UINT64_MAX for none. */
uint64_t socketcand_server_release(socketcand_server *self, uint64_t now_ns);

/* Send everybody away and report losses. */
void socketcand_server_close(socketcand_server *self);

#endif
