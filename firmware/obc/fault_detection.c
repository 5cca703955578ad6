#include "obc/fault_detection.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "obc/ct_state.h"

/* Units of details. */
#define MILLI     1000.0f
#define CENTI     100.0f
#define PA_TO_KPA 0.001f

enum { WATCHDOG_WINDOW_US = 1000000 };

static void set(fault_conditions *conditions, uint32_t id, bool present, uint32_t detail)
{
    conditions->present[id] = present;
    conditions->detail[id] = detail < UINT16_MAX ? (uint16_t)detail : (uint16_t)UINT16_MAX;
}

/* A number that is not negative, for a detail. */
static uint32_t whole(float value)
{
    return value > 0.0f && value < (float)UINT16_MAX ? (uint32_t)value : 0U;
}

static uint32_t milliseconds(const fault_sources *sources, uint32_t index)
{
    return (uint32_t)parameters_integer(sources->parameters, index);
}

static void detect_parameters(fault_detection *self, const fault_sources *sources, fault_conditions *conditions)
{
    const parameters *source = sources->parameters;
    set(conditions, FAULT_PARAMETERS_REJECTED, source->verdict == PARAMETER_VERDICT_REJECTED,
        (uint32_t)source->rejected + source->missing);
    set(conditions, FAULT_PARAMETER_WRITE_LATE, source->late != self->late_writes, source->late);
    self->late_writes = source->late;
}

static void detect_executive(fault_detection *self, const fault_sources *sources, fault_conditions *conditions)
{
    const executive *source = sources->executive;
    const uint32_t late = source->late_frames + source->missed_frames;
    set(conditions, FAULT_EXECUTIVE_OVERRUN,
        source->overruns - self->window_overruns >= milliseconds(sources, PARAMETER_EXECUTIVE_OVERRUN_LIMIT),
        source->overruns);
    set(conditions, FAULT_EXECUTIVE_LATE,
        late - self->window_late >= milliseconds(sources, PARAMETER_EXECUTIVE_LATE_LIMIT), late);
    /* Only now may a new window begin: a stall that fills a whole window counts to the one it ends. */
    if (sources->now_us - self->window_us >= WATCHDOG_WINDOW_US) {
        self->window_us = sources->now_us;
        self->window_overruns = source->overruns;
        self->window_late = late;
    }

    const executive_record *control = &source->records[sources->control_task];
    set(conditions, FAULT_CONTROL_LATE, control->overruns != self->control_overruns, control->worst_us);
    self->control_overruns = control->overruns;
}

static void detect_computer(const fault_sources *sources, fault_conditions *conditions)
{
    set(conditions, FAULT_COMPUTER_STOPPING, sources->stopping, 0U);
    set(conditions, FAULT_SECOND_COMPUTER, sources->doubled_id != 0U, sources->doubled_id);
}

static void detect_launch(const fault_sources *sources, fault_conditions *conditions)
{
    const uint64_t timeout_us = (uint64_t)milliseconds(sources, PARAMETER_LAUNCH_REQUEST_TIMEOUT) * 1000U;
    const bool silent = !sources->launch_seen || sources->now_us - sources->launch_us > timeout_us;
    set(conditions, FAULT_LAUNCH_WITHDRAWN, silent || !sources->launch_wanted, silent ? 0U : 1U);
}

/* Faults and parameters of each sensor. */
typedef struct sensor_row {
    uint8_t timeout_fault;
    uint8_t rate_fault;
    uint8_t size_fault;
    uint8_t frozen_fault;
    uint8_t jump_fault;
    uint8_t timeout;
    uint8_t min_rate;
    uint8_t data_size;
    uint8_t frozen_timeout;
    uint8_t max_step[SENSOR_STEPS];
} sensor_row;

