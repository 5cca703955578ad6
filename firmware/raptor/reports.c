#include "raptor/reports.h"

#include <math.h>
#include <stddef.h>

#include "generated/raptor.h"

enum { TYRE_MESSAGES = 4 }; /* temperature messages per tyre */

static const float deg_per_rad = 57.2957795f;
static const float rpm_per_radps = 9.54929659f;
static const float kmh_per_mps = 3.6f;
static const float ambient_pressure = 101325.0f; /* Pa, between absolute and gauge */

/* What a report is made of. */
typedef struct report_source {
    const raptor *self;
    const raptor_wired_in *wired;
    uint64_t now_us;
    uint32_t id;
} report_source;

/* Fills the data of a report; false: nothing to tell, it stays away this time. */
typedef bool (*report_fill)(const report_source *source, uint8_t data[CAN_DATA_MAX]);

/* One row of the report schedule. It is sent in minor frames n with n % period == offset. */
typedef struct report_row {
    uint32_t id;
    uint8_t dlc;
    uint8_t period;
    uint8_t offset;
    report_fill fill;
} report_row;

/* Raw value of a physical one: saturated to minimum..maximum (physical), NaN gives the minimum. scale: of one bit. */
static int32_t raw(float value, float minimum, float maximum, float scale)
{
    codec_status status;
    return (int32_t)lroundf(codec_clamp(value, minimum, maximum, &status) / scale);
}

static uint8_t raw_u8(float value, float maximum, float scale)
{
    return (uint8_t)raw(value, 0.0f, maximum, scale);
}

static uint16_t raw_u16(float value, float maximum, float scale)
{
    return (uint16_t)raw(value, 0.0f, maximum, scale);
}

