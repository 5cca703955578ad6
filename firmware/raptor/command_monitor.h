/* Supervision of the onboard computer: which of its commands may be used, and what is wrong with them.
 *
 * Nothing here trusts the sender. A frame must pass the codec's checks (a counter that moved), its values must be
 * possible, and they must fit each other and the sys_state. An implausible frame is not used: the last plausible
 * value stands until the fault is certain.
 */
#ifndef RACELOOP_RAPTOR_COMMAND_MONITOR_H
#define RACELOOP_RAPTOR_COMMAND_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "common/debounce.h"
#include "raptor/config.h"

/* Faults; bits. They tell of now and are not latched here: sys_state latches its reaction. */
enum raptor_command_fault {
    RAPTOR_COMMAND_BRAKE_TIMEOUT = 0x01,
    RAPTOR_COMMAND_THROTTLE_TIMEOUT = 0x02,
    RAPTOR_COMMAND_STEERING_TIMEOUT = 0x04,
    RAPTOR_COMMAND_CT_REPORT_TIMEOUT = 0x08,
    RAPTOR_COMMAND_COUNTER_STUCK = 0x10,  /* one of the time-outs above is due to a counter that stands still */
    RAPTOR_COMMAND_IMPLAUSIBLE = 0x20,    /* out of range, or a steering step that no driver makes */
    RAPTOR_COMMAND_PEDAL_CONFLICT = 0x40, /* accelerator and brake together */
    RAPTOR_COMMAND_CT_STATE = 0x80,       /* ct_state contradicts sys_state, or is none at all */

    /* What adlink_hb_lost reports. */
    RAPTOR_COMMAND_ANY_TIMEOUT = 0x0F,
};

/* Last plausible commands. SI units. Zero is no throttle, no brake, straight, neutral. */
typedef struct raptor_command {
    float brake_pressure;    /* Pa, 0..6e6 */
    float throttle;          /* 0..1 */
    float steer_motor_angle; /* rad, left positive */
    uint8_t gear;            /* 0..6 */
    uint16_t ct_state;       /* enum raptor_ct, or whatever else was sent */
    int8_t traction_aim;     /* driver's switches; -1: never received */
    int8_t traction_range;
} raptor_command;

/* State: raptor_command_monitor_init to start. */
typedef struct raptor_command_monitor {
    codec_rx brake_rx;
    codec_rx throttle_rx;
    codec_rx steering_rx;
    codec_rx gear_rx;
    codec_rx ct_report_rx;
    codec_rx switches_rx;
    raptor_command command;
    uint16_t brake_implausible; /* frames in a row */
    uint16_t throttle_implausible;
    uint16_t steering_implausible;
    uint16_t gear_implausible;
    bool brake_known; /* at least one plausible frame */
    bool throttle_known;
    bool steering_known;
    debounce pedal_conflict;
    debounce ct_inconsistent;
    bool started;
    uint64_t since_us; /* start of supervision */
    uint16_t faults;   /* enum raptor_command_fault, now */
} raptor_command_monitor;

void raptor_command_monitor_init(raptor_command_monitor *self);

/* Take one CAN1 frame; ids of no interest are ignored. sys_state: enum raptor_sys; the steering step is judged
 * from DRIVING on, because before it the steering command moves nothing. now_us: monotonic. */
void raptor_command_monitor_receive(raptor_command_monitor *self, const raptor_config *config, const can_frame *frame,
                                    uint8_t sys_state, uint64_t now_us);

/* Once per tick after reception: brings self->faults up to date. */
void raptor_command_monitor_step(raptor_command_monitor *self, const raptor_config *config, uint8_t sys_state,
                                 uint64_t now_us);

/* True when brake, accelerator and steering commands and ct_report have all been received, and no fault is present. */
bool raptor_command_monitor_alive(const raptor_command_monitor *self);

/* True when ct_state is one that the onboard computer can have in this sys_state. */
bool raptor_ct_state_consistent(uint8_t sys_state, uint16_t ct_state);

#endif
