#define _GNU_SOURCE /* sched_getcpu */

#include "ports/linux/ecu_process.h"

#include <errno.h>
#include <inttypes.h>
#include <sched.h>
#include <signal.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#include "ports/linux/cycle_log.h"
#include "ports/linux/deadline_timer.h"
#include "ports/linux/ecu_bus.h"
#include "ports/linux/process_log.h"
#include "ports/linux/realtime.h"
#include "ports/linux/wired_io.h"

enum {
    OUTBOX_MAX = 256,
    MINOR_FRAME_US = EXECUTIVE_FRAME_US,
    READINGS_MAX = 2 * EXECUTIVE_TASKS_MAX,
    NS_PER_US = 1000,
};

_Static_assert((int)CYCLE_LOG_TASKS_MAX == (int)EXECUTIVE_TASKS_MAX, "a record has room for every task");
_Static_assert((int)CYCLE_LOG_BUSES == (int)CAN_BUS_COUNT, "and for every bus");

/* The executive's clock. It reads it before and after each task, in order: the readings are kept, so that a record has
 * the tasks' real time whatever the period. */
typedef struct task_clock {
    uint64_t period_us;
    uint64_t readings_ns[READINGS_MAX]; /* of this cycle */
    uint32_t count;
    uint32_t runs[EXECUTIVE_TASKS_MAX]; /* of each task up to the last cycle */
} task_clock;

/* What the kernel counted up to the end of the last cycle, and this thread's processor time at the beginning of this.
 */
typedef struct usage_meter {
    int32_t schedstat_fd;
    uint64_t wake_cpu_ns;
    thread_usage before;
} usage_meter;

/* The process. */
typedef struct ecu_process {
    const ecu_image *image;
    ecu_options options;
    deadline_timer timer;
    ecu_bus buses[CAN_BUS_COUNT];
    wired_io wires;
    cycle_log log;
    task_clock clock;
    usage_meter usage;
    uint64_t cycles;
    uint64_t latest_ns; /* latest wake-up after its deadline */
    uint64_t no_room;   /* frames that the firmware's outbox did not hold */
    can_frame inbox[CAN_BUS_COUNT * ECU_BUS_FRAMES_MAX];
    can_frame outbox[OUTBOX_MAX];
} ecu_process;

static ecu_process the_process; /* too large for the stack */
static volatile sig_atomic_t stop_signal;

static void note_signal(int number)
{
    stop_signal = number;
}

static void catch_signals(void)
{
    static const int stops[] = {SIGINT, SIGTERM, SIGHUP};
    struct sigaction action = {.sa_handler = note_signal};
    (void)sigemptyset(&action.sa_mask);
    for (size_t i = 0U; i < sizeof stops / sizeof stops[0]; i++) {
        (void)sigaction(stops[i], &action, NULL);
    }
    action.sa_handler = SIG_IGN; /* who no longer reads our lines does not stop a car */
    (void)sigaction(SIGPIPE, &action, NULL);
}

static uint16_t saturate_u16(uint64_t value)
{
    return value > UINT16_MAX ? UINT16_MAX : (uint16_t)value;
}

static uint32_t saturate_u32(uint64_t value)
{
    return value > UINT32_MAX ? UINT32_MAX : (uint32_t)value;
}

/* --- time of the firmware --- */

/* Time to the firmware: as long as a cycle takes, its minor frame lasts 10 ms. */
static uint64_t firmware_us(uint64_t real_ns, uint64_t period_us)
{
    return real_ns / NS_PER_US * MINOR_FRAME_US / period_us;
}

static uint64_t read_task_clock(void *context)
{
    task_clock *self = context;
    const uint64_t now_ns = monotonic_ns();
    if (self->count < READINGS_MAX) {
        self->readings_ns[self->count++] = now_ns;
    }
    return firmware_us(now_ns, self->period_us);
}

/* Which tasks ran in this cycle, and for how long. */
static void record_tasks(task_clock *self, const ecu_image *image, cycle_record *record)
{
    uint32_t reading = 0U;
    for (uint32_t task = 0U; task < image->task_count && reading + 1U < self->count; task++) {
        const uint32_t runs = image->executive->records[task].runs;
        if (runs != self->runs[task]) {
            const uint64_t took_ns = self->readings_ns[reading + 1U] - self->readings_ns[reading];
            record->tasks_run |= (uint16_t)(1U << task);
            record->task_us[task] = saturate_u16((took_ns + NS_PER_US / 2) / NS_PER_US);
            reading += 2U;
        }
        self->runs[task] = runs;
    }
}

/* --- setting up --- */

static int32_t complain(const char *option, const char *value, const char *why)
{
    process_log("%s %s: %s", option, value, why);
    return ECU_EXIT_MISTAKE;
}

