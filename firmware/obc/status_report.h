/* Frames that the onboard computer sends on CAN-A: its state, the car's, control's, verdicts, faults and statistics. */
#ifndef RACELOOP_OBC_STATUS_REPORT_H
#define RACELOOP_OBC_STATUS_REPORT_H

#include <stdint.h>

#include "common/can_frame.h"
#include "common/executive.h"
#include "obc/control.h"
#include "obc/parameters.h"
#include "obc/ssm.h"

/* Content of vehicle_status. */
typedef struct status_vehicle {
    float wheel_speed; /* m/s */
    uint8_t ct_state;
    uint8_t sys_state;
    uint8_t track_flag;
    uint8_t vehicle_flag;
    uint8_t gear;
    uint8_t round_target_speed; /* mph */
    uint8_t plan_in_use;        /* plan_counter, 0..15 */
} status_vehicle;

/* Message counters and turns: zero it to start. */
typedef struct status_report {
    uint8_t ssm_counter;
    uint8_t vehicle_counter;
    uint8_t control_counter;
    uint8_t summary_counter;
    uint8_t task; /* whose statistics are next */
} status_report;

/* Send ssm_status, vehicle_status or control_status (100 Hz each). Values beyond a field's range are clamped to it. */
void status_report_ssm(status_report *self, const ssm_output *ssm, can_outbox *out);
void status_report_vehicle(status_report *self, const status_vehicle *vehicle, can_outbox *out);
void status_report_control(status_report *self, const control_output *control, can_outbox *out);

/* Send fault_event and parameter_result frames, as many as are waiting but at most `most` of each. */
void status_report_faults(fault_monitor *faults, uint32_t most, can_outbox *out);
void status_report_results(parameters *source, uint32_t most, can_outbox *out);

/* Send parameter_summary (10 Hz). */
void status_report_summary(status_report *self, const parameters *source, can_outbox *out);

/* Send executive_statistics and executive_task for the next task in turn (10 Hz).
 * table, count: the executive's schedule; count at least 1. */
void status_report_executive(status_report *self, const executive *source, const executive_task *table, uint32_t count,
                             can_outbox *out);

#endif
