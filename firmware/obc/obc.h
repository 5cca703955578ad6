/* Onboard computer, control partition: receives sensors, autonomy and the Raptor, supervises them, controls the car
 * and sends the drive-by-wire commands.
 */
#ifndef RACELOOP_OBC_H
#define RACELOOP_OBC_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "common/dbw_profile.h"
#include "common/executive.h"
#include "obc/control.h"
#include "obc/dbw_command.h"
#include "obc/estimate_receiver.h"
#include "obc/fault_detection.h"
#include "obc/node_monitor.h"
#include "obc/parameters.h"
#include "obc/scan_monitor.h"
#include "obc/sensor_monitor.h"
#include "obc/ssm.h"
#include "obc/status_report.h"
#include "obc/trajectory.h"
#include "obc/vehicle_feedback.h"
#include "obc/wall_receiver.h"

/* Tasks in the order of the schedule. */
enum obc_task {
    OBC_TASK_RECEIVE = 0,
    OBC_TASK_CONTROL = 1,
    OBC_TASK_MONITOR = 2,
    OBC_TASK_SSM = 3,
    OBC_TASK_DBW = 4,
    OBC_TASK_CT_REPORT = 5,
    OBC_TASK_STATUS = 6,
    OBC_TASK_STATISTICS = 7,
    OBC_TASK_COUNT = 8,
};

/* Frames of one tick: borrowed for its duration. */
typedef struct obc_tick_io {
    const can_frame *in;
    can_outbox *out;
    uint64_t now_us;
    uint32_t in_count;
} obc_tick_io;

/* The operator's launch request. */
typedef struct obc_launch {
    codec_rx rx;
    bool wanted; /* content of the newest valid frame */
} obc_launch;

/* The whole state of the onboard computer. obc_init starts it. */
typedef struct obc {
    executive executive;
    obc_tick_io io;
    dbw_profile profile;      /* of CAN1 */
    uint32_t rejected_frames; /* remote, error or short frames on any bus */
    uint32_t doubled_id;      /* of a message of ours that another station sent, heard in this tick; 0: none */
    parameters parameters;
    sensor_monitor sensors;
    scan_monitor scans;
    node_monitor nodes;
    vehicle_feedback vehicle;
    estimate_receiver estimate;
    trajectory_receiver plans;
    wall_receiver wall;
    obc_launch launch;
    fault_detection detection;
    fault_conditions conditions;
    ssm ssm;
    ssm_output ssm_output; /* of this tick once the SSM ran, before that of the last one */
    control control;
    control_output control_output;
    dbw_command dbw;
    uint8_t dbw_violations; /* of the last tick */
    uint8_t ct_state;
    bool ct_state_told; /* in a ct_report */
    bool stopping;      /* told to stop; until restart */
    status_report status;
} obc;

/* Power on: no configuration, full brake. self: not null. */
void obc_init(obc *self);

/* Speak a profile on CAN1 from the next tick on; V14 is what a started computer speaks. profile: enum
 * codec_profile_index. Returns false, with nothing changed, when there is none. */
bool obc_select_profile(obc *self, uint8_t profile);

/* Schedule table, OBC_TASK_COUNT rows. */
const executive_task *obc_schedule(void);

/* Run the minor frame that starts at now_us; called every 10 ms.
 * now_us: monotonic. in: frames received since the last tick, of any bus, in_count of them; may be null with 0.
 * out: not null; receives the frames sent (about 40 at most). */
void obc_tick(obc *self, uint64_t now_us, const can_frame *in, uint32_t in_count, can_outbox *out);

/* The computer is about to be switched off: full brake from the next tick on, until obc_init. */
void obc_stop(obc *self);

#endif
