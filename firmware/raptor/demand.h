/* What the Raptor makes the car do: the chosen one of its own wish and the onboard computer's command. */
#ifndef RACELOOP_RAPTOR_DEMAND_H
#define RACELOOP_RAPTOR_DEMAND_H

#include <stdbool.h>
#include <stdint.h>

#include "raptor/command_monitor.h"
#include "raptor/config.h"

/* What one step reads. */
typedef struct raptor_demand_input {
    const raptor_command_monitor *commands;
    uint8_t sys_state;    /* enum raptor_sys */
    float test_steer;     /* rad, wanted by the actuation test */
    float test_brake;     /* Pa, wanted by the actuation test */
    float steer_position; /* rad, as the Space Drive reports it */
    bool steer_position_known;
    bool engine_running;
    uint8_t gear;              /* engaged, 0..6 */
    uint8_t gear_shift_status; /* 1: ready */
    float speed;               /* m/s */
} raptor_demand_input;

/* Demands in force. Zero it to start: raptor_demand_init does, with full brake. */
typedef struct raptor_demand {
    float steer;    /* rad, left positive */
    float brake;    /* Pa */
    float throttle; /* 0..1 */
    uint8_t gear;   /* 0..6 */
    bool ignition;
    bool starter;
    bool steer_held; /* `steer` was set at least once */
    bool shifted;    /* last_shift_us holds a time */
    uint64_t last_shift_us;
} raptor_demand;

void raptor_demand_init(raptor_demand *self);

/* One tick.
 *
 * Throttle passes in DRIVING only, with no command fault present and the brake below pedal_conflict_brake. The brake is
 * the larger of the Raptor's own and the onboard computer's; it is full before the first brake command, with any
 * command fault, and in every state that is a failure or an end. The gear follows in single steps, when the gearbox is
 * ready.
 */
void raptor_demand_step(raptor_demand *self, const raptor_config *config, const raptor_demand_input *input,
                        uint64_t now_us);

#endif
