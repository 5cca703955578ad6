#define _POSIX_C_SOURCE 200809L

#include "ports/linux/can_link.h"

#include <errno.h>
#include <poll.h>
#include <stddef.h>
#include <string.h>
#include <unistd.h>

#include "ports/linux/deadline_timer.h"
#include "ports/linux/link_driver.h"

#define RETRY_NS   (CAN_LINK_RETRY_MS * 1000000ULL)
#define WELCOME_NS 1000000000ULL /* the other side must have answered by then */

static const link_driver *const drivers[] = {
    [CAN_LINK_SOCKETCAN] = &socketcan_driver,
    [CAN_LINK_HUB] = &hub_driver,
};

/* Kind and place of an address. Returns enum can_link_kind, or 0 when it is none. */
static uint8_t parse(const char *address, const char **place)
{
    for (uint8_t kind = CAN_LINK_SOCKETCAN; kind <= CAN_LINK_HUB; kind++) {
        const size_t length = strlen(drivers[kind]->scheme);
        if (strncmp(address, drivers[kind]->scheme, length) == 0 && address[length] == ':' &&
            address[length + 1U] != '\0') {
            *place = &address[length + 1U];
            return kind;
        }
    }
    return 0U;
}

static void drop(can_link *self)
{
    if (self->fd >= 0) {
        (void)close(self->fd);
    }
    self->fd = -1;
}

/* The attachment is lost. The next attempt may follow at once: it may have been a short one. */
static void go_down(can_link *self, int32_t error)
{
    drop(self);
    self->state = CAN_LINK_DOWN;
    self->last_error = error;
    self->retry_ns = 0U;
    self->statistics.outages++;
}

/* One step towards being attached. Returns as link_driver.attach. */
static int32_t attach(can_link *self)
{
    const char *place = NULL;
    const link_driver *driver = drivers[parse(self->address, &place)];
    const int32_t error = driver->attach(self, place);
    self->attaching = error == EINPROGRESS;
    if (error == 0) {
        self->state = CAN_LINK_UP;
    }
    return error;
}

/* Try to come up again, if it is time to. */
static void retry(can_link *self)
{
    const uint64_t now_ns = monotonic_ns();
    const bool due = now_ns >= self->retry_ns;
    if (!due && !self->attaching) {
        return;
    }
    if (due) {
        if (self->attaching) {
            drop(self); /* no answer: from the start */
        }
        self->retry_ns = now_ns + WELCOME_NS;
    }
    const int32_t error = attach(self);
    if (error != 0 && error != EINPROGRESS) {
        self->last_error = error;
        self->retry_ns = now_ns + RETRY_NS;
    }
}

/* True when the link is up, or has just come up again. */
static bool available(can_link *self)
{
    if (self->state == CAN_LINK_DOWN) {
        retry(self);
    }
    return self->state == CAN_LINK_UP;
}

int32_t can_link_open(can_link *self, const char *address, uint8_t bus, uint64_t epoch_ns,
                      const can_link_filter *filters, uint32_t filter_count)
{
    const char *place = NULL;
    const uint8_t kind = parse(address, &place);
    const bool filtered = filter_count != CAN_LINK_EVERYTHING;
    if (kind == 0U || strlen(address) >= sizeof self->address || bus >= CAN_BUS_COUNT ||
        (filtered && filter_count > CAN_LINK_FILTERS_MAX)) {
        return EINVAL;
    }
    *self = (can_link){.fd = -1, .kind = kind, .bus = bus, .epoch_ns = epoch_ns, .filter_count = filter_count};
    memcpy(self->address, address, strlen(address) + 1U);
    if (filtered && filter_count > 0U) {
        memcpy(self->filters, filters, filter_count * sizeof filters[0]);
    }

    const uint64_t limit_ns = monotonic_ns() + WELCOME_NS;
    int32_t error = attach(self);
    for (uint64_t now_ns = monotonic_ns(); error == EINPROGRESS && now_ns < limit_ns; now_ns = monotonic_ns()) {
        struct pollfd answer = {.fd = self->fd, .events = POLLIN};
        (void)poll(&answer, 1, (int)((limit_ns - now_ns) / 1000000U) + 1);
        error = attach(self);
    }
    if (error != 0) {
        drop(self);
        self->attaching = false;
        self->last_error = error == EINPROGRESS ? ETIMEDOUT : error;
    }
    return self->last_error;
}

