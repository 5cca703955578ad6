#include "obc/obc.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "generated/autonomy.h"
#include "obc/ct_state.h"

enum {
    EVENTS_PER_TICK = 4, /* paces what comes in bursts on CAN-A */
    RESULTS_PER_TICK = 5,
};

static float real(const obc *self, uint32_t index)
{
    return parameters_real(&self->parameters, index);
}

static uint32_t integer(const obc *self, uint32_t index)
{
    return (uint32_t)parameters_integer(&self->parameters, index); /* no parameter allows negative integers */
}

static control_estimate estimate(const obc *self)
{
    return estimate_receiver_get(&self->estimate, integer(self, PARAMETER_ESTIMATE_TIMEOUT), self->io.now_us);
}

/* A report of the Raptor is fresh. report: enum vehicle_report. timeout: enum parameter_index. */
static bool reported(const obc *self, uint32_t report, uint32_t timeout)
{
    return vehicle_feedback_age_ms(&self->vehicle, report, self->io.now_us) <= integer(self, timeout);
}

/* Flags that race control still stands behind: its heartbeat moves. */
static bool flags_fresh(const obc *self)
{
    return vehicle_feedback_race_control_age_ms(&self->vehicle, self->io.now_us) <=
           integer(self, PARAMETER_RACE_CONTROL_TIMEOUT);
}

/* The wheels stand, and nothing says that they slide: neither an old report nor locked wheels are a standstill. */
static bool standing_still(const obc *self)
{
    const control_estimate motion = estimate(self);
    return reported(self, VEHICLE_WHEEL_SPEED, PARAMETER_WHEEL_SPEED_TIMEOUT) &&
           self->vehicle.control.wheel_speed <= real(self, PARAMETER_STANDSTILL_SPEED) &&
           !(motion.valid && fabsf(motion.vx) > CONTROL_SPEED_DISAGREEMENT);
}

/* The state machines let control move the car. */
static bool driving(const obc *self)
{
    return self->ssm_output.drive_allowed && ct_state_drives(self->ct_state);
}

/* --- receive --- */

static void receive_parameter(obc *self, const can_frame *frame)
{
    if (frame->id == AUTONOMY_PARAMETER_WRITE_FRAME_ID) {
        struct autonomy_parameter_write_t write;
        (void)autonomy_parameter_write_unpack(&write, frame->data, CAN_DATA_MAX);
        parameters_write(&self->parameters, write.write_key, write.write_type, write.write_value);
    } else {
        struct autonomy_parameter_commit_t commit;
        (void)autonomy_parameter_commit_unpack(&commit, frame->data, CAN_DATA_MAX);
        parameters_commit(&self->parameters, commit.commit_count, commit.commit_schema);
    }
}

static void receive_launch(obc *self, const can_frame *frame)
{
    if (codec_receive(&self->launch.rx, frame, self->io.now_us) == CODEC_OK) {
        struct autonomy_launch_request_t request;
        (void)autonomy_launch_request_unpack(&request, frame->data, CAN_DATA_MAX);
        self->launch.wanted = request.launch_wanted != 0U;
    }
}

static void receive_autonomy(obc *self, const can_frame *frame)
{
    switch (frame->id) {
    case AUTONOMY_PARAMETER_WRITE_FRAME_ID:
    case AUTONOMY_PARAMETER_COMMIT_FRAME_ID:
        receive_parameter(self, frame);
        break;
    case AUTONOMY_LAUNCH_REQUEST_FRAME_ID:
        receive_launch(self, frame);
        break;
    case AUTONOMY_NODE_STATUS_FRAME_ID:
    case AUTONOMY_PERCEPTION_STATUS_FRAME_ID:
        node_monitor_push(&self->nodes, frame, self->io.now_us);
        break;
    case AUTONOMY_SENSOR_NOTICE_FRAME_ID:
        scan_monitor_push(&self->scans, frame, self->io.now_us);
        break;
    case AUTONOMY_TRAJECTORY_HEADER_FRAME_ID:
    case AUTONOMY_TRAJECTORY_POSE_FRAME_ID:
    case AUTONOMY_TRAJECTORY_MOTION_FRAME_ID:
        trajectory_receiver_push(&self->plans, frame, self->io.now_us);
        break;
    case AUTONOMY_WALL_LINE_FRAME_ID:
    case AUTONOMY_WALL_BEND_FRAME_ID:
        wall_receiver_push(&self->wall, frame, self->io.now_us);
        break;
    default:
        estimate_receiver_push(&self->estimate, frame, self->io.now_us);
        break;
    }
}

