/* sys_state machine of the Raptor: from power-on to driving and back, and the emergency shutdown. */
#ifndef RACELOOP_RAPTOR_SYS_STATE_H
#define RACELOOP_RAPTOR_SYS_STATE_H

#include <stdbool.h>
#include <stdint.h>

#include "common/debounce.h"
#include "raptor/config.h"
#include "raptor/states.h"

/* Progress of the actuation test. */
enum raptor_test_result {
    RAPTOR_TEST_RUNNING = 0,
    RAPTOR_TEST_PASSED = 1,
    RAPTOR_TEST_FAILED = 2,
};

/* Everything that one step reads. */
typedef struct raptor_sys_input {
    bool subsystems_ready; /* six Space Drive positions valid, onboard computer alive, car at rest */
    bool stopping;         /* the Raptor was told to stop: an emergency in every state but PWR_OFF */
    bool emergency;        /* an emergency-stop trigger or a command fault is present */
    bool track_flag_valid; /* race control is linked */
    uint8_t track_flag;    /* enum raptor_track_flag */
    uint16_t ct_state;     /* enum raptor_ct; 0 before the first ct_report */
    uint8_t safety_switch; /* position 0..7 */
    uint8_t test_result;   /* enum raptor_test_result, of the test that runs in ACT_TESTING */
    bool crank_conditions; /* brake held, neutral, battery within its limits */
    bool engine_running;   /* by itself, at idle speed or above */
    bool engine_stopped;   /* stands still */
} raptor_sys_input;

/* State: raptor_sys_init to start. */
typedef struct raptor_sys_machine {
    uint8_t state; /* enum raptor_sys */
    bool started;
    uint64_t entered_us; /* when `state` was entered */
    debounce conditions; /* crank checks, engine running */
} raptor_sys_machine;

void raptor_sys_init(raptor_sys_machine *self);

/* One step, at most one transition. now_us: monotonic.
 *
 * EMERGENCY_SHUTDOWN, PWR_OFF and the three failures end only with raptor_sys_init (power cycle); EMERGENCY_SHUTDOWN
 * also follows a failure. Before ACT_TESTING an absent or wrong onboard computer is no emergency, the machine just
 * does not go on; ct_state EMRG_SHUTDOWN is one in every state but PWR_OFF.
 */
void raptor_sys_step(raptor_sys_machine *self, const raptor_config *config, const raptor_sys_input *input,
                     uint64_t now_us);

#endif
