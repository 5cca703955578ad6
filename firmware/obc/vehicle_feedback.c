#include "obc/vehicle_feedback.h"

#include "generated/raptor.h"

#define KMH_TO_MS    (1.0f / 3.6f)
#define DEGREE       (3.14159265f / 180.0f)
#define RPM_TO_RAD_S (3.14159265f / 30.0f)
#define KPA_TO_PA    1000.0f
#define PERCENT      0.01f

static void take_wheel_speed(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_wheel_speed_report_t report;
    (void)raptor_wheel_speed_report_unpack(&report, data, CAN_DATA_MAX);
    const double left = raptor_wheel_speed_report_wheel_speed_fl_decode(report.wheel_speed_fl);
    const double right = raptor_wheel_speed_report_wheel_speed_fr_decode(report.wheel_speed_fr);
    self->control.wheel_speed = 0.5f * ((float)left + (float)right) * KMH_TO_MS;
}

static void take_brake(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_brake_pressure_report_t report;
    (void)raptor_brake_pressure_report_unpack(&report, data, CAN_DATA_MAX);
    self->control.brake_pressure = (float)report.brake_pressure_fdbk_front * KPA_TO_PA;
}

static void take_steering(vehicle_feedback *self, const uint8_t *data, float steering_ratio)
{
    struct raptor_steering_report_t report;
    (void)raptor_steering_report_unpack(&report, data, CAN_DATA_MAX);
    const double motor_deg =
        raptor_steering_report_steering_motor_ang_avg_fdbk_decode(report.steering_motor_ang_avg_fdbk);
    self->control.road_wheel_angle = (float)motor_deg * DEGREE / steering_ratio;
}

static void take_misc(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_misc_report_t report;
    (void)raptor_misc_report_unpack(&report, data, CAN_DATA_MAX);
    self->sys_state = report.sys_state;
}

static void take_powertrain(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_pt_report_1_t report;
    (void)raptor_pt_report_1_unpack(&report, data, CAN_DATA_MAX);
    self->control.engine_speed = (float)report.engine_speed_rpm * RPM_TO_RAD_S;
    self->control.gear = report.current_gear;
    self->control.gear_shift_status = report.gear_shift_status;
    self->control.engine_running = report.engine_state != 0U;
    self->throttle_position = (float)raptor_pt_report_1_throttle_position_decode(report.throttle_position) * PERCENT;
}

static void take_accelerator(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_accelerator_report_t report;
    (void)raptor_accelerator_report_unpack(&report, data, CAN_DATA_MAX);
    self->accelerator = (float)raptor_accelerator_report_acc_pedal_fdbk_decode(report.acc_pedal_fdbk) * PERCENT;
}

static void take_diagnostic(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_diagnostic_report_t report;
    (void)raptor_diagnostic_report_unpack(&report, data, CAN_DATA_MAX);
    const uint32_t warnings = (uint32_t)report.sd_system_warning | report.sd_brake_warning1 | report.sd_brake_warning2 |
                              report.sd_brake_warning3 | report.sd_steer_warning1 | report.sd_steer_warning2 |
                              report.sd_steer_warning3;
    self->diagnostic = (vehicle_diagnostic){
        .sd_warning = warnings != 0U,
        .sd_failure = report.sd_system_failure != 0U,
        .motec_warning = report.motec_warning,
        .est1_front_brake = report.est1_oos_front_brk != 0U,
        .est2_rear_brake = report.est2_oos_rear_brk != 0U,
        .est3_low_engine_speed = report.est3_low_eng_speed != 0U,
        .est4_sd_comms_loss = report.est4_sd_comms_loss != 0U,
        .est5_motec_comms_loss = report.est5_motec_comms_loss != 0U,
        .est6_sd_emergency_brake = report.est6_sd_ebrake != 0U,
        .adlink_heartbeat_lost = report.adlink_hb_lost != 0U,
        .race_control_lost = report.rc_lost != 0U,
    };
}

