#define _GNU_SOURCE /* recvmmsg, sendmmsg */

/* The kernel's header calls its frame struct can_frame, as ours does. */
#define can_frame kernel_can_frame
#include <linux/can.h>
#include <linux/can/error.h>
#include <linux/can/raw.h>
#undef can_frame

#include <errno.h>
#include <net/if.h>
#include <net/if_arp.h>
#include <stddef.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "ports/linux/deadline_timer.h"
#include "ports/linux/kernel_stamp.h"
#include "ports/linux/link_driver.h"

enum {
    BATCH = 32,
    RECEIVE_BUFFER = 2 * 1024 * 1024, /* bytes; the kernel doubles it and books some 770 for a frame: 5000 frames */
    CONTROL_SIZE = 128,               /* bytes: stamp and count of lost frames */
    CLOCK_STEP_NS = 1000000,          /* more than this between two looks is no slewing */
    DELIVERY_NS = 1000000,            /* from a frame's stamp until it is in the receive queue, at most */
    NS_PER_S = 1000000000,
};

_Static_assert(sizeof(struct kernel_can_frame) == 16U, "the layout that the kernel reads and writes");
_Static_assert(CONTROL_SIZE >= CMSG_SPACE(sizeof(struct timespec)) + CMSG_SPACE(sizeof(uint32_t)), "both fit");

/* --- attach --- */

/* Index of an interface that is there, up and CAN. */
static int32_t find_interface(int fd, const char *name, int *index)
{
    struct ifreq request = {0};
    if (strlen(name) >= sizeof request.ifr_name) {
        return ENODEV;
    }
    memcpy(request.ifr_name, name, strlen(name));
    if (ioctl(fd, SIOCGIFINDEX, &request) != 0) {
        return errno;
    }
    *index = request.ifr_ifindex;
    if (ioctl(fd, SIOCGIFHWADDR, &request) != 0) {
        return errno;
    }
    if (request.ifr_hwaddr.sa_family != ARPHRD_CAN) {
        return ENODEV;
    }
    if (ioctl(fd, SIOCGIFFLAGS, &request) != 0) {
        return errno;
    }
    return (request.ifr_flags & IFF_UP) != 0 ? 0 : ENETDOWN;
}

/* The mask names the remote flag as well: such filters, on one identifier each, the kernel looks up by identifier
 * instead of walking through them for every frame. */
static int32_t set_filters(const can_link *self)
{
    struct can_filter filters[CAN_LINK_FILTERS_MAX];
    if (self->filter_count == CAN_LINK_EVERYTHING) {
        return 0; /* what a new socket does */
    }
    for (uint32_t i = 0U; i < self->filter_count; i++) {
        const bool extended = self->filters[i].extended != 0U;
        filters[i].can_id = self->filters[i].id | (extended ? CAN_EFF_FLAG : 0U);
        filters[i].can_mask = (extended ? CAN_EFF_MASK : CAN_SFF_MASK) | CAN_EFF_FLAG | CAN_RTR_FLAG;
    }
    const socklen_t size = (socklen_t)(self->filter_count * sizeof filters[0]);
    return setsockopt(self->fd, SOL_CAN_RAW, CAN_RAW_FILTER, size > 0U ? filters : NULL, size) == 0 ? 0 : errno;
}

static int32_t set_options(can_link *self)
{
    const int on = 1;
    const int size = RECEIVE_BUFFER;
    const can_err_mask_t errors = CAN_ERR_MASK;
    if (setsockopt(self->fd, SOL_SOCKET, SO_RCVBUFFORCE, &size, sizeof size) != 0) {
        (void)setsockopt(self->fd, SOL_SOCKET, SO_RCVBUF, &size, sizeof size); /* up to what the system allows */
    }
    (void)setsockopt(self->fd, SOL_SOCKET, SO_RXQ_OVFL, &on, sizeof on);
    self->stamps = setsockopt(self->fd, SOL_SOCKET, SO_TIMESTAMPNS, &on, sizeof on) == 0;
    if (setsockopt(self->fd, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) != 0) {
        return errno;
    }
    return set_filters(self);
}

