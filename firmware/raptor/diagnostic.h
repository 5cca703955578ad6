/* Emergency-stop triggers and the bits of diagnostic_report. */
#ifndef RACELOOP_RAPTOR_DIAGNOSTIC_H
#define RACELOOP_RAPTOR_DIAGNOSTIC_H

#include <stdbool.h>
#include <stdint.h>

#include "common/debounce.h"
#include "raptor/config.h"
#include "raptor/gateway.h"

/* Bits of diagnostic_report, in the order and at the places of the wire. */
enum raptor_diagnostic_bit {
    RAPTOR_DIAG_SD_WARNING = 0x000001,
    RAPTOR_DIAG_SD_FAILURE = 0x000002,
    RAPTOR_DIAG_SD_BRAKE_WARNING_1 = 0x000004, /* channels 2 and 3 follow */
    RAPTOR_DIAG_SD_STEER_WARNING_1 = 0x000020, /* channels 2 and 3 follow */
    RAPTOR_DIAG_EST1_FRONT_BRAKE = 0x010000,   /* front line out of spec */
    RAPTOR_DIAG_EST2_REAR_BRAKE = 0x020000,    /* rear line out of spec */
    RAPTOR_DIAG_EST3_LOW_ENGINE = 0x040000,    /* engine stalls while driving */
    RAPTOR_DIAG_EST4_SD_LOST = 0x080000,       /* Space Drive positions lost */
    RAPTOR_DIAG_EST5_MOTEC_LOST = 0x100000,    /* never set: this car has no engine bus, the engine is wired */
    RAPTOR_DIAG_EST6_SD_EBRAKE = 0x200000,     /* Space Drive brakes by itself */
    RAPTOR_DIAG_OBC_LOST = 0x400000,           /* adlink_hb_lost */
    RAPTOR_DIAG_RC_LOST = 0x800000,            /* race control: told, no reaction of the Raptor */

    /* Triggers of the emergency shutdown. */
    RAPTOR_DIAG_TRIGGERS = 0x3F0000,
};

/* What one step reads. */
typedef struct raptor_diagnostic_input {
    const raptor_gateway *gateway;
    uint8_t sys_state; /* enum raptor_sys */
    bool obc_lost;     /* command time-out or ct_report stall */
    bool race_control_linked;
    float brake_request;  /* Pa, in force since the last tick */
    float brake_lines[2]; /* Pa, front and rear */
    float engine_speed;   /* rad/s */
    bool engine_running;
} raptor_diagnostic_input;

/* State: zero it to start. */
typedef struct raptor_diagnostic {
    float settled_request; /* Pa, the request around which it has stayed */
    debounce settled;      /* request constant */
    debounce out_of_spec[2];
    debounce low_engine;
    uint32_t bits;    /* enum raptor_diagnostic_bit, now */
    uint32_t latched; /* triggers, and the lost computer, that led to the emergency shutdown */
} raptor_diagnostic;

/* Once per tick: brings self->bits up to date. In EMERGENCY_SHUTDOWN the latched bits stay reported with them, so
 * that the cause can still be read. */
void raptor_diagnostic_step(raptor_diagnostic *self, const raptor_config *config, const raptor_diagnostic_input *input,
                            uint64_t now_us);

#endif
