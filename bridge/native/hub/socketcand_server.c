#define _GNU_SOURCE

#include "socketcand_server.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

#include "hub_poll.h"
#include "ports/linux/ecu_options.h"
#include "ports/linux/process_log.h"
#include "socketcand_text.h"

enum {
    BACKLOG = 16,
    SEND_BUFFER_BYTES = 1 << 18,
    /* python-can takes the answer to rawmode from one read and refuses anything behind it, so a busy bus must keep
     * quiet until the client has read; one that says something more has. */
    QUIET_NS = 200000000,
    COMPLAINT_MAX = 160,
    ERROR_CONTROLLER = 4, /* error class as SocketCAN numbers it: trouble of the controller, here receive overflow */
};

static uint32_t bit(uint32_t place)
{
    return UINT32_C(1) << place;
}

void socketcand_server_init(socketcand_server *self, int32_t epoll)
{
    memset(self, 0, sizeof *self);
    self->epoll = epoll;
    self->listener = -1;
    for (uint32_t place = 0; place < SOCKETCAND_CLIENTS_MAX; place++) {
        self->clients[place].fd = -1;
    }
}

int32_t socketcand_server_open(socketcand_server *self, uint16_t port)
{
    const int32_t listener = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (listener < 0) {
        return errno;
    }
    self->listener = listener;
    const int on = 1; /* connections of the hub before that are still closing are no hindrance */
    struct sockaddr_in address = {
        .sin_family = AF_INET, .sin_port = htons(port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    socklen_t size = sizeof address;
    int32_t error = 0;
    if (setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on) != 0 ||
        bind(listener, (const struct sockaddr *)&address, sizeof address) != 0 || listen(listener, BACKLOG) != 0 ||
        getsockname(listener, (struct sockaddr *)&address, &size) != 0) {
        error = errno;
    } else {
        error = hub_watch(self->epoll, listener, EPOLLIN, HUB_SOURCE_TCP_LISTENER, 0);
    }
    self->port = ntohs(address.sin_port);
    if (error != 0) {
        socketcand_server_close(self);
    }
    return error;
}

static void watch_client(const socketcand_server *self, uint32_t place)
{
    const socketcand_client *client = &self->clients[place];
    const uint32_t events = EPOLLIN | (client->waits_for_room ? (uint32_t)EPOLLOUT : 0U);
    (void)hub_watch_again(self->epoll, client->fd, events, HUB_SOURCE_TCP_CLIENT, place); /* it is in the set */
}

static void end_quiet(socketcand_server *self, uint32_t place)
{
    if (self->clients[place].quiet_end_ns != 0) {
        self->clients[place].quiet_end_ns = 0;
        self->quiet_count--;
    }
}

static void forget(socketcand_server *self, uint32_t place)
{
    socketcand_client *client = &self->clients[place];
    if (client->lost > 0) {
        process_log("socketcand client 127.0.0.1:%u on %s lost %llu frames: it read too slowly", client->port,
                    ecu_bus_name(client->bus), (unsigned long long)client->lost);
    }
    end_quiet(self, place);
    self->members[client->bus] &= ~bit(place);
    (void)close(client->fd);
    client->fd = -1;
}

void socketcand_server_flush(socketcand_server *self, uint32_t place)
{
    socketcand_client *client = &self->clients[place];
    if (client->fd < 0) {
        return;
    }
    if (client->quiet_end_ns == 0 && client->out_start < client->out_end) {
        const ssize_t sent = send(client->fd, &client->out[client->out_start], client->out_end - client->out_start,
                                  MSG_DONTWAIT | MSG_NOSIGNAL);
        if (sent > 0) {
            client->out_start += (uint32_t)sent;
        } else if (errno != EAGAIN && errno != EINTR) {
            client->out_start = client->out_end; /* gone; its event says so */
        }
        if (client->out_start == client->out_end) {
            client->out_start = 0;
            client->out_end = 0;
        }
    }
    const bool waits = client->quiet_end_ns == 0 && client->out_start < client->out_end;
    if (waits != client->waits_for_room) {
        client->waits_for_room = waits;
        watch_client(self, place);
    }
}

/* Append to what waits for the client. False: no room. */
static bool append(socketcand_client *client, const char *text, uint32_t length)
{
    if (SOCKETCAND_OUT_MAX - client->out_end < length && client->out_start > 0) {
        client->out_end -= client->out_start;
        memmove(client->out, &client->out[client->out_start], client->out_end);
        client->out_start = 0;
    }
    if (SOCKETCAND_OUT_MAX - client->out_end < length) {
        return false;
    }
    memcpy(&client->out[client->out_end], text, length);
    client->out_end += length;
    return true;
}

static void answer(socketcand_server *self, uint32_t place, const char *text)
{
    socketcand_client *client = &self->clients[place];
    if (append(client, text, (uint32_t)strlen(text))) {
        socketcand_server_flush(self, place);
    } else {
        process_log("socketcand client 127.0.0.1:%u sent away: it does not read its answers", client->port);
        forget(self, place);
    }
}

static void complain(socketcand_server *self, uint32_t place, const char *problem)
{
    socketcand_client *client = &self->clients[place];
    char text[COMPLAINT_MAX];
    (void)snprintf(text, sizeof text, "< error %s >", problem);
    if (!client->complained) {
        client->complained = true;
        process_log("socketcand client 127.0.0.1:%u: %s", client->port, problem);
    }
    answer(self, place, text);
}

void socketcand_server_accept(socketcand_server *self)
{
    struct sockaddr_in peer = {0};
    socklen_t size = sizeof peer;
    const int32_t fd = accept4(self->listener, (struct sockaddr *)&peer, &size, SOCK_NONBLOCK | SOCK_CLOEXEC);
    if (fd < 0) {
        return; /* gone again */
    }
    uint32_t place = 0;
    while (place < SOCKETCAND_CLIENTS_MAX && self->clients[place].fd >= 0) {
        place++;
    }
    const int on = 1;
    const int bytes = SEND_BUFFER_BYTES;
    (void)setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    (void)setsockopt(fd, SOL_SOCKET, SO_SNDBUF, &bytes, sizeof bytes);
    if (place == SOCKETCAND_CLIENTS_MAX || hub_watch(self->epoll, fd, EPOLLIN, HUB_SOURCE_TCP_CLIENT, place) != 0) {
        static const char FULL[] = "< error no place is free >";
        process_log("socketcand client 127.0.0.1:%u refused: %d are connected already", ntohs(peer.sin_port),
                    SOCKETCAND_CLIENTS_MAX);
        (void)send(fd, FULL, sizeof FULL - 1U, MSG_DONTWAIT | MSG_NOSIGNAL);
        (void)close(fd);
        return;
    }
    socketcand_client *client = &self->clients[place];
    memset(client, 0, sizeof *client);
    client->fd = fd;
    client->port = ntohs(peer.sin_port);
    answer(self, place, "< hi >");
}

void socketcand_server_read(socketcand_server *self, uint32_t place)
{
    socketcand_client *client = &self->clients[place];
    if (client->fd < 0) {
        return; /* sent away since the event was reported */
    }
    const ssize_t size =
        recv(client->fd, &client->in[client->in_count], SOCKETCAND_IN_MAX - client->in_count, MSG_DONTWAIT);
    if (size > 0) {
        client->in_count += (uint32_t)size;
    } else if (size == 0 || (errno != EAGAIN && errno != EINTR)) {
        forget(self, place);
    }
}

static void open_channel(socketcand_server *self, uint32_t place, uint8_t bus)
{
    socketcand_client *client = &self->clients[place];
    if (client->state != SOCKETCAND_GREETED) {
        complain(self, place, "a channel is open already");
        return;
    }
    client->state = SOCKETCAND_ON_BUS;
    client->bus = bus;
    answer(self, place, "< ok >");
}

static void enter_raw_mode(socketcand_server *self, uint32_t place, uint64_t now_ns)
{
    socketcand_client *client = &self->clients[place];
    if (client->state == SOCKETCAND_GREETED) {
        complain(self, place, "open a channel first");
        return;
    }
    answer(self, place, "< ok >");
    if (client->fd >= 0 && client->state == SOCKETCAND_ON_BUS) {
        client->state = SOCKETCAND_RAW;
        client->quiet_end_ns = now_ns + QUIET_NS;
        self->quiet_count++;
        self->members[client->bus] |= bit(place);
    }
}

static void obey(socketcand_server *self, uint32_t place, const socketcand_request *request, uint64_t now_ns)
{
    switch (request->kind) {
    case SOCKETCAND_OPEN:
        open_channel(self, place, request->bus);
        break;
    case SOCKETCAND_RAWMODE:
        enter_raw_mode(self, place, now_ns);
        break;
    case SOCKETCAND_ECHO:
        answer(self, place, "< echo >");
        break;
    case SOCKETCAND_UNKNOWN_CHANNEL:
        complain(self, place, "no such channel: there are CAN1 CAN3 CANA CANS CANR, also as vcan0 to vcan4");
        break;
    case SOCKETCAND_OTHER_MODE:
        complain(self, place, "there is only rawmode here");
        break;
    case SOCKETCAND_SEND:
        complain(self, place, "send needs rawmode first");
        break;
    case SOCKETCAND_BAD_SEND:
        complain(self, place, "send takes an identifier of 3 or 8 digits, a length of 0 to 8 and as many bytes");
        break;
    case SOCKETCAND_GARBAGE:
        complain(self, place, "this is not the socketcand protocol");
        if (self->clients[place].fd >= 0) {
            forget(self, place);
        }
        break;
    default:
        complain(self, place, "unknown request: there are open, rawmode, send, echo");
        break;
    }
}

uint32_t socketcand_server_next(socketcand_server *self, uint32_t place, uint64_t now_ns, can_frame *frames)
{
    socketcand_client *client = &self->clients[place];
    uint32_t taken = 0;
    uint32_t count = 0;
    while (client->fd >= 0 && count < SOCKETCAND_BATCH_MAX) {
        socketcand_request request;
        taken += socketcand_read(&client->in[taken], client->in_count - taken, &request);
        if (request.kind == SOCKETCAND_INCOMPLETE) {
            break;
        }
        if (client->quiet_end_ns != 0) {
            end_quiet(self, place);
            socketcand_server_flush(self, place);
        }
        if (request.kind == SOCKETCAND_SEND && client->state == SOCKETCAND_RAW) {
            frames[count] = request.frame;
            frames[count].bus = client->bus;
            count++;
        } else {
            obey(self, place, &request, now_ns);
        }
    }
    client->in_count -= taken;
    memmove(client->in, &client->in[taken], client->in_count);
    return count;
}

/* Append a frame, and before it what became of those that did not fit. */
static void deliver_one(socketcand_client *client, const char *text, uint32_t length, uint64_t wall_us)
{
    if (client->untold > 0) {
        const can_frame overflow = {.id = ERROR_CONTROLLER, .flags = CAN_FLAG_ERROR};
        char notice[SOCKETCAND_FRAME_MAX];
        if (append(client, notice, socketcand_write(notice, &overflow, wall_us))) {
            client->untold = 0;
        }
    }
    if (client->untold > 0 || !append(client, text, length)) {
        if (client->lost == 0) {
            process_log("socketcand client 127.0.0.1:%u on %s reads too slowly: it loses frames", client->port,
                        ecu_bus_name(client->bus));
        }
        client->lost++;
        client->untold++;
    }
}

void socketcand_server_deliver(socketcand_server *self, uint8_t bus, uint32_t except, const can_frame *frames,
                               uint32_t count, int64_t offset_us)
{
    uint32_t members = self->members[bus];
    if (except < SOCKETCAND_CLIENTS_MAX) {
        members &= ~bit(except);
    }
    if (members == 0) {
        return;
    }
    for (uint32_t i = 0; i < count; i++) {
        char text[SOCKETCAND_FRAME_MAX];
        const uint64_t wall_us = (uint64_t)((int64_t)frames[i].time_us + offset_us);
        const uint32_t length = socketcand_write(text, &frames[i], wall_us);
        if (length == 0) {
            continue; /* a remote frame, for which there is no text */
        }
        for (uint32_t rest = members; rest != 0; rest &= rest - 1U) {
            deliver_one(&self->clients[__builtin_ctz(rest)], text, length, wall_us);
        }
    }
    for (uint32_t rest = members; rest != 0; rest &= rest - 1U) {
        socketcand_server_flush(self, (uint32_t)__builtin_ctz(rest));
    }
}

uint64_t socketcand_server_release(socketcand_server *self, uint64_t now_ns)
{
    uint64_t next_ns = UINT64_MAX;
    for (uint32_t place = 0; place < SOCKETCAND_CLIENTS_MAX && self->quiet_count > 0; place++) {
        const uint64_t end_ns = self->clients[place].quiet_end_ns;
        if (end_ns == 0) {
            continue;
        }
        if (end_ns <= now_ns) {
            end_quiet(self, place);
            socketcand_server_flush(self, place);
        } else if (end_ns - now_ns < next_ns) {
            next_ns = end_ns - now_ns;
        }
    }
    return next_ns;
}

void socketcand_server_close(socketcand_server *self)
{
    for (uint32_t place = 0; place < SOCKETCAND_CLIENTS_MAX; place++) {
        if (self->clients[place].fd >= 0) {
            forget(self, place);
        }
    }
    if (self->listener >= 0) {
        (void)close(self->listener);
        self->listener = -1;
    }
}