static int32_t open_buses(ecu_process *self)
{
    const ecu_options *options = &self->options;
    const uint32_t fresh_us = (uint32_t)(ECU_BUS_FRESH_PERIODS * options->period_us);
    for (uint8_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        const char *address = options->addresses[bus];
        const int32_t error = address == NULL ? 0
                                              : ecu_bus_open(&self->buses[bus], address, self->image->station, bus,
                                                             options->epoch_ns, fresh_us);
        if (error != 0) {
            process_log("%s at %s: %s", ecu_bus_name(bus), address, can_link_error_text(error));
            return ECU_EXIT_MISTAKE;
        }
    }
    return 0;
}

static int32_t open_wires(ecu_process *self)
{
    const char *path = self->options.wired;
    const int32_t error = path == NULL ? 0 : wired_io_open(&self->wires, path);
    if (error == EPROTO) {
        return complain("--wired", path, "not a file of wires of this version");
    }
    return error == 0 ? 0 : complain("--wired", path, strerror(error));
}

static int32_t open_log(ecu_process *self)
{
    const ecu_image *image = self->image;
    const ecu_options *options = &self->options;
    cycle_log_header header = {
        .epoch_ns = options->epoch_ns,
        .phase_ns = options->phase_us * NS_PER_US,
        .period_ns = options->period_us * NS_PER_US,
        .process = (uint32_t)getpid(),
        .priority = options->priority,
        .cpu = options->cpu,
        .task_count = image->task_count,
    };
    self->usage.schedstat_fd = -1;
    if (options->cycle_log == NULL) {
        return 0;
    }
    (void)snprintf(header.name, sizeof header.name, "%s", image->name);
    for (uint32_t i = 0U; i < image->task_count; i++) {
        (void)snprintf(header.task_names[i], sizeof header.task_names[i], "%s", image->task_names[i]);
    }
    self->usage.schedstat_fd = cycle_log_open_schedstat();
    const int32_t error = cycle_log_create(&self->log, options->cycle_log, &header, options->cycles);
    return error == 0 ? 0 : complain("--cycle-log", options->cycle_log, strerror(error));
}

/* Everything before the first cycle. Returns 0 or an exit status, after a line that says why. */
static int32_t set_up(ecu_process *self)
{
    const ecu_options *options = &self->options;
    char text[REALTIME_TEXT_MAX];
    if (options->with_parent) {
        realtime_end_with_parent();
    }
    if (realtime_schedule(options->priority, options->cpu, text) != 0) {
        process_log("%s", text);
        return ECU_EXIT_MISTAKE;
    }
    if (self->image->select_profile != NULL) {
        (void)self->image->select_profile(options->profile); /* the parser lets only those pass that there are */
    }
    int32_t status = open_buses(self);
    status = status == 0 ? open_wires(self) : status;
    status = status == 0 ? open_log(self) : status;
    if (status != 0) {
        return status;
    }
    if (realtime_lock_memory(text) != 0) {
        process_log("%s", text);
        if (options->priority > 0) {
            return ECU_EXIT_MISTAKE;
        }
    }
    self->clock.period_us = options->period_us;
    self->image->executive->clock = read_task_clock;
    self->image->executive->clock_context = &self->clock;
    return 0;
}

/* --- a cycle --- */

static uint32_t receive(ecu_process *self, uint64_t now_us, cycle_record *record)
{
    uint32_t count = 0U;
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        ecu_bus *source = &self->buses[bus];
        count += ecu_bus_receive(source, &self->inbox[count], now_us);
        if (source->newest_us != 0U) {
            record->newest_ns[bus] = self->options.epoch_ns + source->newest_us * NS_PER_US;
        }
    }
    return count;
}

/* Returns the number of frames that a bus did not take. */
static uint32_t send_all(ecu_process *self, const can_outbox *out)
{
    uint64_t lost = 0U;
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        can_link *link = &self->buses[bus].link;
        const uint64_t lost_before = link->statistics.refused + link->statistics.undelivered;
        (void)can_link_send(link, out->frames, out->count);
        lost += link->statistics.refused + link->statistics.undelivered - lost_before;
    }
    return (uint32_t)lost;
}

static uint64_t thread_cpu_ns(void)
{
    struct timespec cpu = {0};
    (void)clock_gettime(CLOCK_THREAD_CPUTIME_ID, &cpu);
    return (uint64_t)cpu.tv_sec * 1000000000U + (uint64_t)cpu.tv_nsec;
}

static void record_usage(usage_meter *self, cycle_record *record)
{
    thread_usage now;
    thread_usage_read(&now, self->schedstat_fd);
    record->cpu_ns = saturate_u32(now.cpu_ns - self->wake_cpu_ns);
    record->run_queue_ns = saturate_u32(now.run_queue_ns - self->before.run_queue_ns);
    record->page_faults = saturate_u32(now.page_faults - self->before.page_faults);
    record->preemptions = saturate_u16(now.preemptions - self->before.preemptions);
    self->before = now;
}

