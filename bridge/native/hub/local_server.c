#define _GNU_SOURCE

#include "local_server.h"

#include <errno.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "hub.h"
#include "hub_poll.h"
#include "ports/linux/ecu_options.h"
#include "ports/linux/process_log.h"

enum {
    BACKLOG = 16,
    SEND_BUFFER_BYTES = 1 << 20, /* the kernel doubles it and books some 770 for a packet of one frame */
    NS_PER_S = 1000000000,
    HELLO_HEAD = sizeof(hub_hello) - sizeof(((hub_hello *)0)->filters),
};

static uint64_t bit(uint32_t place)
{
    return UINT64_C(1) << place;
}

void local_server_init(local_server *self, int32_t epoll)
{
    memset(self, 0, sizeof *self);
    self->epoll = epoll;
    self->listener = -1;
    for (uint32_t place = 0; place < LOCAL_PLACES; place++) {
        self->stations[place].fd = -1;
    }
}

/* Errno of what stands in the way at the address, 0 when nothing does (any more). */
static int32_t clear_the_way(const struct sockaddr_un *address)
{
    struct stat status;
    if (lstat(address->sun_path, &status) != 0) {
        return errno == ENOENT ? 0 : errno;
    }
    if (!S_ISSOCK(status.st_mode)) {
        return EEXIST;
    }
    const int32_t probe = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (probe < 0) {
        return errno;
    }
    const int32_t error = connect(probe, (const struct sockaddr *)address, sizeof *address) == 0 ? 0 : errno;
    (void)close(probe);
    if (error != ECONNREFUSED) {
        return EADDRINUSE; /* someone answers, or would if he had time */
    }
    return unlink(address->sun_path) == 0 ? 0 : errno;
}

int32_t local_server_open(local_server *self, const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    const size_t length = strlen(path);
    if (length >= sizeof address.sun_path) {
        return ENAMETOOLONG;
    }
    memcpy(address.sun_path, path, length + 1U);
    int32_t error = clear_the_way(&address);
    if (error != 0) {
        return error;
    }
    const int32_t listener = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (listener < 0) {
        return errno;
    }
    struct stat status;
    if (bind(listener, (const struct sockaddr *)&address, sizeof address) != 0 || lstat(path, &status) != 0) {
        error = errno;
        (void)close(listener);
        return error;
    }
    self->listener = listener;
    self->device = status.st_dev;
    self->inode = status.st_ino;
    memcpy(self->path, path, length + 1U);
    error = listen(listener, BACKLOG) == 0 ? hub_watch(self->epoll, listener, EPOLLIN, HUB_SOURCE_LOCAL_LISTENER, 0)
                                           : errno;
    if (error != 0) {
        local_server_close(self);
    }
    return error;
}

static void welcome(int32_t fd, int32_t error)
{
    const hub_welcome answer = {.magic = HUB_MAGIC, .version = HUB_VERSION, .error = error};
    (void)send(fd, &answer, sizeof answer, MSG_DONTWAIT | MSG_NOSIGNAL); /* who is gone needs no answer */
}

void local_server_accept(local_server *self)
{
    const int32_t fd = accept4(self->listener, NULL, NULL, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (fd < 0) {
        return; /* gone again */
    }
    uint32_t place = 0;
    while (place < LOCAL_PLACES && self->stations[place].fd >= 0) {
        place++;
    }
    if (place >= LOCAL_STATIONS_MAX) {
        process_log("local station refused: %d are connected already", LOCAL_STATIONS_MAX);
    }
    if (place == LOCAL_PLACES) {
        (void)close(fd);
        return;
    }
    local_station *station = &self->stations[place];
    memset(station, 0, sizeof *station);
    struct ucred peer = {0};
    socklen_t size = sizeof peer;
    if (getsockopt(fd, SOL_SOCKET, SO_PEERCRED, &peer, &size) == 0) {
        station->process = peer.pid;
    }
    const int on = 1;
    const int bytes = SEND_BUFFER_BYTES;
    (void)setsockopt(fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on); /* without it: the time of reading */
    if (setsockopt(fd, SOL_SOCKET, SO_SNDBUFFORCE, &bytes, sizeof bytes) != 0) {
        (void)setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes); /* up to what the system allows */
    }
    const int32_t error = hub_watch(self->epoll, fd, EPOLLIN, HUB_SOURCE_LOCAL_STATION, place);
    if (error != 0) {
        process_log("local station of process %d refused: %s", station->process, strerror(error));
        (void)close(fd);
        return;
    }
    station->fd = fd;
}

