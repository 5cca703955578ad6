/* raceloop-raptor: the vehicle controller as a process. */
#include <stddef.h>

#include "ports/linux/ecu_process.h"
#include "ports/linux/wired_io.h"
#include "raptor/raptor.h"

static raptor controller;
static raptor_wired_in wired;
static raptor_wired_out drive;

static const char *const task_names[] = {"receive",       "supervise",     "control",
                                         "send_requests", "send_shutdown", "send_reports"};

static void tick(uint64_t now_us, const can_frame *in, uint32_t in_count, can_outbox *out)
{
    raptor_tick(&controller, now_us, &wired, in, in_count, &drive, out);
}

static void stop(void)
{
    raptor_stop(&controller);
}

static bool select_profile(uint8_t profile)
{
    return raptor_select_profile(&controller, profile);
}

int main(int argument_count, char **arguments)
{
    static const ecu_image image = {
        .name = "raptor",
        .station = CAN_STATION_RAPTOR,
        .sockets = {.buses = 1U << CAN_BUS_1 | 1U << CAN_BUS_3, .wires = true},
        .wired_in_cell = WIRED_RAPTOR_IN,
        .wired_out_cell = WIRED_RAPTOR_OUT,
        .wired_in = &wired,
        .wired_out = &drive,
        .executive = &controller.schedule,
        .task_names = task_names,
        .task_count = sizeof task_names / sizeof task_names[0],
        .tick = tick,
        .stop = stop,
        .select_profile = select_profile,
    };
    raptor_init(&controller, NULL);
    return ecu_process_run(&image, argument_count, arguments);
}