static void run_cycle(ecu_process *self, uint64_t skipped)
{
    const ecu_image *image = self->image;
    const deadline_timer *timer = &self->timer;
    const bool logged = self->log.header != NULL;
    const uint64_t elapsed_ns = timer->wake_ns - self->options.epoch_ns;
    cycle_record record = {
        .slot = timer->slot,
        .deadline_ns = timer->deadline_ns,
        .wake_ns = timer->wake_ns,
        .skipped = saturate_u32(skipped),
        .cpu = (uint16_t)sched_getcpu(),
    };
    self->usage.wake_cpu_ns = logged ? thread_cpu_ns() : 0U;

    const uint32_t in_count = receive(self, elapsed_ns / NS_PER_US, &record);
    if (image->sockets.wires) {
        (void)wired_io_read(&self->wires, image->wired_in_cell, image->wired_in);
    }
    record.received_ns = monotonic_ns();

    can_outbox out = {.frames = self->outbox, .capacity = OUTBOX_MAX};
    self->clock.count = 0U;
    image->tick(firmware_us(elapsed_ns, self->options.period_us), self->inbox, in_count, &out);
    record.ticked_ns = monotonic_ns();

    if (image->sockets.wires) {
        wired_io_write(&self->wires, image->wired_out_cell, image->wired_out, record.ticked_ns);
    }
    const uint32_t lost = send_all(self, &out);
    record.sent_ns = monotonic_ns();

    self->cycles++;
    self->no_room += out.dropped;
    if (timer->wake_ns - timer->deadline_ns > self->latest_ns) {
        self->latest_ns = timer->wake_ns - timer->deadline_ns;
    }
    if (logged) {
        record.frames_in = saturate_u16(in_count);
        record.frames_out = saturate_u16(out.count);
        record.refused = saturate_u16(lost);
        record_tasks(&self->clock, image, &record);
        record_usage(&self->usage, &record);
        cycle_log_write(&self->log, &record);
    }
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        ecu_bus_tell(&self->buses[bus], image->name, elapsed_ns / NS_PER_US);
    }
}

/* Cycle until stopped, and a few cycles longer. Stopped before its first cycle it sends nothing: nobody has heard of
 * it yet. */
static void run_cycles(ecu_process *self)
{
    uint32_t last_cycles = ECU_STOP_CYCLES;
    bool stopping = false;
    while (last_cycles > 0U) {
        const uint64_t skipped_before = self->timer.skipped;
        const bool reached = deadline_timer_wait(&self->timer) == DEADLINE_REACHED;
        if (stop_signal != 0 && !stopping) {
            process_log("stops on %s: full brake", strsignal(stop_signal));
            self->image->stop();
            stopping = true;
        }
        if (stopping && self->cycles == 0U) {
            return;
        }
        if (reached) {
            run_cycle(self, self->timer.skipped - skipped_before);
            last_cycles -= stopping ? 1U : 0U;
        }
    }
}

static void summarise(ecu_process *self)
{
    process_log("cycles %" PRIu64 ", skipped %" PRIu64 ", latest wake-up %" PRIu64 " us, frames without room %" PRIu64,
                self->cycles, self->timer.skipped, self->latest_ns / NS_PER_US, self->no_room);
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        ecu_bus_summarise(&self->buses[bus]);
    }
}

static void help(const ecu_image *image)
{
    (void)printf("usage: %s --bus NAME=ADDRESS ...\n\nThe %s as a process, in a cycle of 10 ms. Its buses:",
                 program_invocation_short_name, image->name);
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        if ((image->sockets.buses >> bus & 1U) != 0U) {
            (void)printf(" %s", ecu_bus_name(bus));
        }
    }
    (void)printf(".\n\n%s", ecu_options_help());
}

int32_t ecu_process_run(const ecu_image *image, int argument_count, char **arguments)
{
    ecu_process *self = &the_process;
    char mistake[ECU_MISTAKE_MAX];
    self->image = image;
    const uint32_t count = argument_count > 0 ? (uint32_t)argument_count - 1U : 0U;
    if (ecu_options_parse(&self->options, &image->sockets, monotonic_ns(), count, arguments + 1, mistake) != 0) {
        process_log("%s", mistake);
        return ECU_EXIT_MISTAKE;
    }
    if (self->options.help) {
        help(image);
        return 0;
    }
    catch_signals();
    const int32_t status = set_up(self);
    if (status == 0) {
        const ecu_options *options = &self->options;
        deadline_timer_init(&self->timer, options->epoch_ns, options->phase_us * NS_PER_US,
                            options->period_us * NS_PER_US);
        process_log("runs: period %" PRIu64 " us, phase %" PRIu64 " us, priority %" PRId32 ", processor %" PRId32,
                    options->period_us, options->phase_us, options->priority, options->cpu);
        thread_usage_read(&self->usage.before, self->usage.schedstat_fd);
        run_cycles(self);
        summarise(self);
    }
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        can_link_close(&self->buses[bus].link);
    }
    wired_io_close(&self->wires);
    cycle_log_close(&self->log);
    return status;
}
