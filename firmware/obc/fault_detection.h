/* Conditions of all faults, gathered from the monitors and receivers in one place: the detection column of
 * firmware/schema/faults.yaml. */
#ifndef RACELOOP_OBC_FAULT_DETECTION_H
#define RACELOOP_OBC_FAULT_DETECTION_H

#include <stdbool.h>
#include <stdint.h>

#include "common/executive.h"
#include "obc/control.h"
#include "obc/dbw_command.h"
#include "obc/estimate_receiver.h"
#include "obc/fault_monitor.h"
#include "obc/node_monitor.h"
#include "obc/parameters.h"
#include "obc/scan_monitor.h"
#include "obc/sensor_monitor.h"
#include "obc/trajectory.h"
#include "obc/vehicle_feedback.h"
#include "obc/wall_receiver.h"

/* Everything that is looked at. All pointers not null, except plan. */
typedef struct fault_sources {
    const parameters *parameters;
    const node_monitor *nodes;
    sensor_monitor *sensors;
    scan_monitor *scans;
    const vehicle_feedback *vehicle;
    const estimate_receiver *estimate;
    const wall_receiver *wall;
    const trajectory *plan; /* newest complete plan, or null */
    const control_output *control;
    const dbw_command *dbw; /* commands of the previous cycle */
    const executive *executive;
    uint64_t now_us;
    uint64_t launch_us; /* newest launch request; only meaningful with launch_seen */
    bool launch_seen;
    bool launch_wanted;
    bool driving;           /* control moves the car */
    bool stopping;          /* the computer was told to stop */
    uint32_t doubled_id;    /* of a message of ours that another station sent; 0: none */
    uint32_t control_task;  /* index of the control task in the executive's schedule */
    uint8_t dbw_violations; /* enum dbw_violation bits of the previous cycle */
} fault_sources;

/* Counts over the watchdog's one-second window, and what changed since the last cycle: zero it to start. */
typedef struct fault_detection {
    uint64_t window_us;       /* start of the window */
    uint32_t window_overruns; /* executive's count when the window began */
    uint32_t window_late;
    uint32_t control_overruns; /* control task's count in the last cycle */
    uint16_t late_writes;      /* parameters' count in the last cycle */
} fault_detection;

/* Fill in all conditions of this cycle. self, sources, conditions: not null. */
void fault_detection_step(fault_detection *self, const fault_sources *sources, fault_conditions *conditions);

#endif