static const sensor_row sensor_rows[SENSOR_COUNT] = {
    [SENSOR_GNSS_A] =
        {
            .timeout_fault = FAULT_GNSS_A_TIMEOUT,
            .rate_fault = FAULT_GNSS_A_LOW_RATE,
            .size_fault = FAULT_GNSS_A_WRONG_SIZE,
            .frozen_fault = FAULT_GNSS_A_FROZEN,
            .jump_fault = FAULT_GNSS_A_JUMP,
            .timeout = PARAMETER_GNSS_A_TIMEOUT,
            .min_rate = PARAMETER_GNSS_A_MIN_RATE,
            .data_size = PARAMETER_GNSS_A_DATA_SIZE,
            .frozen_timeout = PARAMETER_GNSS_FROZEN_TIMEOUT,
            .max_step = {PARAMETER_GNSS_MAX_POSITION_STEP, PARAMETER_GNSS_MAX_POSITION_STEP},
        },
    [SENSOR_GNSS_B] =
        {
            .timeout_fault = FAULT_GNSS_B_TIMEOUT,
            .rate_fault = FAULT_GNSS_B_LOW_RATE,
            .size_fault = FAULT_GNSS_B_WRONG_SIZE,
            .frozen_fault = FAULT_GNSS_B_FROZEN,
            .jump_fault = FAULT_GNSS_B_JUMP,
            .timeout = PARAMETER_GNSS_B_TIMEOUT,
            .min_rate = PARAMETER_GNSS_B_MIN_RATE,
            .data_size = PARAMETER_GNSS_B_DATA_SIZE,
            .frozen_timeout = PARAMETER_GNSS_FROZEN_TIMEOUT,
            .max_step = {PARAMETER_GNSS_MAX_POSITION_STEP, PARAMETER_GNSS_MAX_POSITION_STEP},
        },
    [SENSOR_IMU] =
        {
            .timeout_fault = FAULT_IMU_TIMEOUT,
            .rate_fault = FAULT_IMU_LOW_RATE,
            .size_fault = FAULT_IMU_WRONG_SIZE,
            .frozen_fault = FAULT_IMU_FROZEN,
            .jump_fault = FAULT_IMU_JUMP,
            .timeout = PARAMETER_IMU_TIMEOUT,
            .min_rate = PARAMETER_IMU_MIN_RATE,
            .data_size = PARAMETER_IMU_DATA_SIZE,
            .frozen_timeout = PARAMETER_IMU_FROZEN_TIMEOUT,
            .max_step = {PARAMETER_IMU_MAX_RATE_STEP, PARAMETER_IMU_MAX_FORCE_STEP},
        },
};

static void detect_sensors(const fault_sources *sources, fault_conditions *conditions)
{
    for (uint32_t i = 0U; i < SENSOR_COUNT; i++) {
        const sensor_row *row = &sensor_rows[i];
        const sensor_limits limits = {
            .timeout_ms = milliseconds(sources, row->timeout),
            .min_rate = parameters_real(sources->parameters, row->min_rate),
            .data_size = (uint32_t)parameters_integer(sources->parameters, row->data_size),
            .frozen_timeout_ms = milliseconds(sources, row->frozen_timeout),
            .max_step = {parameters_real(sources->parameters, row->max_step[0]),
                         parameters_real(sources->parameters, row->max_step[1])},
        };
        const sensor_health health = sensor_monitor_check(sources->sensors, i, &limits, sources->now_us);
        set(conditions, row->timeout_fault, health.timed_out, health.age_ms);
        set(conditions, row->rate_fault, health.low_rate, health.rate);
        set(conditions, row->size_fault, health.wrong_size, health.size);
        set(conditions, row->frozen_fault, health.frozen, health.still_ms);
        set(conditions, row->jump_fault, health.jumps != 0U, health.jumps);
    }
}

/* Faults and parameters of each sensor of perception. */
typedef struct scan_row {
    uint8_t timeout_fault;
    uint8_t rate_fault;
    uint8_t size_fault;
    uint8_t frozen_fault;
    uint8_t timeout;
    uint8_t min_rate;
    uint8_t size;
    bool size_is_exact; /* else it is the least */
} scan_row;

static const scan_row scan_rows[SCAN_COUNT] = {
    [SCAN_LIDAR] =
        {
            .timeout_fault = FAULT_LIDAR_TIMEOUT,
            .rate_fault = FAULT_LIDAR_LOW_RATE,
            .size_fault = FAULT_LIDAR_WRONG_SIZE,
            .frozen_fault = FAULT_LIDAR_FROZEN,
            .timeout = PARAMETER_LIDAR_TIMEOUT,
            .min_rate = PARAMETER_LIDAR_MIN_RATE,
            .size = PARAMETER_LIDAR_MIN_POINTS,
            .size_is_exact = false,
        },
    [SCAN_RADAR] =
        {
            .timeout_fault = FAULT_RADAR_TIMEOUT,
            .rate_fault = FAULT_RADAR_LOW_RATE,
            .size_fault = FAULT_RADAR_WRONG_SIZE,
            .frozen_fault = FAULT_RADAR_FROZEN,
            .timeout = PARAMETER_RADAR_TIMEOUT,
            .min_rate = PARAMETER_RADAR_MIN_RATE,
            .size = PARAMETER_RADAR_DATA_SIZE,
            .size_is_exact = true,
        },
};

