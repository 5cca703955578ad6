/* raceloop-hub: the car's four CAN buses on a machine whose kernel has none.
 *
 *     raceloop-hub [--local PATH] [--port N]
 *
 * One thread forwards every frame at once to whoever is on its bus; nobody waits for anybody. Our own stations come
 * through the local socket, any socketcand client through TCP on 127.0.0.1.
 */
#define _GNU_SOURCE

#include <errno.h>
#include <getopt.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <unistd.h>

#include "hub.h"
#include "hub_log.h"
#include "hub_poll.h"
#include "local_server.h"
#include "ports/linux/deadline_timer.h"
#include "ports/linux/kernel_stamp.h"
#include "socketcand_server.h"

enum {
    EVENTS_MAX = 32,
    NS_PER_MS = 1000000,
    NS_PER_US = 1000,
    PORT_MAX = 65535,
    USAGE_ERROR = 2,
};

typedef struct options {
    const char *local; /* null: no local socket */
    int32_t port;      /* -1: no TCP */
} options;

typedef struct hub {
    int32_t epoll;
    bool stopping;
    clock_look look;           /* at this wake-up */
    int64_t earlier_offset_ns; /* of the look before it */
    hub_bus buses[CAN_BUS_COUNT];
    local_server local;
    socketcand_server socketcand;
    local_packet packet;
} hub;

static hub the_hub; /* too large for the stack */

static int32_t read_options(options *self, int count, char **arguments)
{
    static const struct option KNOWN[] = {
        {"local", required_argument, NULL, 'l'}, {"port", required_argument, NULL, 'p'}, {NULL, 0, NULL, 0}};
    *self = (options){.port = -1};
    opterr = 0;
    int found;
    while ((found = getopt_long(count, arguments, ":", KNOWN, NULL)) != -1) {
        if (found == 'l') {
            self->local = optarg;
        } else if (found == 'p') {
            char *end;
            errno = 0;
            const long port = strtol(optarg, &end, 10);
            if (errno != 0 || end == optarg || *end != '\0' || port < 0 || port > PORT_MAX) {
                hub_log("--port is '%s'; must be a whole number from 0 to %d", optarg, PORT_MAX);
                return USAGE_ERROR;
            }
            self->port = (int32_t)port;
        } else if (found == ':') {
            hub_log("%s needs a value", arguments[optind - 1]);
            return USAGE_ERROR;
        } else {
            hub_log("unknown option %s; there are --local PATH and --port N", arguments[optind - 1]);
            return USAGE_ERROR;
        }
    }
    if (optind < count) {
        hub_log("unknown argument %s; there are --local PATH and --port N", arguments[optind]);
        return USAGE_ERROR;
    }
    if (self->local == NULL && self->port < 0) {
        hub_log("nothing to listen on; give --local PATH, --port N or both");
        return USAGE_ERROR;
    }
    return 0;
}

static const char *local_error_text(int32_t error)
{
    switch (error) {
    case EADDRINUSE:
        return "a hub is alive there; stop it, or use another path";
    case EEXIST:
        return "there is a file that is no socket";
    case ENAMETOOLONG:
        return "the path is longer than a socket's may be";
    default:
        return strerror(error);
    }
}

static int32_t watch_signals(int32_t epoll)
{
    sigset_t signals;
    (void)sigemptyset(&signals);
    (void)sigaddset(&signals, SIGINT);
    (void)sigaddset(&signals, SIGTERM);
    (void)sigprocmask(SIG_BLOCK, &signals, NULL);
    const int32_t fd = signalfd(-1, &signals, SFD_NONBLOCK | SFD_CLOEXEC);
    return fd < 0 ? errno : hub_watch(epoll, fd, EPOLLIN, HUB_SOURCE_SIGNAL, 0);
}

static int32_t open_doors(hub *self, const options *chosen)
{
    if (chosen->local != NULL) {
        const int32_t error = local_server_open(&self->local, chosen->local);
        if (error != 0) {
            hub_log("--local %s: %s", chosen->local, local_error_text(error));
            return USAGE_ERROR;
        }
    }
    if (chosen->port >= 0) {
        const int32_t error = socketcand_server_open(&self->socketcand, (uint16_t)chosen->port);
        if (error != 0) {
            hub_log("--port %d: %s", chosen->port, error == EADDRINUSE ? "the port is in use" : strerror(error));
            return USAGE_ERROR;
        }
    }
    return 0;
}

