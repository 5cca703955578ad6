#define _POSIX_C_SOURCE 200809L

#include <errno.h>
#include <stddef.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "ports/linux/hub_wire.h"
#include "ports/linux/link_driver.h"

_Static_assert(sizeof(can_frame) == CAN_FRAME_SIZE, "frames travel as they are");
_Static_assert(sizeof(hub_loss) % CAN_FRAME_SIZE != 0, "told from frames by its length");

/* --- attach --- */

static int32_t say_hello(const can_link *self)
{
    hub_hello hello = {
        .magic = HUB_MAGIC, .version = HUB_VERSION, .bus = self->bus, .filter_count = self->filter_count};
    size_t size = offsetof(hub_hello, filters);
    if (self->filter_count != CAN_LINK_EVERYTHING) {
        memcpy(hello.filters, self->filters, self->filter_count * sizeof self->filters[0]);
        size += self->filter_count * sizeof self->filters[0];
    }
    return send(self->fd, &hello, size, MSG_DONTWAIT | MSG_NOSIGNAL) >= 0 ? 0 : errno;
}

static int32_t join(can_link *self, const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (strlen(path) >= sizeof address.sun_path) {
        return EINVAL;
    }
    memcpy(address.sun_path, path, strlen(path));
    self->fd = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (self->fd < 0) {
        return errno;
    }
    /* A local socket is connected at once, or refused with EAGAIN when the hub has too many to accept. */
    if (connect(self->fd, (const struct sockaddr *)&address, sizeof address) != 0) {
        return errno;
    }
    return say_hello(self);
}

/* Read the hub's answer. Returns as link_driver.attach. */
static int32_t read_welcome(const can_link *self)
{
    hub_welcome welcome = {0};
    const ssize_t size = recv(self->fd, &welcome, sizeof welcome, MSG_DONTWAIT);
    if (size < 0) {
        return errno == EAGAIN || errno == EWOULDBLOCK ? EINPROGRESS : errno;
    }
    if (size == 0) {
        return ECONNRESET;
    }
    if ((size_t)size != sizeof welcome || welcome.magic != HUB_MAGIC || welcome.version != HUB_VERSION) {
        return EPROTO;
    }
    return welcome.error;
}

static int32_t attach(can_link *self, const char *path)
{
    int32_t error = self->fd < 0 ? join(self, path) : 0;
    if (error == 0) {
        error = read_welcome(self);
    }
    if (error != 0 && error != EINPROGRESS && self->fd >= 0) {
        (void)close(self->fd);
        self->fd = -1;
    }
    self->stamps = error == 0;
    return error;
}

/* --- receive and send --- */

/* What a frame is to its station: the hub's clock counts since boot, and a filter is for data frames. Returns false for
 * a frame that is not wanted. */
static bool take_over(const can_link *self, can_frame *frame)
{
    if (self->filter_count != CAN_LINK_EVERYTHING && (frame->flags & CAN_FLAG_REMOTE) != 0U) {
        return false;
    }
    frame->time_us = link_time_us(self, frame->time_us * 1000U);
    frame->bus = self->bus;
    frame->dlc = frame->dlc <= CAN_DATA_MAX ? frame->dlc : (uint8_t)CAN_DATA_MAX;
    frame->sender = CAN_STATION_NONE;
    return true;
}

static int32_t receive(can_link *self, can_frame *frames, uint32_t capacity, uint32_t *count)
{
    *count = 0U;
    for (uint32_t packets = 0U; packets < capacity && capacity - *count >= HUB_BATCH_MAX; packets++) {
        can_frame *packet = &frames[*count];
        const ssize_t size = recv(self->fd, packet, HUB_BATCH_MAX * sizeof *packet, MSG_DONTWAIT);
        if (size < 0) {
            return errno == EAGAIN || errno == EWOULDBLOCK ? 0 : errno;
        }
        if (size == 0) {
            return ECONNRESET;
        }
        hub_loss loss;
        memcpy(&loss, packet, sizeof loss);
        if ((size_t)size == sizeof loss && loss.magic == HUB_MAGIC) {
            self->statistics.overflows += loss.frames;
            continue;
        }
        if ((size_t)size % sizeof *packet != 0U) {
            return EPROTO;
        }
        for (size_t i = 0U; i < (size_t)size / sizeof *packet; i++) {
            can_frame frame = packet[i];
            if (take_over(self, &frame)) {
                frames[(*count)++] = frame;
            }
        }
    }
    return 0;
}

static int32_t send_frames(can_link *self, const can_frame *frames, uint32_t frame_count, uint32_t *count)
{
    const size_t size = frame_count * sizeof frames[0];
    const bool taken = send(self->fd, frames, size, MSG_DONTWAIT | MSG_NOSIGNAL) >= 0;
    *count = taken ? frame_count : 0U;
    return taken ? 0 : errno;
}

const link_driver hub_driver = {.scheme = "hub", .attach = attach, .receive = receive, .send = send_frames};