/* The socket is kept while the interface is not there or down, to ask for it with. */
static int32_t attach(can_link *self, const char *interface)
{
    if (self->fd < 0) {
        self->fd = socket(PF_CAN, SOCK_RAW | SOCK_NONBLOCK | SOCK_CLOEXEC, CAN_RAW);
        if (self->fd < 0) {
            return errno;
        }
    }
    struct sockaddr_can address = {.can_family = AF_CAN};
    int32_t error = find_interface(self->fd, interface, &address.can_ifindex);
    if (error == 0) {
        error = set_options(self);
    }
    if (error != 0) {
        return error;
    }
    const clock_look look = look_at_clocks();
    self->earliest_ns = look.monotonic_ns;
    self->clock_offset_ns = look.offset_ns;
    self->kernel_drops = 0U;
    return bind(self->fd, (const struct sockaddr *)&address, sizeof address) == 0 ? 0 : errno;
}

/* --- receive --- */

/* Room for what the kernel tells of a batch. */
typedef struct batch {
    struct kernel_can_frame frames[BATCH];
    struct iovec parts[BATCH];
    struct mmsghdr messages[BATCH];
    _Alignas(struct cmsghdr) uint8_t control[BATCH][CONTROL_SIZE];
} batch;

static void prepare(batch *self)
{
    for (uint32_t i = 0U; i < BATCH; i++) {
        self->parts[i] = (struct iovec){.iov_base = &self->frames[i], .iov_len = sizeof self->frames[i]};
        self->messages[i].msg_hdr = (struct msghdr){
            .msg_iov = &self->parts[i],
            .msg_iovlen = 1,
            .msg_control = self->control[i],
            .msg_controllen = CONTROL_SIZE,
        };
    }
}

/* What the kernel says beside a frame. Returns its stamp, CLOCK_REALTIME in ns, or 0. */
static uint64_t read_control(can_link *self, struct msghdr *message)
{
    uint64_t stamp_ns = 0U;
    for (struct cmsghdr *item = CMSG_FIRSTHDR(message); item != NULL; item = CMSG_NXTHDR(message, item)) {
        if (item->cmsg_level == SOL_SOCKET && item->cmsg_type == SCM_TIMESTAMPNS) {
            struct timespec stamp;
            memcpy(&stamp, CMSG_DATA(item), sizeof stamp);
            stamp_ns = (uint64_t)stamp.tv_sec * NS_PER_S + (uint64_t)stamp.tv_nsec;
        } else if (item->cmsg_level == SOL_SOCKET && item->cmsg_type == SO_RXQ_OVFL) {
            uint32_t drops;
            memcpy(&drops, CMSG_DATA(item), sizeof drops);
            self->statistics.overflows += drops - self->kernel_drops; /* modulo 2^32 */
            self->kernel_drops = drops;
        }
    }
    return stamp_ns;
}

static can_frame convert(const can_link *self, const struct kernel_can_frame *raw, uint64_t time_ns)
{
    const bool error = (raw->can_id & CAN_ERR_FLAG) != 0U;
    const bool extended = (raw->can_id & CAN_EFF_FLAG) != 0U;
    const bool remote = (raw->can_id & CAN_RTR_FLAG) != 0U;
    can_frame frame = {
        .time_us = link_time_us(self, time_ns),
        .id = raw->can_id & (error      ? CAN_ERR_MASK
                             : extended ? CAN_EFF_MASK
                                        : CAN_SFF_MASK),
        .bus = self->bus,
        .dlc = raw->len <= CAN_DATA_MAX ? raw->len : (uint8_t)CAN_DATA_MAX,
        .flags = error ? (uint8_t)CAN_FLAG_ERROR
                       : (uint8_t)((extended ? CAN_FLAG_EXTENDED : 0) | (remote ? CAN_FLAG_REMOTE : 0)),
    };
    if (!remote || error) {
        memcpy(frame.data, raw->data, frame.dlc);
    }
    return frame;
}

