/* An ECU as a process: its firmware in a cycle with absolute deadlines, between links to the buses and the wires.
 *
 * A cycle: wait, receive, read the wires, tick, write the wires, send, record. The firmware gets the time since the
 * epoch at which the cycle really began, so that its executive sees lateness; a period other than 10 ms scales that
 * time, and the clock that measures the tasks, so that a cycle stays one minor frame.
 *
 * SIGINT, SIGTERM and SIGHUP stop it in order: the firmware is told, its full brake goes out in the cycles that
 * follow, and the process ends with status 0. A mistake in the command line, or something that is missing, is one line
 * on standard error and status 2.
 */
#ifndef RACELOOP_PORT_ECU_PROCESS_H
#define RACELOOP_PORT_ECU_PROCESS_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/executive.h"
#include "ports/linux/ecu_options.h"

enum {
    ECU_EXIT_MISTAKE = 2,
    ECU_STOP_CYCLES = 5, /* run once the firmware was told to stop */
};

/* What one ECU's process is made of. All pointers live as long as the process. */
typedef struct ecu_image {
    const char *name; /* of the station: "obc" */
    uint8_t station;  /* enum can_station */
    ecu_sockets sockets;
    uint32_t wired_in_cell;  /* enum wired_cell; only with sockets.wires */
    uint32_t wired_out_cell; /* enum wired_cell */
    void *wired_in;          /* its struct, which tick reads */
    void *wired_out;         /* its struct, which tick writes */
    executive *executive;    /* of the firmware, already initialised; its clock is set here */
    const char *const *task_names;
    uint32_t task_count; /* at most EXECUTIVE_TASKS_MAX */
    void (*tick)(uint64_t now_us, const can_frame *in, uint32_t in_count, can_outbox *out);
    void (*stop)(void);
    bool (*select_profile)(uint8_t profile); /* enum codec_profile_index; null without CAN1 */
} ecu_image;

/* Run until stopped. argument_count and arguments as main gets them. Returns the exit status. */
int32_t ecu_process_run(const ecu_image *image, int argument_count, char **arguments);

#endif
