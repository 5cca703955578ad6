/* Rows of the generated fault table (generated/fault_table.h, from firmware/schema/faults.yaml). */
#ifndef RACELOOP_OBC_FAULT_ROW_H
#define RACELOOP_OBC_FAULT_ROW_H

#include <stdbool.h>
#include <stdint.h>

/* Reactions, ordered: the most severe active one wins. The numbers are those of ssm_status.ssm_reaction. */
enum fault_reaction {
    FAULT_REACTION_NONE = 0,
    FAULT_REACTION_WARN = 1,
    FAULT_REACTION_DEGRADE = 2,
    FAULT_REACTION_SWITCH_CONTROLLER = 3,
    FAULT_REACTION_SAFE_STOP = 4,
    FAULT_REACTION_EMERGENCY_STOP = 5, /* beside the wall; without one the next */
    FAULT_REACTION_FULL_BRAKE = 6,
};

/* How long an active fault is held once its condition has gone. */
enum fault_latch {
    FAULT_LATCH_WHILE_PRESENT = 0,
    FAULT_LATCH_UNTIL_RESET = 1,   /* until the operator resets */
    FAULT_LATCH_UNTIL_RESTART = 2, /* for ever */
};

/* When a fault is looked for. A wider scope includes the narrower ones. */
enum fault_scope {
    FAULT_SCOPE_ALWAYS = 0,
    FAULT_SCOPE_RUNNING = 1, /* NOMINAL, DEGRADED or EMERGENCY */
    FAULT_SCOPE_DRIVING = 2, /* running, and control moves the car */
};

/* What is left of the degraded limits while a fault is active, percent: 100 for one that limits nothing, 0 for one
 * that stops the car. */
typedef struct fault_share {
    uint8_t speed;
    uint8_t acceleration;
} fault_share;

/* What one fault does. */
typedef struct fault_row {
    uint8_t reaction;         /* enum fault_reaction */
    uint8_t latch;            /* enum fault_latch */
    uint8_t scope;            /* enum fault_scope */
    uint8_t disables;         /* enum control_lateral that must not be used; 0: none */
    bool blocks_launch;       /* its condition keeps the SSM in LAUNCHING */
    uint16_t debounce_cycles; /* consecutive 10 ms cycles with the condition before the fault is active, from 1 */
    uint16_t clear_cycles;    /* consecutive cycles without it before the fault may clear, from 1 */
    fault_share share;
} fault_row;

#endif