/* A car without perception has neither its sensors nor its nodes, and lacks nothing. */
static bool perception_required(const fault_sources *sources)
{
    return parameters_integer(sources->parameters, PARAMETER_PERCEPTION_REQUIRED) != 0;
}

static void detect_scans(const fault_sources *sources, fault_conditions *conditions)
{
    const uint32_t count = perception_required(sources) ? (uint32_t)SCAN_COUNT : 0U;
    for (uint32_t i = 0U; i < count; i++) {
        const scan_row *row = &scan_rows[i];
        const uint32_t size = (uint32_t)parameters_integer(sources->parameters, row->size);
        const scan_limits limits = {
            .timeout_ms = milliseconds(sources, row->timeout),
            .min_rate = parameters_real(sources->parameters, row->min_rate),
            .min_size = size,
            .max_size = row->size_is_exact ? size : UINT32_MAX,
        };
        const scan_health health = scan_monitor_check(sources->scans, i, &limits, sources->now_us);
        set(conditions, row->timeout_fault, health.timed_out, health.age_ms);
        set(conditions, row->rate_fault, health.low_rate, health.rate);
        set(conditions, row->size_fault, health.wrong_size, health.size);
        set(conditions, row->frozen_fault, health.frozen, health.still_ms);
    }
}

/* Faults of each node. */
typedef struct node_row {
    uint8_t not_ok;
    uint8_t failed;
    uint8_t stalled;
    uint8_t low_reliability;
} node_row;

static const node_row node_rows[NODE_COUNT] = {
    [NODE_ESTIMATION] = {FAULT_ESTIMATION_NOT_OK, FAULT_ESTIMATION_FAILED, FAULT_ESTIMATION_STALLED,
                         FAULT_ESTIMATION_LOW_RELIABILITY},
    [NODE_PLANNING] = {FAULT_PLANNING_NOT_OK, FAULT_PLANNING_FAILED, FAULT_PLANNING_STALLED,
                       FAULT_PLANNING_LOW_RELIABILITY},
    [NODE_WALL] = {FAULT_WALL_NOT_OK, FAULT_WALL_FAILED, FAULT_WALL_STALLED, FAULT_WALL_LOW_RELIABILITY},
    [NODE_LIDAR_DETECTION] = {FAULT_LIDAR_DETECTION_NOT_OK, FAULT_LIDAR_DETECTION_FAILED, FAULT_LIDAR_DETECTION_STALLED,
                              FAULT_LIDAR_DETECTION_LOW_RELIABILITY},
    [NODE_RADAR_DETECTION] = {FAULT_RADAR_DETECTION_NOT_OK, FAULT_RADAR_DETECTION_FAILED, FAULT_RADAR_DETECTION_STALLED,
                              FAULT_RADAR_DETECTION_LOW_RELIABILITY},
    [NODE_TRACKING] = {FAULT_TRACKING_NOT_OK, FAULT_TRACKING_FAILED, FAULT_TRACKING_STALLED,
                       FAULT_TRACKING_LOW_RELIABILITY},
    [NODE_PREDICTION] = {FAULT_PREDICTION_NOT_OK, FAULT_PREDICTION_FAILED, FAULT_PREDICTION_STALLED,
                         FAULT_PREDICTION_LOW_RELIABILITY},
};

static void detect_nodes(const fault_sources *sources, fault_conditions *conditions)
{
    const node_limits limits = {
        .timeout_ms = milliseconds(sources, PARAMETER_NODE_TIMEOUT),
        .heartbeat_timeout_ms = milliseconds(sources, PARAMETER_NODE_HEARTBEAT_TIMEOUT),
        .min_reliability = parameters_real(sources->parameters, PARAMETER_NODE_MIN_RELIABILITY),
    };
    const uint32_t count = perception_required(sources) ? (uint32_t)NODE_COUNT : (uint32_t)NODE_PERCEPTION;
    for (uint32_t i = 0U; i < count; i++) {
        const node_row *row = &node_rows[i];
        const node_health health = node_monitor_check(sources->nodes, i, &limits, sources->now_us);
        set(conditions, row->not_ok, !health.ok, health.status_code);
        set(conditions, row->failed, health.failed, health.status_code);
        set(conditions, row->stalled, health.stalled, health.heartbeat);
        set(conditions, row->low_reliability, health.unreliable, whole(health.reliability));
    }
}