static void run_receive(void *context)
{
    obc *self = context;
    self->doubled_id = 0U;
    for (uint32_t i = 0U; i < self->io.in_count; i++) {
        can_frame translated;
        const can_frame *frame = &translated;
        const codec_message *message = NULL;
        const dbw_profile_verdict verdict = dbw_profile_receive(&self->profile, &self->io.in[i], &translated);
        if (verdict == DBW_PROFILE_NOTHING) {
            continue;
        }
        if (verdict == DBW_PROFILE_REFUSED || codec_accept(frame, &message) != CODEC_OK) {
            self->rejected_frames++;
            continue;
        }
        if (message->sender == CAN_STATION_OBC) {
            self->doubled_id = frame->id; /* nobody hears itself */
            continue;
        }
        switch (message->bus) {
        case CAN_BUS_1:
            vehicle_feedback_push(&self->vehicle, frame, real(self, PARAMETER_STEERING_RATIO), self->io.now_us);
            break;
        case CAN_BUS_A:
            receive_autonomy(self, frame);
            break;
        case CAN_BUS_S:
            sensor_monitor_push(&self->sensors, frame, self->io.now_us);
            estimate_receiver_push(&self->estimate, frame, self->io.now_us);
            break;
        default:
            break; /* CAN3 and CAN-R are none of our buses */
        }
    }
}

/* --- monitor, control, SSM --- */

static void run_control(void *context)
{
    obc *self = context;
    const ssm_output *ssm = &self->ssm_output;
    const control_input input = {
        .plan = trajectory_receiver_latest(&self->plans),
        .estimate = estimate(self),
        .feedback = self->vehicle.control,
        .wall = self->wall.seen ? &self->wall.wall : NULL,
        .wall_count = self->wall.count,
        .wall_age_ms = wall_receiver_age_ms(&self->wall, self->io.now_us),
        .wall_timeout_ms = wall_receiver_timeout_ms(),
        .max_speed = ssm->limits.max_speed,
        .max_acceleration = ssm->limits.max_acceleration,
        .max_deceleration = ssm->limits.max_deceleration,
        .lateral = ssm->controller,
        .drive_enabled = driving(self),
        .safe_stop = ssm->safe_stop || self->ct_state == CT_COORD_STOP,
    };
    control_step(&self->control, &input, &self->control_output);
}

static void run_monitor(void *context)
{
    obc *self = context;
    const fault_sources sources = {
        .parameters = &self->parameters,
        .nodes = &self->nodes,
        .sensors = &self->sensors,
        .scans = &self->scans,
        .vehicle = &self->vehicle,
        .estimate = &self->estimate,
        .wall = &self->wall,
        .plan = trajectory_receiver_latest(&self->plans),
        .control = &self->control_output,
        .dbw = &self->dbw,
        .executive = &self->executive,
        .now_us = self->io.now_us,
        .launch_us = self->launch.rx.last_valid_us,
        .launch_seen = self->launch.rx.seen,
        .launch_wanted = self->launch.wanted,
        .driving = driving(self),
        .stopping = self->stopping,
        .doubled_id = self->doubled_id,
        .control_task = OBC_TASK_CONTROL,
        .dbw_violations = self->dbw_violations,
    };
    fault_detection_step(&self->detection, &sources, &self->conditions);
}

/* The emergency controller has what it needs: a wall, and the speed at which the car rolls. */
static bool wall_followed(const obc *self)
{
    return self->control_output.emergency_valid && !self->conditions.present[FAULT_WHEEL_SPEED_MISSING];
}