static void say_ready(const hub *self)
{
    (void)printf("raceloop-hub: ");
    if (self->local.listener >= 0) {
        (void)printf("local %s%s", self->local.path, self->socketcand.listener >= 0 ? ", " : "");
    }
    if (self->socketcand.listener >= 0) {
        (void)printf("socketcand 127.0.0.1:%u", self->socketcand.port);
    }
    (void)printf("\n");
    (void)fflush(stdout);
}

/* Put frames on their bus and before everybody but their sender. Returns how many no bus carries. */
static uint32_t forward(hub *self, uint8_t bus, uint64_t stamp_ns, const can_frame *frames, uint32_t count,
                        uint32_t local_sender, uint32_t socketcand_sender)
{
    can_frame on_bus[HUB_BATCH_MAX];
    const uint32_t carried = hub_carry(&self->buses[bus], bus, stamp_ns, frames, count, on_bus);
    if (carried > 0) {
        local_server_deliver(&self->local, bus, local_sender, on_bus, carried);
        socketcand_server_deliver(&self->socketcand, bus, socketcand_sender, on_bus, carried,
                                  self->look.offset_ns / NS_PER_US);
    }
    return count - carried;
}

static void serve_station(hub *self, uint32_t place)
{
    local_packet *packet = &self->packet;
    local_server_read(&self->local, place, packet);
    if (packet->count == 0) {
        return;
    }
    uint64_t stamp_ns = monotonic_ns();
    if (packet->stamp_ns != 0) {
        stamp_ns = kernel_stamp_to_monotonic(packet->stamp_ns, self->look.offset_ns, self->earlier_offset_ns,
                                             self->buses[packet->bus].newest_ns, stamp_ns);
    }
    const uint32_t refused =
        forward(self, packet->bus, stamp_ns, packet->frames, packet->count, place, SOCKETCAND_CLIENTS_MAX);
    if (refused > 0) {
        local_server_refuse(&self->local, place, refused);
    }
}

static void serve_client(hub *self, uint32_t place)
{
    can_frame frames[SOCKETCAND_BATCH_MAX];
    uint32_t count;
    socketcand_server_flush(&self->socketcand, place);
    socketcand_server_read(&self->socketcand, place);
    while ((count = socketcand_server_next(&self->socketcand, place, self->look.monotonic_ns, frames)) > 0) {
        (void)forward(self, frames[0].bus, self->look.monotonic_ns, frames, count, LOCAL_STATIONS_MAX, place);
    }
}

static void serve(hub *self, uint64_t event)
{
    switch (hub_source_of(event)) {
    case HUB_SOURCE_LOCAL_STATION:
        serve_station(self, hub_place_of(event));
        break;
    case HUB_SOURCE_TCP_CLIENT:
        serve_client(self, hub_place_of(event));
        break;
    case HUB_SOURCE_LOCAL_LISTENER:
        local_server_accept(&self->local);
        break;
    case HUB_SOURCE_TCP_LISTENER:
        socketcand_server_accept(&self->socketcand);
        break;
    default:
        self->stopping = true;
        break;
    }
}

static void run(hub *self)
{
    while (!self->stopping) {
        const uint64_t wait_ns = socketcand_server_release(&self->socketcand, monotonic_ns());
        const int timeout_ms = wait_ns == UINT64_MAX ? -1 : (int)(wait_ns / NS_PER_MS) + 1;
        struct epoll_event events[EVENTS_MAX];
        const int count = epoll_wait(self->epoll, events, EVENTS_MAX, timeout_ms);
        self->earlier_offset_ns = self->look.offset_ns;
        self->look = look_at_clocks();
        for (int i = 0; i < count; i++) {
            serve(self, events[i].data.u64);
        }
    }
}

int main(int count, char **arguments)
{
    options chosen;
    const int32_t mistake = read_options(&chosen, count, arguments);
    if (mistake != 0) {
        return mistake;
    }
    hub *self = &the_hub;
    (void)signal(SIGPIPE, SIG_IGN); /* who no longer reads our lines does not end the buses */
    (void)umask(S_IRWXG | S_IRWXO); /* the local socket is the user's own */
    self->epoll = epoll_create1(EPOLL_CLOEXEC);
    const int32_t error = self->epoll < 0 ? errno : watch_signals(self->epoll);
    if (error != 0) {
        hub_log("cannot wait for events: %s", strerror(error));
        return USAGE_ERROR;
    }
    local_server_init(&self->local, self->epoll);
    socketcand_server_init(&self->socketcand, self->epoll);
    self->look = look_at_clocks();
    const int32_t status = open_doors(self, &chosen);
    if (status == 0) {
        say_ready(self);
        run(self);
    }
    local_server_close(&self->local);
    socketcand_server_close(&self->socketcand);
    return status;
}