uint32_t can_link_receive(can_link *self, can_frame *frames, uint32_t capacity)
{
    if (!available(self)) {
        return 0U;
    }
    uint32_t count = 0U;
    const int32_t error = drivers[self->kind]->receive(self, frames, capacity, &count);
    for (uint32_t i = 0U; i < count; i++) {
        self->statistics.error_frames += (frames[i].flags & CAN_FLAG_ERROR) != 0U ? 1U : 0U;
    }
    self->statistics.received += count;
    if (error != 0) {
        go_down(self, error);
    }
    return count;
}

/* There is no room now; the attachment is sound. */
static bool no_room(int32_t error)
{
    return error == EAGAIN || error == EWOULDBLOCK || error == ENOBUFS || error == ENOMEM || error == EBUSY;
}

/* Send a batch of this bus. Returns how many frames were taken. */
static uint32_t send_batch(can_link *self, const can_frame *frames, uint32_t count)
{
    uint32_t taken = 0U;
    if (available(self)) {
        const int32_t error = drivers[self->kind]->send(self, frames, count, &taken);
        if (no_room(error)) {
            self->last_error = error;
            self->statistics.refused += count - taken;
        } else if (error != 0) {
            go_down(self, error);
        }
    }
    if (self->state != CAN_LINK_UP) {
        self->statistics.undelivered += count - taken;
    }
    self->statistics.sent += taken;
    return taken;
}

uint32_t can_link_send(can_link *self, const can_frame *frames, uint32_t count)
{
    if (self->state == CAN_LINK_CLOSED) {
        return 0U;
    }
    can_frame batch[LINK_SEND_BATCH];
    uint32_t size = 0U;
    uint32_t taken = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        if (frames[i].bus == self->bus) {
            batch[size++] = frames[i];
        }
        if (size == LINK_SEND_BATCH) {
            taken += send_batch(self, batch, size);
            size = 0U;
        }
    }
    return size == 0U ? taken : taken + send_batch(self, batch, size);
}

void can_link_close(can_link *self)
{
    if (self->state != CAN_LINK_CLOSED) { /* the fd of a zeroed link is somebody else's */
        drop(self);
        self->state = CAN_LINK_CLOSED;
    }
}

uint64_t link_time_us(const can_link *self, uint64_t monotonic_time_ns)
{
    return monotonic_time_ns > self->epoch_ns ? (monotonic_time_ns - self->epoch_ns) / 1000U : 0U;
}

const char *can_link_error_text(int32_t error)
{
    switch (error) {
    case EINVAL:
        return "not an address of a bus: give socketcan:INTERFACE or hub:PATH";
    case ENODEV:
    case ENXIO:
        return "no such CAN interface: ip link add dev INTERFACE type vcan makes one";
    case ENETDOWN:
        return "the interface is down: ip link set INTERFACE up";
    case EAFNOSUPPORT:
        return "this kernel has no CAN: use the hub instead";
    case ENOENT:
    case ECONNREFUSED:
        return "no hub there: raceloop hub starts one";
    case EPROTO:
        return "this is not a hub of this version";
    case EUSERS:
        return "the hub has no free place";
    case ETIMEDOUT:
        return "the hub does not answer";
    case EPIPE:
    case ECONNRESET:
        return "the hub has hung up";
    case ENOBUFS:
    case EAGAIN:
        return "the send queue is full";
    default:
        return strerror(error);
    }
}
