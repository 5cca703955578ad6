/* raceloop-hub: the car's CAN buses on a machine whose kernel has none.
 *
 * One thread forwards every frame at once to whoever is on its bus; nobody waits for anybody. Our own stations come
 * through the local socket, any socketcand client through TCP on 127.0.0.1.
 */
#define _GNU_SOURCE

#include <errno.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/signalfd.h>
#include <sys/stat.h>
#include <unistd.h>

#include "hub.h"
#include "hub_options.h"
#include "hub_poll.h"
#include "local_server.h"
#include "ports/linux/deadline_timer.h"
#include "ports/linux/kernel_stamp.h"
#include "ports/linux/process_log.h"
#include "ports/linux/realtime.h"
#include "socketcand_server.h"

enum {
    EVENTS_MAX = 32,
    NS_PER_MS = 1000000,
    NS_PER_US = 1000,
    EXIT_MISTAKE = 2,
};

typedef struct hub {
    int32_t epoll;
    bool stopping;
    clock_look look;           /* at this wake-up */
    int64_t earlier_offset_ns; /* of the look before it */
    int64_t wall_offset_us;    /* for stamps on the wall clock */
    hub_bus buses[CAN_BUS_COUNT];
    local_server local;
    socketcand_server socketcand;
    local_packet packet;
} hub;

static hub the_hub; /* too large for the stack */

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

static int32_t open_doors(hub *self, const hub_options *chosen)
{
    if (chosen->local != NULL) {
        const int32_t error = local_server_open(&self->local, chosen->local);
        if (error != 0) {
            process_log("--local %s: %s", chosen->local, local_error_text(error));
            return EXIT_MISTAKE;
        }
    }
    if (chosen->port >= 0) {
        const int32_t error = socketcand_server_open(&self->socketcand, (uint16_t)chosen->port);
        if (error != 0) {
            process_log("--port %d: %s", chosen->port, error == EADDRINUSE ? "the port is in use" : strerror(error));
            return EXIT_MISTAKE;
        }
    }
    return 0;
}

static void close_doors(hub *self)
{
    local_server_close(&self->local);
    socketcand_server_close(&self->socketcand);
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
        socketcand_server_deliver(&self->socketcand, bus, socketcand_sender, on_bus, carried, self->wall_offset_us);
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
        self->wall_offset_us = hub_wall_offset_us(self->wall_offset_us, self->look.offset_ns / NS_PER_US);
        for (int i = 0; i < count; i++) {
            serve(self, events[i].data.u64);
        }
    }
}

/* Everything before the first frame. Returns 0 or an exit status, after a line that says why. */
static int32_t set_up(hub *self, const hub_options *options)
{
    char text[REALTIME_TEXT_MAX];
    if (options->with_parent) {
        realtime_end_with_parent();
    }
    if (realtime_schedule(options->priority, options->cpu, text) != 0) {
        process_log("%s", text);
        return EXIT_MISTAKE;
    }
    self->epoll = epoll_create1(EPOLL_CLOEXEC);
    const int32_t error = self->epoll < 0 ? errno : watch_signals(self->epoll);
    if (error != 0) {
        process_log("cannot wait for events: %s", strerror(error));
        return EXIT_MISTAKE;
    }
    local_server_init(&self->local, self->epoll);
    socketcand_server_init(&self->socketcand, self->epoll);
    self->look = look_at_clocks();
    int32_t status = open_doors(self, options);
    if (status == 0 && options->priority > 0 && realtime_lock_memory(text) != 0) {
        process_log("%s", text);
        status = EXIT_MISTAKE;
    }
    if (status != 0) {
        close_doors(self);
    }
    return status;
}

int main(int count, char **arguments)
{
    hub_options options;
    char mistake[HUB_MISTAKE_MAX];
    if (hub_options_parse(&options, count, arguments, mistake) != 0) {
        process_log("%s", mistake);
        return EXIT_MISTAKE;
    }
    if (options.help) {
        (void)printf("usage: raceloop-hub OPTION...\n%s", hub_options_help());
        return 0;
    }
    (void)signal(SIGPIPE, SIG_IGN); /* who no longer reads our lines does not end the buses */
    (void)umask(S_IRWXG | S_IRWXO); /* the local socket is the user's own */
    hub *self = &the_hub;
    const int32_t status = set_up(self, &options);
    if (status == 0) {
        say_ready(self);
        run(self);
        close_doors(self);
    }
    return status;
}
