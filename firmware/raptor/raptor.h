/* Raptor vehicle controller: sys_state machine, supervision of the onboard computer's commands, reports on
 * CAN1, gateway to the Space Drive on CAN3.
 */
#ifndef RACELOOP_RAPTOR_H
#define RACELOOP_RAPTOR_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "common/dbw_profile.h"
#include "common/executive.h"
#include "raptor/actuation_test.h"
#include "raptor/command_monitor.h"
#include "raptor/config.h"
#include "raptor/demand.h"
#include "raptor/diagnostic.h"
#include "raptor/gateway.h"
#include "raptor/states.h"
#include "raptor/sys_state.h"

enum { RAPTOR_REPORTS = 35 }; /* messages that the Raptor sends on CAN1 */

/* Race control as the car's radio delivers it. */
typedef struct raptor_race_control {
    bool linked;                /* a telegram arrived within the radio's own time-out */
    uint8_t heartbeat;          /* 0..15, moves with every telegram (10 Hz) */
    uint8_t track_flag;         /* MyLaps code, 0..15 */
    uint8_t vehicle_flag;       /* MyLaps code, 0..15 */
    uint8_t rank;               /* 0..15 */
    uint8_t round_target_speed; /* mph */
    uint8_t lap_count;
    uint16_t lap_distance; /* m */
    float lap_time;        /* s, last lap */
    uint8_t marelli_track_flag;
    uint8_t marelli_vehicle_flag;
    uint8_t marelli_sector_flag;
} raptor_race_control;

/* Signals wired to the Raptor. SI units; order of wheels FL, FR, RL, RR. */
typedef struct raptor_wired_in {
    float wheel_speed[4];           /* rad/s */
    float wheel_load[4];            /* N, strain gauges */
    float suspension_travel[4];     /* m, potentiometers; 0 at full droop, positive when compressed */
    float engine_speed;             /* rad/s */
    float throttle_position;        /* 0..1 */
    float wheel_torque;             /* Nm, driven wheels together */
    float brake_pressure_front;     /* Pa */
    float brake_pressure_rear;      /* Pa */
    float fuel_pressure;            /* Pa */
    float oil_pressure;             /* Pa */
    float transmission_pressure;    /* Pa */
    float coolant_temperature;      /* degC */
    float oil_temperature;          /* degC */
    float transmission_temperature; /* degC */
    float tyre_temperature[4];      /* degC */
    float tyre_pressure[4];         /* Pa, absolute; 0: no sensor, its frame stays away */
    float battery_voltage;          /* V */
    uint8_t gear;                   /* 0..6 */
    uint8_t gear_shift_status;      /* 0 uninitialised, 1 ready, 2 locked out, 3 upshift, 4 downshift */
    bool engine_running;
    uint8_t safety_switch; /* position 0..7; 3 enables the actuation test, 4 the engine */
    bool mode_switch;      /* true: autonomous */
    raptor_race_control race_control;
} raptor_wired_in;

/* Signals that the Raptor drives. */
typedef struct raptor_wired_out {
    float throttle_demand; /* 0..1 */
    uint8_t gear_demand;   /* 0..6 */
    bool ignition;
    bool starter;
} raptor_wired_out;

/* Angles of the steering motor in one minor frame. */
typedef struct raptor_steering_angles {
    float primary;   /* rad, first sensor */
    float commanded; /* rad, asked of the Space Drive */
    bool known;
} raptor_steering_angles;

/* State of one Raptor. raptor_init to start; a zeroed one is in sys_state NONE and asks for full brake. */
typedef struct raptor {
    raptor_config config;
    executive schedule;
    dbw_profile profile; /* of CAN1 */
    raptor_command_monitor commands;
    raptor_gateway gateway;
    raptor_diagnostic diagnostic;
    raptor_sys_machine sys;
    raptor_test test;
    raptor_demand demand;
    raptor_steering_angles steering;         /* of the minor frame before */
    float speed;                             /* m/s, from the undriven wheels */
    float wheel_speed[4];                    /* m/s at the tread, of the last finite readings */
    bool wheel_speeds_valid;                 /* all four read now */
    bool stopping;                           /* told to stop; until restart */
    uint8_t report_counters[RAPTOR_REPORTS]; /* message counters of the reports, by row of their table */
} raptor;

/* Put `self` into its power-on state. config: null for the defaults; copied. */
void raptor_init(raptor *self, const raptor_config *config);

/* Speak a profile on CAN1 from the next tick on; V14 is what a started Raptor speaks. profile: enum
 * codec_profile_index. Returns false, with nothing changed, when there is none. */
bool raptor_select_profile(raptor *self, uint8_t profile);

/* Run one minor frame of 10 ms.
 *
 * now_us: monotonic. wired: sampled signals; NaN and infinities count as out of range. in: in_count frames received
 * since the last tick, any bus and id; what is not for the Raptor is ignored. drive: all fields are written. out:
 * reports for CAN1 and requests for CAN3 are appended.
 */
void raptor_tick(raptor *self, uint64_t now_us, const raptor_wired_in *wired, const can_frame *in, uint32_t in_count,
                 raptor_wired_out *drive, can_outbox *out);

/* The Raptor is about to be switched off: EMERGENCY_SHUTDOWN and full brake from the next tick on, until raptor_init.
 * One that is in PWR_OFF brakes already, and stays there. */
void raptor_stop(raptor *self);

/* The static schedule, for checks: returns the table, `count` receives the number of its tasks. */
const executive_task *raptor_schedule(uint32_t *count);

#endif