/* The receive queue was empty after begin_ns: nothing older can follow, and a step of the wall clock is over. */
static void note_empty(can_link *self, uint64_t begin_ns, int64_t offset_ns)
{
    const int64_t change = offset_ns - self->clock_offset_ns;
    if (change > CLOCK_STEP_NS || change < -CLOCK_STEP_NS) {
        self->statistics.clock_steps++;
    }
    self->clock_offset_ns = offset_ns;
    if (begin_ns > self->earliest_ns + DELIVERY_NS) {
        self->earliest_ns = begin_ns - DELIVERY_NS;
    }
}

static int32_t receive(can_link *self, can_frame *frames, uint32_t capacity, uint32_t *count)
{
    batch in;
    prepare(&in);
    *count = 0U;
    while (*count < capacity) {
        const uint32_t room = capacity - *count < BATCH ? capacity - *count : BATCH;
        const uint64_t begin_ns = monotonic_ns();
        const int result = recvmmsg(self->fd, in.messages, room, MSG_DONTWAIT, NULL);
        const int32_t error = result < 0 ? errno : 0;
        if (error != 0 && error != EAGAIN && error != EWOULDBLOCK) {
            return error;
        }
        const uint32_t got = error == 0 ? (uint32_t)result : 0U;
        const clock_look look = look_at_clocks();
        for (uint32_t i = 0U; i < got; i++) {
            const uint64_t stamp_ns = read_control(self, &in.messages[i].msg_hdr);
            if (stamp_ns == 0U) {
                self->earliest_ns = look.monotonic_ns;
            } else {
                self->earliest_ns = kernel_stamp_to_monotonic(stamp_ns, look.offset_ns, self->clock_offset_ns,
                                                              self->earliest_ns, look.monotonic_ns);
            }
            frames[(*count)++] = convert(self, &in.frames[i], self->earliest_ns);
            in.messages[i].msg_hdr.msg_controllen = CONTROL_SIZE; /* the kernel shortened it */
        }
        if (got < room) {
            note_empty(self, begin_ns, look.offset_ns);
            break;
        }
    }
    return 0;
}

/* --- send --- */

static struct kernel_can_frame to_kernel(const can_frame *frame)
{
    const bool extended = (frame->flags & CAN_FLAG_EXTENDED) != 0U;
    const bool error = (frame->flags & CAN_FLAG_ERROR) != 0U;
    struct kernel_can_frame raw = {
        .can_id = (frame->id & (error      ? CAN_ERR_MASK
                                : extended ? CAN_EFF_MASK
                                           : CAN_SFF_MASK)) |
                  (extended ? CAN_EFF_FLAG : 0U) | ((frame->flags & CAN_FLAG_REMOTE) != 0U ? CAN_RTR_FLAG : 0U) |
                  (error ? CAN_ERR_FLAG : 0U),
        .len = frame->dlc <= CAN_DATA_MAX ? frame->dlc : (uint8_t)CAN_DATA_MAX,
    };
    memcpy(raw.data, frame->data, raw.len);
    return raw;
}

static int32_t send_frames(can_link *self, const can_frame *frames, uint32_t frame_count, uint32_t *count)
{
    struct kernel_can_frame raw[LINK_SEND_BATCH];
    struct iovec parts[LINK_SEND_BATCH];
    struct mmsghdr messages[LINK_SEND_BATCH] = {0};
    for (uint32_t i = 0U; i < frame_count; i++) {
        raw[i] = to_kernel(&frames[i]);
        parts[i] = (struct iovec){.iov_base = &raw[i], .iov_len = sizeof raw[i]};
        messages[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1};
    }
    *count = 0U;
    while (*count < frame_count) {
        /* It stops at the first frame that is not taken, and says why only when that is the first of all. */
        const int result = sendmmsg(self->fd, &messages[*count], frame_count - *count, MSG_DONTWAIT);
        if (result < 0) {
            return errno;
        }
        *count += (uint32_t)result;
    }
    return 0;
}

const link_driver socketcan_driver = {.scheme = "socketcan", .attach = attach, .receive = receive, .send = send_frames};