static void take_race_control(vehicle_feedback *self, const uint8_t *data, uint64_t now_us)
{
    struct raptor_base_to_car_summary_t report;
    (void)raptor_base_to_car_summary_unpack(&report, data, CAN_DATA_MAX);
    vehicle_race_control *race = &self->race_control;
    if (race->progress_us == 0U || report.base_to_car_heartbeat != race->heartbeat) {
        race->progress_us = now_us;
    }
    race->heartbeat = report.base_to_car_heartbeat;
    race->track_flag = report.track_flag;
    race->vehicle_flag = report.veh_flag;
    race->round_target_speed = report.round_target_speed;
}

static void take_marelli(vehicle_feedback *self, const uint8_t *data)
{
    struct raptor_marelli_report_1_t report;
    (void)raptor_marelli_report_1_unpack(&report, data, CAN_DATA_MAX);
    self->race_control.marelli_track_flag = report.marelli_track_flag;
    self->race_control.marelli_vehicle_flag = report.marelli_vehicle_flag;
    self->race_control.marelli_sector_flag = report.marelli_sector_flag;
}

/* Which report a frame is, or VEHICLE_REPORT_COUNT. */
static uint32_t report_of(uint32_t id)
{
    switch (id) {
    case RAPTOR_WHEEL_SPEED_REPORT_FRAME_ID:
        return VEHICLE_WHEEL_SPEED;
    case RAPTOR_BRAKE_PRESSURE_REPORT_FRAME_ID:
        return VEHICLE_BRAKE;
    case RAPTOR_STEERING_REPORT_FRAME_ID:
        return VEHICLE_STEERING;
    case RAPTOR_MISC_REPORT_FRAME_ID:
        return VEHICLE_MISC;
    case RAPTOR_PT_REPORT_1_FRAME_ID:
        return VEHICLE_POWERTRAIN;
    case RAPTOR_DIAGNOSTIC_REPORT_FRAME_ID:
        return VEHICLE_DIAGNOSTIC;
    case RAPTOR_BASE_TO_CAR_SUMMARY_FRAME_ID:
        return VEHICLE_RACE_CONTROL;
    case RAPTOR_MARELLI_REPORT_1_FRAME_ID:
        return VEHICLE_MARELLI;
    case RAPTOR_ACCELERATOR_REPORT_FRAME_ID:
        return VEHICLE_ACCELERATOR;
    default:
        return VEHICLE_REPORT_COUNT;
    }
}

void vehicle_feedback_push(vehicle_feedback *self, const can_frame *frame, float steering_ratio, uint64_t now_us)
{
    const uint32_t report = report_of(frame->id);
    if (report == VEHICLE_REPORT_COUNT || codec_receive(&self->rx[report], frame, now_us) != CODEC_OK) {
        return;
    }
    switch (report) {
    case VEHICLE_WHEEL_SPEED:
        take_wheel_speed(self, frame->data);
        break;
    case VEHICLE_BRAKE:
        take_brake(self, frame->data);
        break;
    case VEHICLE_STEERING:
        take_steering(self, frame->data, steering_ratio);
        break;
    case VEHICLE_MISC:
        take_misc(self, frame->data);
        break;
    case VEHICLE_POWERTRAIN:
        take_powertrain(self, frame->data);
        break;
    case VEHICLE_DIAGNOSTIC:
        take_diagnostic(self, frame->data);
        break;
    case VEHICLE_RACE_CONTROL:
        take_race_control(self, frame->data, now_us);
        break;
    case VEHICLE_ACCELERATOR:
        take_accelerator(self, frame->data);
        break;
    default:
        take_marelli(self, frame->data);
        break;
    }
}

static uint16_t age_ms(bool seen, uint64_t since_us, uint64_t now_us)
{
    const uint64_t age = seen ? (now_us - since_us) / 1000U : UINT16_MAX;
    return age < UINT16_MAX ? (uint16_t)age : UINT16_MAX;
}

uint16_t vehicle_feedback_age_ms(const vehicle_feedback *self, uint32_t report, uint64_t now_us)
{
    return age_ms(self->rx[report].seen, self->rx[report].last_valid_us, now_us);
}

bool vehicle_feedback_stuck(const vehicle_feedback *self, uint32_t report)
{
    return self->rx[report].last_status == CODEC_COUNTER_STUCK;
}

uint16_t vehicle_feedback_race_control_age_ms(const vehicle_feedback *self, uint64_t now_us)
{
    return age_ms(self->rx[VEHICLE_RACE_CONTROL].seen, self->race_control.progress_us, now_us);
}
