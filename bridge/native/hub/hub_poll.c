#include "hub_poll.h"

#include <errno.h>
#include <sys/epoll.h>

static int32_t control(int32_t operation, int32_t epoll, int32_t fd, uint32_t events, uint32_t source, uint32_t place)
{
    struct epoll_event event = {.events = events, .data.u64 = (uint64_t)source << 32U | place};
    return epoll_ctl(epoll, operation, fd, &event) == 0 ? 0 : errno;
}

int32_t hub_watch(int32_t epoll, int32_t fd, uint32_t events, uint32_t source, uint32_t place)
{
    return control(EPOLL_CTL_ADD, epoll, fd, events, source, place);
}

int32_t hub_watch_again(int32_t epoll, int32_t fd, uint32_t events, uint32_t source, uint32_t place)
{
    return control(EPOLL_CTL_MOD, epoll, fd, events, source, place);
}

uint32_t hub_source_of(uint64_t data)
{
    return (uint32_t)(data >> 32U);
}

uint32_t hub_place_of(uint64_t data)
{
    return (uint32_t)data;
}