static void detect_autonomy_results(const fault_sources *sources, fault_conditions *conditions)
{
    const uint8_t quality = sources->estimate->quality;
    const bool fresh =
        estimate_receiver_fresh(sources->estimate, milliseconds(sources, PARAMETER_ESTIMATE_TIMEOUT), sources->now_us);
    set(conditions, FAULT_ESTIMATE_DEGRADED, fresh && quality == ESTIMATE_DEGRADED, quality);
    set(conditions, FAULT_ESTIMATE_BAD, fresh && quality == ESTIMATE_BAD, quality);
    set(conditions, FAULT_ESTIMATE_LOST, !fresh || quality == ESTIMATE_LOST, quality);

    const uint16_t wall_age_ms = wall_receiver_age_ms(sources->wall, sources->now_us);
    set(conditions, FAULT_WALL_MISSING, wall_age_ms > wall_receiver_timeout_ms(), wall_age_ms);

    const uint64_t age_ms = sources->plan != NULL ? (sources->now_us - sources->plan->received_us) / 1000U : UINT16_MAX;
    set(conditions, FAULT_PLAN_STALE, age_ms > milliseconds(sources, PARAMETER_PLAN_TIMEOUT), (uint32_t)age_ms);
}

/* The primary has parted from both backups, which need not agree with each other to the last bit either: two of three.
 */
static void detect_divergence(const fault_sources *sources, fault_conditions *conditions)
{
    const float *wish = sources->control->road_wheel_angle;
    const float limit = parameters_real(sources->parameters, PARAMETER_MAX_CONTROLLER_DEVIATION);
    const float deviation =
        fminf(fabsf(wish[CONTROL_LQR] - wish[CONTROL_STANLEY]), fabsf(wish[CONTROL_LQR] - wish[CONTROL_PURE_PURSUIT]));
    set(conditions, FAULT_LQR_DIVERGING, sources->control->lateral_valid && deviation > limit,
        whole(deviation * MILLI));
}

static void detect_control(const fault_sources *sources, fault_conditions *conditions)
{
    const control_output *control = sources->control;
    const bool valid = control->lateral_valid;
    const float deviation = fabsf(control->cross_track_error);
    set(conditions, FAULT_PATH_LEFT, deviation > parameters_real(sources->parameters, PARAMETER_MAX_CROSS_TRACK_ERROR),
        whole(deviation * CENTI));
    set(conditions, FAULT_LQR_INVALID, valid && !isfinite(control->road_wheel_angle[CONTROL_LQR]), 0U);
    set(conditions, FAULT_STANLEY_INVALID, valid && !isfinite(control->road_wheel_angle[CONTROL_STANLEY]), 0U);
    set(conditions, FAULT_PURE_PURSUIT_INVALID, valid && !isfinite(control->road_wheel_angle[CONTROL_PURE_PURSUIT]),
        0U);
    set(conditions, FAULT_COMMAND_INVALID, sources->dbw_violations != 0U, sources->dbw_violations);

    const float lateral = fabsf(sources->vehicle->control.wheel_speed * sources->estimate->estimate.yaw_rate);
    const float limit = parameters_real(sources->parameters, PARAMETER_MAX_LATERAL_ACCELERATION);
    set(conditions, FAULT_LATERAL_ACCELERATION_HIGH, lateral > limit, whole(lateral * CENTI));
}

/* A report contradicts the command of the cycle before; how long that may be is for the debounce to say. A report that
 * is missing contradicts nothing: its last value is old news, and its absence is a fault of its own. */
static void detect_deviation(const fault_sources *sources, fault_conditions *conditions, uint32_t fault,
                             uint32_t missing, float deviation, uint32_t limit, float scale)
{
    const bool above = deviation > parameters_real(sources->parameters, limit);
    set(conditions, fault, above && !conditions->present[missing], whole(deviation * scale));
}

