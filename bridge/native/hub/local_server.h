/* The hub's door for our own stations: packets of frames on a local socket (ports/linux/hub_wire.h). */
#ifndef RACELOOP_LOCAL_SERVER_H
#define RACELOOP_LOCAL_SERVER_H

#include <stdbool.h>
#include <stdint.h>
#include <sys/stat.h>
#include <sys/un.h>

#include "ports/linux/hub_wire.h"

enum {
    LOCAL_STATIONS_MAX = 64,
    LOCAL_PLACES = LOCAL_STATIONS_MAX + 1, /* the last is for one who is told that there is no room */
};

/* One connection. */
typedef struct local_station {
    int32_t fd;      /* -1: free place */
    int32_t process; /* id of the one who connected */
    bool joined;     /* has said hello */
    uint8_t bus;
    uint64_t lost;    /* frames that did not fit into its socket */
    uint64_t untold;  /* of these, not told yet */
    uint64_t refused; /* frames of its that no CAN bus carries */
    uint32_t filter_count;
    can_link_filter filters[CAN_LINK_FILTERS_MAX];
} local_station;

/* The door: start it with local_server_open. */
typedef struct local_server {
    int32_t epoll;
    int32_t listener; /* -1: closed */
    dev_t device;     /* of the socket file, to remove no other */
    ino_t inode;
    uint64_t members[CAN_BUS_COUNT]; /* bit n: place n has joined the bus */
    local_station stations[LOCAL_PLACES];
    char path[sizeof(((struct sockaddr_un *)0)->sun_path)];
} local_server;

/* A packet of a station, with the kernel's stamp. */
typedef struct local_packet {
    uint8_t bus;
    uint32_t count;    /* 0: nothing to forward */
    uint64_t stamp_ns; /* CLOCK_REALTIME at which the kernel took it in; 0: the kernel did not say */
    can_frame frames[HUB_BATCH_MAX];
} local_packet;

/* Nothing open. epoll: where to wait. */
void local_server_init(local_server *self, int32_t epoll);

/* Listen at `path`. The socket file of a hub that has died is replaced.
 * Returns 0 or an errno: EADDRINUSE when a hub is alive there, EEXIST when there is a file that is no socket,
 * ENAMETOOLONG, or what the system says. */
int32_t local_server_open(local_server *self, const char *path);

/* Take in one who connects. */
void local_server_accept(local_server *self);

/* Read one packet of a station: its hello is answered here, whoever does not keep to the wire is sent away. */
void local_server_read(local_server *self, uint32_t place, local_packet *packet);

/* Count frames of a station that no CAN bus carries. */
void local_server_refuse(local_server *self, uint32_t place, uint32_t frames);

/* Hand frames, 1..HUB_BATCH_MAX, to the stations of a bus. except: place of their sender, LOCAL_STATIONS_MAX for none.
 */
void local_server_deliver(local_server *self, uint8_t bus, uint32_t except, const can_frame *frames, uint32_t count);

/* Send everybody away, report losses, remove the socket file. */
void local_server_close(local_server *self);

#endif