/* The message has no word for a failed sensor, and a 0 would be taken for a standstill: silence tells. */
static bool fill_wheel_speed(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const float *speed = source->self->wheel_speed;
    const struct raptor_wheel_speed_report_t message = {
        .wheel_speed_fl = raw_u16(speed[0] * kmh_per_mps, 340.0f, 0.1f),
        .wheel_speed_fr = raw_u16(speed[1] * kmh_per_mps, 340.0f, 0.1f),
        .wheel_speed_rl = raw_u16(speed[2] * kmh_per_mps, 340.0f, 0.1f),
        .wheel_speed_rr = raw_u16(speed[3] * kmh_per_mps, 340.0f, 0.1f),
    };
    return source->self->wheel_speeds_valid && raptor_wheel_speed_report_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_brake_pressure(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const struct raptor_brake_pressure_report_t message = {
        .brake_pressure_fdbk_front = raw_u16(source->wired->brake_pressure_front, 8.191e6f, 1000.0f),
        .brake_pressure_fdbk_rear = raw_u16(source->wired->brake_pressure_rear, 8.191e6f, 1000.0f),
    };
    return raptor_brake_pressure_report_pack(data, &message, CAN_DATA_MAX) >= 0;
}

/* The pedal that is in force, not the one commanded: 0 outside DRIVING. */
static bool fill_accelerator(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const struct raptor_accelerator_report_t message = {
        .acc_pedal_fdbk = raw_u16(source->self->demand.throttle * 100.0f, 100.0f, 0.1f),
    };
    return raptor_accelerator_report_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static int16_t raw_motor_angle(float angle)
{
    return (int16_t)raw(angle * deg_per_rad, -512.0f, 511.5f, 0.5f);
}

static bool fill_steering(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const struct raptor_steering_report_t message = {
        .steering_motor_ang_avg_fdbk = raw_motor_angle(source->self->gateway.steer.position),
    };
    return raptor_steering_report_pack(data, &message, CAN_DATA_MAX) >= 0;
}

/* The three sensors; one that is not valid shows its last valid angle, and its sd_steer_warning is set. */
static bool fill_steering_extended(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const raptor_gateway_channel *channels = source->self->gateway.steer.channels;
    const struct raptor_steering_report_extd_t message = {
        .steering_motor_ang_1_fdbk = raw_motor_angle(channels[0].position),
        .steering_motor_ang_2_fdbk = raw_motor_angle(channels[1].position),
        .steering_motor_ang_3_fdbk = raw_motor_angle(channels[2].position),
    };
    return raptor_steering_report_extd_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_misc(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const struct raptor_misc_report_t message = {
        .battery_voltage = raw_u8(source->wired->battery_voltage, 25.5f, 0.1f),
        .sys_state = source->self->sys.state,
        .mode_switch_state = source->wired->mode_switch,
        .safety_switch_state = source->wired->safety_switch & 7U,
    };
    return raptor_misc_report_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_wheel_load(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const float *load = source->wired->wheel_load;
    const struct raptor_wheel_strain_gauge_t message = {
        .wheel_strain_gauge_fl = raw_u16(load[0], 8190.0f, 10.0f),
        .wheel_strain_gauge_fr = raw_u16(load[1], 8190.0f, 10.0f),
        .wheel_strain_gauge_rl = raw_u16(load[2], 8190.0f, 10.0f),
        .wheel_strain_gauge_rr = raw_u16(load[3], 8190.0f, 10.0f),
    };
    return raptor_wheel_strain_gauge_pack(data, &message, CAN_DATA_MAX) >= 0;
}

/* 0.01 mm; this message alone has the rear wheels in the order right, left. */
static bool fill_suspension(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const float *travel = source->wired->suspension_travel;
    const struct raptor_wheel_potentiometer_data_t message = {
        .wheel_potentiometer_fl = raw_u16(travel[0], 0.65535f, 1.0e-5f),
        .wheel_potentiometer_fr = raw_u16(travel[1], 0.65535f, 1.0e-5f),
        .wheel_potentiometer_rr = raw_u16(travel[3], 0.65535f, 1.0e-5f),
        .wheel_potentiometer_rl = raw_u16(travel[2], 0.65535f, 1.0e-5f),
    };
    return raptor_wheel_potentiometer_data_pack(data, &message, CAN_DATA_MAX) >= 0;
}

/* The four pressure messages and the sixteen temperature messages have one layout each; ids run tyre by tyre. */
static bool fill_tyre_pressure(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const float pressure = source->wired->tyre_pressure[source->id - RAPTOR_TIRE_PRESSURE_FL_FRAME_ID];
    const struct raptor_tire_pressure_fl_t message = {
        .fl_tire_pressure = raw_u16(pressure, 6.5535e6f, 100.0f),
        .fl_tire_pressure_gauge = raw_u16(pressure - ambient_pressure, 6.5535e6f, 100.0f),
    };
    return pressure > 0.0f && raptor_tire_pressure_fl_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_tyre_temperature(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const uint32_t tyre = (source->id - RAPTOR_TIRE_TEMP_FL_1_FRAME_ID) / TYRE_MESSAGES;
    const uint16_t value = (uint16_t)raw(source->wired->tyre_temperature[tyre] + 100.0f, 0.0f, 6553.5f, 0.1f);
    const struct raptor_tire_temp_fl_1_t message = {value, value, value, value};
    return raptor_tire_temp_fl_1_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_powertrain_1(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const raptor_wired_in *wired = source->wired;
    const struct raptor_pt_report_1_t message = {
        .engine_run_switch = source->self->demand.ignition,
        .engine_state = wired->engine_running,
        .throttle_position = raw_u16(wired->throttle_position * 100.0f, 100.0f, 0.1f),
        .current_gear = wired->gear,
        .engine_speed_rpm = raw_u16(wired->engine_speed * rpm_per_radps, 16000.0f, 1.0f),
        .vehicle_speed_kmph = raw_u16(source->self->speed * kmh_per_mps, 6553.5f, 0.1f),
        .gear_shift_status = wired->gear_shift_status & 7U,
    };
    return raptor_pt_report_1_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_powertrain_2(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const raptor_wired_in *wired = source->wired;
    const struct raptor_pt_report_2_t message = {
        .fuel_pressure_k_pa = raw_u16(wired->fuel_pressure, 1.0e6f, 100.0f),
        .engine_oil_pressure_k_pa = raw_u16(wired->oil_pressure, 6.5535e6f, 100.0f),
        .coolant_temperature = raw_u8(wired->coolant_temperature, 255.0f, 1.0f),
        .transmission_temperature = raw_u8(wired->transmission_temperature, 255.0f, 1.0f),
        .transmission_pressure_k_pa = raw_u16(wired->transmission_pressure, 6.5535e7f, 1000.0f),
    };
    return raptor_pt_report_2_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_powertrain_3(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const struct raptor_pt_report_3_t message = {
        .engine_oil_temperature = raw_u8(source->wired->oil_temperature, 255.0f, 1.0f),
        .torque_wheels = (int16_t)raw(source->wired->wheel_torque, -3276.8f, 3276.7f, 0.1f),
        .driver_traction_aim_swicth_fbk = source->self->commands.command.traction_aim,
        .driver_traction_range_switch_fbk = source->self->commands.command.traction_range,
    };
    return raptor_pt_report_3_pack(data, &message, CAN_DATA_MAX) >= 0;
}

/* enum raptor_diagnostic_bit has the places of the wire. motec_warning stays 0: there is no engine bus. */
static bool fill_diagnostic(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const uint32_t bits = source->self->diagnostic.bits;

    data[0] = (uint8_t)bits;
    data[2] = (uint8_t)(bits >> 16U);
    return true;
}

/* Race control is relayed while its radio link stands. Silence is what tells the onboard computer that it fell. */
static bool fill_race_control(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const raptor_race_control *race = &source->wired->race_control;
    const struct raptor_base_to_car_summary_t message = {
        .base_to_car_heartbeat = race->heartbeat & 15U,
        .track_flag = race->track_flag & 15U,
        .veh_flag = race->vehicle_flag & 15U,
        .veh_rank = race->rank & 15U,
        .round_target_speed = race->round_target_speed,
        .lap_count = race->lap_count,
        .lap_distance = race->lap_distance,
    };
    return race->linked && raptor_base_to_car_summary_pack(data, &message, CAN_DATA_MAX) >= 0;
}

static bool fill_timing(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const raptor_race_control *race = &source->wired->race_control;
    const struct raptor_base_to_car_timing_t message = {
        .laps = race->lap_count,
        .lap_time = (uint32_t)raw(race->lap_time, 0.0f, 1677.7215f, 1.0e-4f),
        .time_stamp = (uint32_t)(source->now_us / 100U),
    };
    return race->linked && raptor_base_to_car_timing_pack(data, &message, CAN_DATA_MAX) >= 0;
}

/* Always sent: its sync check is how a lost link is told. */
static bool fill_marelli(const report_source *source, uint8_t data[CAN_DATA_MAX])
{
    const raptor_race_control *race = &source->wired->race_control;
    const struct raptor_marelli_report_1_t message = {
        .marelli_track_flag = race->marelli_track_flag,
        .marelli_vehicle_flag = race->marelli_vehicle_flag,
        .marelli_sector_flag = race->marelli_sector_flag,
        .marelli_rc_base_sync_check = race->linked,
    };
    return raptor_marelli_report_1_pack(data, &message, CAN_DATA_MAX) >= 0;
}

#define REPORT(name, period, offset, fill) {RAPTOR_##name##_FRAME_ID, RAPTOR_##name##_LENGTH, period, offset, fill}
#define TYRE_PRESSURE(name, offset)        REPORT(TIRE_PRESSURE_##name, 10, offset, fill_tyre_pressure)
#define TYRE_TEMPERATURE(name, offset)     REPORT(TIRE_TEMP_##name, 10, offset, fill_tyre_temperature)

/* Two tyre frames and at most one other 10 Hz frame per minor frame: an even load instead of a burst. */
static const report_row rows[RAPTOR_REPORTS] = {
    REPORT(WHEEL_SPEED_REPORT, 1, 0, fill_wheel_speed),
    REPORT(BRAKE_PRESSURE_REPORT, 1, 0, fill_brake_pressure),
    REPORT(ACCELERATOR_REPORT, 1, 0, fill_accelerator),
    REPORT(STEERING_REPORT, 1, 0, fill_steering),
    REPORT(MISC_REPORT, 1, 0, fill_misc),
    REPORT(WHEEL_STRAIN_GAUGE, 1, 0, fill_wheel_load),
    REPORT(WHEEL_POTENTIOMETER_DATA, 2, 1, fill_suspension),
    REPORT(STEERING_REPORT_EXTD, 1, 0, fill_steering_extended),
    REPORT(PT_REPORT_1, 1, 0, fill_powertrain_1),
    REPORT(DIAGNOSTIC_REPORT, 1, 0, fill_diagnostic),
    REPORT(BASE_TO_CAR_SUMMARY, 10, 0, fill_race_control),
    REPORT(BASE_TO_CAR_TIMING, 10, 2, fill_timing),
    REPORT(MARELLI_REPORT_1, 10, 4, fill_marelli),
    REPORT(PT_REPORT_2, 10, 6, fill_powertrain_2),
    REPORT(PT_REPORT_3, 10, 8, fill_powertrain_3),
    TYRE_PRESSURE(FL, 0),
    TYRE_PRESSURE(FR, 0),
    TYRE_PRESSURE(RL, 1),
    TYRE_PRESSURE(RR, 1),
    TYRE_TEMPERATURE(FL_1, 2),
    TYRE_TEMPERATURE(FL_2, 2),
    TYRE_TEMPERATURE(FL_3, 3),
    TYRE_TEMPERATURE(FL_4, 3),
    TYRE_TEMPERATURE(FR_1, 4),
    TYRE_TEMPERATURE(FR_2, 4),
    TYRE_TEMPERATURE(FR_3, 5),
    TYRE_TEMPERATURE(FR_4, 5),
    TYRE_TEMPERATURE(RL_1, 6),
    TYRE_TEMPERATURE(RL_2, 6),
    TYRE_TEMPERATURE(RL_3, 7),
    TYRE_TEMPERATURE(RL_4, 7),
    TYRE_TEMPERATURE(RR_1, 8),
    TYRE_TEMPERATURE(RR_2, 8),
    TYRE_TEMPERATURE(RR_3, 9),
    TYRE_TEMPERATURE(RR_4, 9),
};

void raptor_reports_send(raptor *self, const raptor_wired_in *wired, uint64_t frame, uint64_t now_us, can_outbox *out)
{
    for (uint32_t i = 0; i < RAPTOR_REPORTS; i++) {
        const report_row *row = &rows[i];
        const report_source source = {.self = self, .wired = wired, .now_us = now_us, .id = row->id};
        uint8_t data[CAN_DATA_MAX] = {0};
        if (frame % row->period != row->offset || !row->fill(&source, data)) {
            continue;
        }
        can_frame *message = can_outbox_add(out, (uint8_t)CAN_BUS_1, row->id, 0, row->dlc);
        if (message == NULL) {
            return;
        }
        for (uint32_t byte = 0; byte < row->dlc; byte++) {
            message->data[byte] = data[byte];
        }
        codec_finish(message, codec_find((uint8_t)CAN_BUS_1, row->id, false), &self->report_counters[i]);
    }
}
