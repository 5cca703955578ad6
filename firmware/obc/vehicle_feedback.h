/* What the Raptor reports on CAN1: the car's motion and drive train, diagnostics, and race control's flags. */
#ifndef RACELOOP_OBC_VEHICLE_FEEDBACK_H
#define RACELOOP_OBC_VEHICLE_FEEDBACK_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "obc/control.h"

/* Reports that the onboard computer uses. */
enum vehicle_report {
    VEHICLE_WHEEL_SPEED = 0,
    VEHICLE_BRAKE = 1,
    VEHICLE_STEERING = 2,
    VEHICLE_MISC = 3,
    VEHICLE_POWERTRAIN = 4,
    VEHICLE_DIAGNOSTIC = 5,
    VEHICLE_RACE_CONTROL = 6,
    VEHICLE_MARELLI = 7,
    VEHICLE_ACCELERATOR = 8,
    VEHICLE_REPORT_COUNT = 9,
};

/* diagnostic_report, bit by bit. */
typedef struct vehicle_diagnostic {
    bool sd_warning; /* any warning of the Space Drive: system, brake or steering channel */
    bool sd_failure;
    uint8_t motec_warning;
    bool est1_front_brake;
    bool est2_rear_brake;
    bool est3_low_engine_speed;
    bool est4_sd_comms_loss;
    bool est5_motec_comms_loss;
    bool est6_sd_emergency_brake;
    bool adlink_heartbeat_lost;
    bool race_control_lost;
} vehicle_diagnostic;

/* Race control as the Raptor relays it. */
typedef struct vehicle_race_control {
    uint8_t heartbeat;
    uint64_t progress_us; /* newest change of the heartbeat; 0: never */
    uint8_t track_flag;   /* MyLaps codes */
    uint8_t vehicle_flag;
    uint8_t round_target_speed; /* mph */
    uint8_t marelli_track_flag;
    uint8_t marelli_vehicle_flag;
    uint8_t marelli_sector_flag;
} vehicle_race_control;

/* Newest content of all reports: zero it to start. */
typedef struct vehicle_feedback {
    codec_rx rx[VEHICLE_REPORT_COUNT];
    control_feedback control;
    vehicle_diagnostic diagnostic;
    vehicle_race_control race_control;
    float accelerator;       /* 0..1, what the Raptor asks of the engine */
    float throttle_position; /* 0..1, what the engine reports */
    uint8_t sys_state;
} vehicle_feedback;

/* Take a frame from CAN1; frames of no used report are ignored, bad ones counted and dropped.
 * steering_ratio: motor angle over road-wheel angle, above 0. now_us: time of the tick, monotonic. */
void vehicle_feedback_push(vehicle_feedback *self, const can_frame *frame, float steering_ratio, uint64_t now_us);

/* Age of a report's newest valid frame in ms, saturating; 65535 when there was none.
 * report: enum vehicle_report below VEHICLE_REPORT_COUNT. */
uint16_t vehicle_feedback_age_ms(const vehicle_feedback *self, uint32_t report, uint64_t now_us);

/* True when the newest frame of a report repeated the counter of the one before it. */
bool vehicle_feedback_stuck(const vehicle_feedback *self, uint32_t report);

/* Time without progress of race control's heartbeat in ms, saturating; 65535 when there was none. */
uint16_t vehicle_feedback_race_control_age_ms(const vehicle_feedback *self, uint64_t now_us);

#endif
