/* What the hub waits for: file descriptors in one epoll set, each known by its kind and its place in a table. */
#ifndef RACELOOP_HUB_POLL_H
#define RACELOOP_HUB_POLL_H

#include <stdint.h>

enum hub_source {
    HUB_SOURCE_SIGNAL = 0,
    HUB_SOURCE_LOCAL_LISTENER = 1,
    HUB_SOURCE_LOCAL_STATION = 2,
    HUB_SOURCE_TCP_LISTENER = 3,
    HUB_SOURCE_TCP_CLIENT = 4,
};

/* Watch `fd` for `events` (EPOLLIN, EPOLLOUT). source: enum hub_source. place: in its table. Returns 0 or the errno. */
int32_t hub_watch(int32_t epoll, int32_t fd, uint32_t events, uint32_t source, uint32_t place);

/* Change the events of a watched `fd`. */
int32_t hub_watch_again(int32_t epoll, int32_t fd, uint32_t events, uint32_t source, uint32_t place);

/* Source and place of an event's data. */
uint32_t hub_source_of(uint64_t data);
uint32_t hub_place_of(uint64_t data);

#endif
