/* raceloop-space-drive: the Space Drive as a process. */
#include <stddef.h>

#include "ports/linux/ecu_process.h"
#include "ports/linux/wired_io.h"
#include "space_drive/space_drive.h"

static space_drive actuator;
static space_drive_wired_in wired;
static space_drive_wired_out drive;

static const char *const task_names[] = {"receive",           "control",           "send_positions",
                                         "send_steer_status", "send_brake_status", "send_steer_errors",
                                         "send_brake_errors"};

static void tick(uint64_t now_us, const can_frame *in, uint32_t in_count, can_outbox *out)
{
    space_drive_tick(&actuator, now_us, &wired, in, in_count, &drive, out);
}

static void stop(void)
{
    space_drive_stop(&actuator);
}

int main(int argument_count, char **arguments)
{
    static const ecu_image image = {
        .name = "space-drive",
        .station = CAN_STATION_SPACE_DRIVE,
        .sockets = {.buses = 1U << CAN_BUS_3, .wires = true},
        .wired_in_cell = WIRED_SPACE_DRIVE_IN,
        .wired_out_cell = WIRED_SPACE_DRIVE_OUT,
        .wired_in = &wired,
        .wired_out = &drive,
        .executive = &actuator.schedule,
        .task_names = task_names,
        .task_count = sizeof task_names / sizeof task_names[0],
        .tick = tick,
        .stop = stop,
    };
    space_drive_init(&actuator, NULL);
    return ecu_process_run(&image, argument_count, arguments);
}