/* Smallest difference between the wheels' speed and that of a live GNSS receiver, m/s; 0 without one. A receiver that
 * contradicts the wheels and the other receiver is no fault of the wheels. */
static float wheel_speed_deviation(const fault_sources *sources, const fault_conditions *conditions)
{
    const float wheels = sources->vehicle->control.wheel_speed;
    float deviation = INFINITY;
    for (uint32_t i = SENSOR_GNSS_A; i <= SENSOR_GNSS_B; i++) {
        if (!conditions->present[sensor_rows[i].timeout_fault]) {
            deviation = fminf(deviation, fabsf(wheels - sensor_monitor_ground_speed(sources->sensors, i)));
        }
    }
    return isfinite(deviation) ? deviation : 0.0f;
}

/* How much more throttle is reported than was commanded. Less is a shift or a limit of the engine's; more is dangerous,
 * wherever it comes from. */
static float throttle_excess(const fault_sources *sources, const fault_conditions *conditions)
{
    const vehicle_feedback *vehicle = sources->vehicle;
    const float asked = conditions->present[FAULT_ACCELERATOR_REPORT_MISSING] ? 0.0f : vehicle->accelerator;
    const float given = conditions->present[FAULT_POWERTRAIN_REPORT_MISSING] ? 0.0f : vehicle->throttle_position;
    return fmaxf(asked, given) - sources->dbw->throttle;
}

static void detect_disobedience(const fault_sources *sources, fault_conditions *conditions)
{
    const control_feedback *car = &sources->vehicle->control;
    const dbw_command *dbw = sources->dbw;
    detect_deviation(sources, conditions, FAULT_STEERING_IMPLAUSIBLE, FAULT_STEERING_REPORT_MISSING,
                     fabsf(car->road_wheel_angle - dbw->road_wheel_angle), PARAMETER_MAX_STEERING_DEVIATION, MILLI);
    detect_deviation(sources, conditions, FAULT_BRAKE_IMPLAUSIBLE, FAULT_BRAKE_REPORT_MISSING,
                     fabsf(car->brake_pressure - dbw->brake_pressure), PARAMETER_MAX_BRAKE_DEVIATION, PA_TO_KPA);
    detect_deviation(sources, conditions, FAULT_THROTTLE_IMPLAUSIBLE, FAULT_NONE, throttle_excess(sources, conditions),
                     PARAMETER_MAX_THROTTLE_EXCESS, CENTI);
    set(conditions, FAULT_GEAR_IMPLAUSIBLE,
        car->gear != dbw->gear && !conditions->present[FAULT_POWERTRAIN_REPORT_MISSING], car->gear);
    detect_deviation(sources, conditions, FAULT_WHEEL_SPEED_IMPLAUSIBLE, FAULT_WHEEL_SPEED_MISSING,
                     wheel_speed_deviation(sources, conditions), PARAMETER_MAX_WHEEL_SPEED_DEVIATION, CENTI);
}

/* Stuck counters; messages without a counter are left to their age and their values. */
static void detect_stuck_reports(const vehicle_feedback *vehicle, fault_conditions *conditions)
{
    set(conditions, FAULT_BRAKE_REPORT_STUCK, vehicle_feedback_stuck(vehicle, VEHICLE_BRAKE), 0U);
    set(conditions, FAULT_ACCELERATOR_REPORT_STUCK, vehicle_feedback_stuck(vehicle, VEHICLE_ACCELERATOR), 0U);
    set(conditions, FAULT_STEERING_REPORT_STUCK, vehicle_feedback_stuck(vehicle, VEHICLE_STEERING), 0U);
    set(conditions, FAULT_MISC_REPORT_STUCK, vehicle_feedback_stuck(vehicle, VEHICLE_MISC), 0U);
}

static void detect_report(const fault_sources *sources, fault_conditions *conditions, uint32_t fault, uint32_t report,
                          uint32_t timeout)
{
    const uint16_t age_ms = vehicle_feedback_age_ms(sources->vehicle, report, sources->now_us);
    set(conditions, fault, age_ms > milliseconds(sources, timeout), age_ms);
}