static void run_ssm(void *context)
{
    obc *self = context;
    const float max_deceleration = real(self, PARAMETER_MAX_DECELERATION);
    const ssm_input input = {
        .conditions = &self->conditions,
        .nominal = {real(self, PARAMETER_MAX_SPEED), real(self, PARAMETER_MAX_ACCELERATION), max_deceleration},
        .degraded = {real(self, PARAMETER_DEGRADED_MAX_SPEED), real(self, PARAMETER_DEGRADED_MAX_ACCELERATION),
                     max_deceleration},
        .now_us = self->io.now_us,
        .verdict = self->parameters.verdict,
        .degraded_allowed = integer(self, PARAMETER_DEGRADED_DRIVING_ALLOWED) != 0U,
        .launch_wanted = self->launch.wanted,
        .driving = driving(self),
        .standing_still = standing_still(self),
        .wall_followed = wall_followed(self),
    };
    ssm_step(&self->ssm, &input, &self->ssm_output);

    /* What is not fresh moves nothing: 0 is no sys_state and no flag. */
    const bool raptor_alive = reported(self, VEHICLE_MISC, PARAMETER_MISC_REPORT_TIMEOUT);
    const bool flags = flags_fresh(self);
    const ct_input ct = {
        .sys_state = raptor_alive ? self->vehicle.sys_state : 0U,
        .track_flag = flags ? self->vehicle.race_control.track_flag : 0U,
        .vehicle_flag = flags ? self->vehicle.race_control.vehicle_flag : 0U,
        .raptor_alive = raptor_alive,
        .configuration_accepted = self->parameters.verdict == PARAMETER_VERDICT_ACCEPTED,
        .nominal = self->ssm_output.state == SSM_NOMINAL,
        .full_brake = self->ssm_output.state == SSM_FULL_BRAKE,
        .standing_still = standing_still(self),
    };
    /* A state is left when it has been told: who listens sees each of them. What stops the car does not wait. */
    const uint8_t next = ct_state_next(self->ct_state, &ct);
    if (next == CT_COORD_STOP || next == CT_EMRG_SHUTDOWN || self->ct_state_told) {
        self->ct_state_told = self->ct_state_told && next == self->ct_state;
        self->ct_state = next;
    }
}

/* --- drive by wire --- */

static uint8_t dbw_mode(const obc *self)
{
    if (!self->ssm_output.drive_allowed || self->ct_state == CT_EMRG_SHUTDOWN) {
        return DBW_FULL_BRAKE;
    }
    return driving(self) ? DBW_DRIVE : DBW_HOLD;
}

/* What the chosen controller steers by is there. */
static bool controller_sees(const obc *self)
{
    return self->ssm_output.controller == CONTROL_EMERGENCY ? self->control_output.emergency_valid
                                                            : self->control_output.lateral_valid;
}

/* Control may brake less than the holding pressure only on a path, an estimate and a wheel speed that are fresh; beside
 * a wall the estimate does not count. */
static bool inputs_fresh(const obc *self)
{
    return controller_sees(self) && !self->conditions.present[FAULT_WHEEL_SPEED_MISSING] &&
           (self->ssm_output.controller == CONTROL_EMERGENCY || !self->conditions.present[FAULT_ESTIMATE_LOST]);
}

/* The wheels follow control while the car is driven, or rolls under a full brake; a command that is not finite is
 * left out here because the SSM answers it by switching the controller. */
static bool steering_follows(const obc *self)
{
    const uint8_t controller = self->ssm_output.controller;
    const bool moves = driving(self) || (controller != CONTROL_NONE && !standing_still(self));
    return moves && controller_sees(self) && isfinite(self->control_output.road_wheel_angle[controller]);
}

static void run_dbw(void *context)
{
    obc *self = context;
    const control_estimate motion = estimate(self);
    const control_output *control = &self->control_output;
    const float holding = real(self, PARAMETER_HOLDING_BRAKE_PRESSURE);
    const bool fresh = inputs_fresh(self);
    /* No flag is acknowledged that is not shown any more. */
    const bool marelli = reported(self, VEHICLE_MARELLI, PARAMETER_RACE_CONTROL_TIMEOUT);
    const bool brake_more = !fresh && control->brake_pressure < holding;
    const dbw_demand demand = {
        .mode = dbw_mode(self),
        .steer = steering_follows(self),
        .wheels_follow = !self->conditions.present[FAULT_STEERING_IMPLAUSIBLE],
        .standing_still = standing_still(self),
        .road_wheel_angle = control->road_wheel_command,
        .wheels_found = self->vehicle.control.road_wheel_angle,
        .wheels_known = reported(self, VEHICLE_STEERING, PARAMETER_STEERING_REPORT_TIMEOUT),
        /* Control learns of a safe stop in the next tick; no throttle leaves in this one, and none during the stop. */
        .throttle = fresh && !self->ssm_output.safe_stop ? control->throttle : 0.0f,
        .brake_pressure = brake_more ? holding : control->brake_pressure,
        .gear = control->gear,
        .acceleration = {motion.ax, motion.ay, self->estimate.vertical_acceleration},
        .marelli_track_flag = marelli ? self->vehicle.race_control.marelli_track_flag : 0U,
        .marelli_vehicle_flag = marelli ? self->vehicle.race_control.marelli_vehicle_flag : 0U,
        .marelli_sector_flag = marelli ? self->vehicle.race_control.marelli_sector_flag : 0U,
    };
    const dbw_limits limits = {
        .full_brake_pressure = real(self, PARAMETER_FULL_BRAKE_PRESSURE),
        .steered_brake_pressure = real(self, PARAMETER_STEERED_BRAKE_PRESSURE),
        .holding_brake_pressure = holding,
        .steering_limit = real(self, PARAMETER_STEERING_LIMIT),
        .steering_slew = real(self, PARAMETER_STEERING_SLEW),
        .steering_ratio = real(self, PARAMETER_STEERING_RATIO),
        .throttle_limit = real(self, PARAMETER_THROTTLE_LIMIT),
        .traction_aim = (uint8_t)integer(self, PARAMETER_TRACTION_AIM_SWITCH),
        .traction_range = (uint8_t)integer(self, PARAMETER_TRACTION_RANGE_SWITCH),
    };
    self->dbw_violations = dbw_command_step(&self->dbw, &demand, &limits, self->io.out);
}