static void forget(local_server *self, uint32_t place)
{
    local_station *station = &self->stations[place];
    if (station->lost > 0) {
        process_log("station on %s (process %d) lost %llu frames: it read too slowly", ecu_bus_name(station->bus),
                    station->process, (unsigned long long)station->lost);
    }
    if (station->refused > 0) {
        process_log("station on %s (process %d) sent %llu frames that no CAN bus carries", ecu_bus_name(station->bus),
                    station->process, (unsigned long long)station->refused);
    }
    if (station->joined) {
        self->members[station->bus] &= ~bit(place);
    }
    (void)close(station->fd);
    station->fd = -1;
}

/* Errno of a hello, 0 for a good one. */
static int32_t hello_error(const hub_hello *hello, size_t size)
{
    if (size < HELLO_HEAD || hello->magic != HUB_MAGIC || hello->version != HUB_VERSION) {
        return EPROTO;
    }
    const uint32_t filters = hello->filter_count == CAN_LINK_EVERYTHING ? 0 : hello->filter_count;
    if (hello->bus >= CAN_BUS_COUNT || filters > CAN_LINK_FILTERS_MAX) {
        return EINVAL;
    }
    return size == HELLO_HEAD + filters * sizeof hello->filters[0] ? 0 : EPROTO;
}

static void greet(local_server *self, uint32_t place, const hub_hello *hello, size_t size)
{
    local_station *station = &self->stations[place];
    const int32_t mistake = hello_error(hello, size);
    const int32_t error = place < LOCAL_STATIONS_MAX ? mistake : EUSERS;
    if (error == 0) {
        station->joined = true;
        station->bus = (uint8_t)hello->bus;
        station->filter_count = hello->filter_count;
        memcpy(station->filters, hello->filters, size - HELLO_HEAD);
        self->members[station->bus] |= bit(place);
    }
    welcome(station->fd, error);
    if (mistake != 0) {
        process_log("local station of process %d sent away: its hello is not that of version %d of the hub",
                    station->process, HUB_VERSION);
    }
    if (error != 0) {
        forget(self, place);
    }
}

/* The kernel's stamp of a packet in ns of CLOCK_REALTIME, 0 without. */
static uint64_t stamp_of(struct msghdr *message)
{
    for (struct cmsghdr *item = CMSG_FIRSTHDR(message); item != NULL; item = CMSG_NXTHDR(message, item)) {
        if (item->cmsg_level == SOL_SOCKET && item->cmsg_type == SCM_TIMESTAMPNS) {
            struct timespec stamp;
            memcpy(&stamp, CMSG_DATA(item), sizeof stamp);
            return (uint64_t)stamp.tv_sec * NS_PER_S + (uint64_t)stamp.tv_nsec;
        }
    }
    return 0;
}

