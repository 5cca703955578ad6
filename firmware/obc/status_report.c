#include "obc/status_report.h"

#include <stddef.h>

#include "common/codec.h"
#include "generated/autonomy.h"
#include "generated/codec_table.h"

/* Ends of the fields on the wire. */
#define SPEED_LIMIT_MAX        204.75f
#define ACCELERATION_LIMIT_MAX 25.5f
#define WHEEL_SPEED_MAX        327.675f
#define CROSS_TRACK_MAX        32.767f
#define HEADING_ERROR_MAX      4.0955f
#define SPEED_ERROR_MAX        81.91f
#define ROAD_WHEEL_MAX         1.0235f

enum {
    FRAMES_MASK = 0xFFFFFF,
    COUNT_12_MAX = 0xFFF,
};

static double within(float value, float minimum, float maximum)
{
    codec_status status = CODEC_OK;
    return (double)codec_clamp(value, minimum, maximum, &status);
}

static uint16_t saturate(uint32_t value, uint16_t maximum)
{
    return value < maximum ? (uint16_t)value : maximum;
}

static can_frame *add(can_outbox *out, const codec_message *message)
{
    return can_outbox_add(out, message->bus, message->id, 0U, message->dlc);
}

void status_report_ssm(status_report *self, const ssm_output *ssm, can_outbox *out)
{
    const codec_message *message = &codec_table[CODEC_AUTONOMY_SSM_STATUS];
    can_frame *frame = add(out, message);
    if (frame == NULL) {
        return;
    }
    const ssm_limits *limits = &ssm->limits;
    const struct autonomy_ssm_status_t status = {
        .ssm_state = ssm->state,
        .ssm_reaction = ssm->reaction,
        .ssm_active_faults = ssm->active_faults,
        .ssm_worst_fault = ssm->worst_fault,
        .ssm_controller = ssm->controller,
        .ssm_max_speed = autonomy_ssm_status_ssm_max_speed_encode(within(limits->max_speed, 0.0f, SPEED_LIMIT_MAX)),
        .ssm_max_acceleration = autonomy_ssm_status_ssm_max_acceleration_encode(
            within(limits->max_acceleration, 0.0f, ACCELERATION_LIMIT_MAX)),
        .ssm_max_deceleration = autonomy_ssm_status_ssm_max_deceleration_encode(
            within(limits->max_deceleration, 0.0f, ACCELERATION_LIMIT_MAX)),
    };
    (void)autonomy_ssm_status_pack(frame->data, &status, CAN_DATA_MAX);
    codec_finish(frame, message, &self->ssm_counter);
}

void status_report_vehicle(status_report *self, const status_vehicle *vehicle, can_outbox *out)
{
    const codec_message *message = &codec_table[CODEC_AUTONOMY_VEHICLE_STATUS];
    can_frame *frame = add(out, message);
    if (frame == NULL) {
        return;
    }
    const struct autonomy_vehicle_status_t status = {
        .obc_ct_state = vehicle->ct_state,
        .obc_sys_state = vehicle->sys_state,
        .obc_track_flag = vehicle->track_flag,
        .obc_veh_flag = vehicle->vehicle_flag,
        .obc_wheel_speed =
            autonomy_vehicle_status_obc_wheel_speed_encode(within(vehicle->wheel_speed, 0.0f, WHEEL_SPEED_MAX)),
        .obc_gear = vehicle->gear,
        .obc_round_target_speed = vehicle->round_target_speed,
        .obc_plan_in_use = vehicle->plan_in_use,
    };
    (void)autonomy_vehicle_status_pack(frame->data, &status, CAN_DATA_MAX);
    codec_finish(frame, message, &self->vehicle_counter);
}

void status_report_control(status_report *self, const control_output *control, can_outbox *out)
{
    const codec_message *message = &codec_table[CODEC_AUTONOMY_CONTROL_STATUS];
    can_frame *frame = add(out, message);
    if (frame == NULL) {
        return;
    }
    const struct autonomy_control_status_t status = {
        .control_cross_track_error = autonomy_control_status_control_cross_track_error_encode(
            within(control->cross_track_error, -CROSS_TRACK_MAX, CROSS_TRACK_MAX)),
        .control_heading_error = autonomy_control_status_control_heading_error_encode(
            within(control->heading_error, -HEADING_ERROR_MAX, HEADING_ERROR_MAX)),
        .control_speed_error = autonomy_control_status_control_speed_error_encode(
            within(control->speed_error, -SPEED_ERROR_MAX, SPEED_ERROR_MAX)),
        .control_road_wheel_command = autonomy_control_status_control_road_wheel_command_encode(
            within(control->road_wheel_command, -ROAD_WHEEL_MAX, ROAD_WHEEL_MAX)),
    };
    (void)autonomy_control_status_pack(frame->data, &status, CAN_DATA_MAX);
    codec_finish(frame, message, &self->control_counter);
}