static void run_ct_report(void *context)
{
    obc *self = context;
    const bool flags = flags_fresh(self);
    const dbw_ct_report report = {
        .ct_state = self->ct_state,
        .track_flag = flags ? self->vehicle.race_control.track_flag : 0U,
        .vehicle_flag = flags ? self->vehicle.race_control.vehicle_flag : 0U,
        .vehicle_number = (uint8_t)integer(self, PARAMETER_VEHICLE_NUMBER),
    };
    dbw_command_ct_report(&self->dbw, &report, self->io.out);
    self->ct_state_told = true;
}

/* --- status --- */

static void run_status(void *context)
{
    obc *self = context;
    const trajectory *plan = trajectory_receiver_latest(&self->plans);
    const status_vehicle vehicle = {
        .wheel_speed = self->vehicle.control.wheel_speed,
        .ct_state = self->ct_state,
        .sys_state = self->vehicle.sys_state,
        .track_flag = self->vehicle.race_control.track_flag,
        .vehicle_flag = self->vehicle.race_control.vehicle_flag,
        .gear = self->vehicle.control.gear,
        .round_target_speed = self->vehicle.race_control.round_target_speed,
        .plan_in_use = plan != NULL ? plan->plan_counter : 0U,
    };
    status_report_ssm(&self->status, &self->ssm_output, self->io.out);
    status_report_vehicle(&self->status, &vehicle, self->io.out);
    status_report_control(&self->status, &self->control_output, self->io.out);
    status_report_faults(&self->ssm.faults, EVENTS_PER_TICK, self->io.out);
    status_report_results(&self->parameters, RESULTS_PER_TICK, self->io.out);
}

static void run_statistics(void *context)
{
    obc *self = context;
    status_report_summary(&self->status, &self->parameters, self->io.out);
    status_report_executive(&self->status, &self->executive, obc_schedule(), OBC_TASK_COUNT, self->io.out);
}

/* Budgets leave half of the minor frame free. The SSM comes after control, so that what control did wrong is answered
 * in the same tick, before a command leaves. */
static const executive_task schedule[OBC_TASK_COUNT] = {
    [OBC_TASK_RECEIVE] = {run_receive, 1, 0, 1500}, [OBC_TASK_CONTROL] = {run_control, 1, 0, 1500},
    [OBC_TASK_MONITOR] = {run_monitor, 1, 0, 500},  [OBC_TASK_SSM] = {run_ssm, 1, 0, 500},
    [OBC_TASK_DBW] = {run_dbw, 1, 0, 300},          [OBC_TASK_CT_REPORT] = {run_ct_report, 5, 0, 100},
    [OBC_TASK_STATUS] = {run_status, 1, 0, 300},    [OBC_TASK_STATISTICS] = {run_statistics, 10, 0, 200},
};

const executive_task *obc_schedule(void)
{
    return schedule;
}

void obc_init(obc *self)
{
    memset(self, 0, sizeof *self);
    parameters_init(&self->parameters);
    control_init(&self->control);
    self->ct_state = CT_DEFAULT;
}

bool obc_select_profile(obc *self, uint8_t profile)
{
    return dbw_profile_select(&self->profile, profile);
}

void obc_stop(obc *self)
{
    self->stopping = true;
}

void obc_tick(obc *self, uint64_t now_us, const can_frame *in, uint32_t in_count, can_outbox *out)
{
    self->io = (obc_tick_io){.in = in, .out = out, .now_us = now_us, .in_count = in_count};
    const uint32_t first = out->count;
    executive_run(&self->executive, schedule, OBC_TASK_COUNT, self, now_us);
    dbw_profile_send(&self->profile, out, first);
    for (uint32_t i = first; i < out->count; i++) {
        out->frames[i].sender = CAN_STATION_OBC;
    }
    self->io = (obc_tick_io){0};
}