static void detect_vehicle(const fault_sources *sources, fault_conditions *conditions)
{
    detect_report(sources, conditions, FAULT_WHEEL_SPEED_MISSING, VEHICLE_WHEEL_SPEED, PARAMETER_WHEEL_SPEED_TIMEOUT);
    detect_report(sources, conditions, FAULT_BRAKE_REPORT_MISSING, VEHICLE_BRAKE, PARAMETER_BRAKE_REPORT_TIMEOUT);
    detect_report(sources, conditions, FAULT_STEERING_REPORT_MISSING, VEHICLE_STEERING,
                  PARAMETER_STEERING_REPORT_TIMEOUT);
    detect_report(sources, conditions, FAULT_MISC_REPORT_MISSING, VEHICLE_MISC, PARAMETER_MISC_REPORT_TIMEOUT);
    detect_report(sources, conditions, FAULT_POWERTRAIN_REPORT_MISSING, VEHICLE_POWERTRAIN,
                  PARAMETER_POWERTRAIN_REPORT_TIMEOUT);
    detect_report(sources, conditions, FAULT_DIAGNOSTIC_REPORT_MISSING, VEHICLE_DIAGNOSTIC,
                  PARAMETER_DIAGNOSTIC_REPORT_TIMEOUT);
    detect_report(sources, conditions, FAULT_ACCELERATOR_REPORT_MISSING, VEHICLE_ACCELERATOR,
                  PARAMETER_ACCELERATOR_REPORT_TIMEOUT);
    const uint16_t race_control_age_ms = vehicle_feedback_race_control_age_ms(sources->vehicle, sources->now_us);
    set(conditions, FAULT_RACE_CONTROL_LOST,
        race_control_age_ms > milliseconds(sources, PARAMETER_RACE_CONTROL_TIMEOUT), race_control_age_ms);
    const uint8_t sys_state = sources->vehicle->sys_state;
    const bool emergency = sys_state == SYS_EMERGENCY_SHUTDOWN || sys_state == SYS_CRITICAL_LIMIT_EXCEEDED;
    set(conditions, FAULT_RAPTOR_EMERGENCY, emergency || (sources->driving && sys_state != SYS_DRIVING), sys_state);
}

static void detect_diagnostic(const vehicle_diagnostic *diagnostic, fault_conditions *conditions)
{
    set(conditions, FAULT_SD_WARNING, diagnostic->sd_warning, 0U);
    set(conditions, FAULT_SD_FAILURE, diagnostic->sd_failure, 0U);
    set(conditions, FAULT_MOTEC_WARNING, diagnostic->motec_warning != 0U, diagnostic->motec_warning);
    set(conditions, FAULT_EST1_FRONT_BRAKE, diagnostic->est1_front_brake, 0U);
    set(conditions, FAULT_EST2_REAR_BRAKE, diagnostic->est2_rear_brake, 0U);
    set(conditions, FAULT_EST3_LOW_ENGINE_SPEED, diagnostic->est3_low_engine_speed, 0U);
    set(conditions, FAULT_EST4_SD_COMMS_LOSS, diagnostic->est4_sd_comms_loss, 0U);
    set(conditions, FAULT_EST5_MOTEC_COMMS_LOSS, diagnostic->est5_motec_comms_loss, 0U);
    set(conditions, FAULT_EST6_SD_EMERGENCY_BRAKE, diagnostic->est6_sd_emergency_brake, 0U);
    set(conditions, FAULT_ADLINK_HEARTBEAT_LOST, diagnostic->adlink_heartbeat_lost, 0U);
    set(conditions, FAULT_RAPTOR_LOST_RACE_CONTROL, diagnostic->race_control_lost, 0U);
}

void fault_detection_step(fault_detection *self, const fault_sources *sources, fault_conditions *conditions)
{
    memset(conditions, 0, sizeof *conditions);
    detect_parameters(self, sources, conditions);
    detect_executive(self, sources, conditions);
    detect_computer(sources, conditions);
    detect_launch(sources, conditions);
    detect_sensors(sources, conditions);
    detect_scans(sources, conditions);
    detect_nodes(sources, conditions);
    detect_autonomy_results(sources, conditions);
    detect_control(sources, conditions);
    detect_divergence(sources, conditions);
    detect_vehicle(sources, conditions);
    detect_stuck_reports(sources->vehicle, conditions);
    detect_disobedience(sources, conditions);
    detect_diagnostic(&sources->vehicle->diagnostic, conditions);
}