void status_report_faults(fault_monitor *faults, uint32_t most, can_outbox *out)
{
    fault_event event;
    for (uint32_t i = 0U; i < most && out->count < out->capacity && fault_monitor_next_event(faults, &event); i++) {
        can_frame *frame = add(out, &codec_table[CODEC_AUTONOMY_FAULT_EVENT]);
        const fault_row *row = &fault_table[event.id];
        const struct autonomy_fault_event_t content = {
            .fault_id = event.id,
            .fault_active = event.active ? 1U : 0U,
            .fault_latched = row->latch != FAULT_LATCH_WHILE_PRESENT ? 1U : 0U,
            .fault_reaction = row->reaction,
            .fault_detail = event.detail,
            .fault_time = event.time_ms,
        };
        (void)autonomy_fault_event_pack(frame->data, &content, CAN_DATA_MAX);
    }
}

void status_report_results(parameters *source, uint32_t most, can_outbox *out)
{
    parameter_result result;
    for (uint32_t i = 0U; i < most && out->count < out->capacity && parameters_next_result(source, &result); i++) {
        can_frame *frame = add(out, &codec_table[CODEC_AUTONOMY_PARAMETER_RESULT]);
        const struct autonomy_parameter_result_t content = {
            .result_key = result.key,
            .result_status = result.status,
            .result_value = result.value,
        };
        (void)autonomy_parameter_result_pack(frame->data, &content, CAN_DATA_MAX);
    }
}

void status_report_summary(status_report *self, const parameters *source, can_outbox *out)
{
    const codec_message *message = &codec_table[CODEC_AUTONOMY_PARAMETER_SUMMARY];
    can_frame *frame = add(out, message);
    if (frame == NULL) {
        return;
    }
    /* The verdict comes after all the results, so that who waits for it has them. */
    const bool told = source->result_count == 0U;
    const struct autonomy_parameter_summary_t summary = {
        .summary_accepted = source->accepted,
        .summary_rejected = source->rejected,
        .summary_missing = source->missing,
        .summary_verdict = told ? source->verdict : (uint8_t)PARAMETER_VERDICT_PENDING,
    };
    (void)autonomy_parameter_summary_pack(frame->data, &summary, CAN_DATA_MAX);
    codec_finish(frame, message, &self->summary_counter);
}

void status_report_executive(status_report *self, const executive *source, const executive_task *table, uint32_t count,
                             can_outbox *out)
{
    can_frame *frame = add(out, &codec_table[CODEC_AUTONOMY_EXECUTIVE_STATISTICS]);
    if (frame == NULL) {
        return;
    }
    const struct autonomy_executive_statistics_t statistics = {
        .executive_frames = (uint32_t)(source->frame & FRAMES_MASK),
        .executive_overruns = saturate(source->overruns, COUNT_12_MAX),
        .executive_late_frames = saturate(source->late_frames, COUNT_12_MAX),
        .executive_worst_frame = saturate(source->worst_frame_us, UINT16_MAX),
    };
    (void)autonomy_executive_statistics_pack(frame->data, &statistics, CAN_DATA_MAX);

    frame = add(out, &codec_table[CODEC_AUTONOMY_EXECUTIVE_TASK]);
    if (frame == NULL) {
        return;
    }
    self->task = (uint8_t)(self->task < count ? self->task : 0U);
    const executive_record *record = &source->records[self->task];
    const struct autonomy_executive_task_t task = {
        .task_index = self->task,
        .task_budget = saturate(table[self->task].budget_us, UINT16_MAX),
        .task_worst = saturate(record->worst_us, UINT16_MAX),
        .task_overruns = saturate(record->overruns, UINT16_MAX),
    };
    (void)autonomy_executive_task_pack(frame->data, &task, CAN_DATA_MAX);
    self->task++;
}