void local_server_read(local_server *self, uint32_t place, local_packet *packet)
{
    packet->count = 0;
    local_station *station = &self->stations[place];
    if (station->fd < 0) {
        return; /* sent away since the event was reported */
    }
    union {
        hub_hello hello;
        can_frame frames[HUB_BATCH_MAX];
    } content;
    union {
        struct cmsghdr head;
        char bytes[CMSG_SPACE(sizeof(struct timespec))];
    } control;
    struct iovec vector = {.iov_base = &content, .iov_len = sizeof content};
    struct msghdr message = {
        .msg_iov = &vector, .msg_iovlen = 1, .msg_control = &control, .msg_controllen = sizeof control};
    const ssize_t size = recvmsg(station->fd, &message, MSG_DONTWAIT);
    /* Who closes with something unread resets the connection, which is told once; its last packets are still there. */
    if (size < 0 && (errno == EAGAIN || errno == EINTR || errno == ECONNRESET)) {
        return;
    }
    if (size <= 0) {
        forget(self, place);
        return;
    }
    const bool whole = (message.msg_flags & MSG_TRUNC) == 0;
    if (!station->joined) {
        greet(self, place, &content.hello, whole ? (size_t)size : 0);
        return;
    }
    if (!whole || (size_t)size % sizeof(can_frame) != 0) {
        process_log("station on %s (process %d) sent away: a packet of it is not 1 to %d frames",
                    ecu_bus_name(station->bus), station->process, HUB_BATCH_MAX);
        forget(self, place);
        return;
    }
    packet->bus = station->bus;
    packet->count = (uint32_t)((size_t)size / sizeof(can_frame));
    packet->stamp_ns = stamp_of(&message);
    memcpy(packet->frames, content.frames, (size_t)size);
}

void local_server_refuse(local_server *self, uint32_t place, uint32_t frames)
{
    local_station *station = &self->stations[place];
    if (station->refused == 0) {
        process_log("station on %s (process %d) sends frames that no CAN bus carries; they are dropped",
                    ecu_bus_name(station->bus), station->process);
    }
    station->refused += frames;
}

/* 0 or the errno; a station that is gone takes everything until its event says so. */
static int32_t send_packet(const local_station *station, const void *packet, size_t size)
{
    const bool taken = send(station->fd, packet, size, MSG_DONTWAIT | MSG_NOSIGNAL) >= 0;
    return taken || errno == EPIPE || errno == ECONNRESET ? 0 : errno;
}

static void deliver_one(local_station *station, const can_frame *frames, uint32_t count)
{
    const hub_loss loss = {.magic = HUB_MAGIC, .version = HUB_VERSION, .frames = station->untold};
    if (station->untold > 0 && send_packet(station, &loss, sizeof loss) == 0) {
        station->untold = 0;
    }
    /* Frames behind a loss that could not be told are lost too, else its place in the stream would be wrong. */
    if (station->untold > 0 || send_packet(station, frames, count * sizeof frames[0]) != 0) {
        if (station->lost == 0) {
            process_log("station on %s (process %d) reads too slowly: it loses frames", ecu_bus_name(station->bus),
                        station->process);
        }
        station->lost += count;
        station->untold += count;
    }
}

void local_server_deliver(local_server *self, uint8_t bus, uint32_t except, const can_frame *frames, uint32_t count)
{
    uint64_t rest = self->members[bus];
    if (except < LOCAL_STATIONS_MAX) {
        rest &= ~bit(except);
    }
    while (rest != 0) {
        const uint32_t place = (uint32_t)__builtin_ctzll(rest);
        rest &= rest - 1U;
        local_station *station = &self->stations[place];
        can_frame heard[HUB_BATCH_MAX];
        const uint32_t wanted = hub_select(station->filters, station->filter_count, frames, count, heard);
        if (wanted > 0) {
            deliver_one(station, heard, wanted);
        }
    }
}

void local_server_close(local_server *self)
{
    for (uint32_t place = 0; place < LOCAL_PLACES; place++) {
        if (self->stations[place].fd >= 0) {
            forget(self, place);
        }
    }
    if (self->listener < 0) {
        return;
    }
    (void)close(self->listener);
    self->listener = -1;
    struct stat status;
    if (lstat(self->path, &status) == 0 && status.st_dev == self->device && status.st_ino == self->inode) {
        (void)unlink(self->path);
    }
}
