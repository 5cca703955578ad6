/* Command line of an ECU's process. */
#ifndef RACELOOP_PORT_ECU_OPTIONS_H
#define RACELOOP_PORT_ECU_OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

enum { ECU_MISTAKE_MAX = 256 };

/* What an ECU is attached to: which words its command line takes. */
typedef struct ecu_sockets {
    uint8_t buses; /* bit n: enum can_bus n */
    bool wires;    /* it is wired to the plant */
} ecu_sockets;

/* Choices of the user. Strings belong to the caller of the parser; null: not given. */
typedef struct ecu_options {
    const char *addresses[CAN_BUS_COUNT]; /* of the buses, for can_link_open */
    const char *wired;
    const char *cycle_log;
    uint64_t epoch_ns;  /* CLOCK_MONOTONIC */
    uint64_t phase_us;  /* 0..1000000 */
    uint64_t period_us; /* 1000..1000000 */
    uint32_t cycles;    /* records that the cycle log keeps, 1..10000000 */
    int32_t priority;   /* SCHED_FIFO 1..99; 0: none */
    int32_t cpu;        /* 0..1023; -1: any */
    uint8_t profile;    /* of CAN1, enum codec_profile_index */
    bool with_parent;   /* stop when the parent ends */
    bool help;          /* nothing else counts */
} ecu_options;

/* Parse. now_ns: CLOCK_MONOTONIC, the default epoch; an epoch may lie a minute after it at most, which a wall-clock
 * time does not. arguments: argument_count of them, the program's name not among them. Returns 0, or EINVAL with one
 * line in mistake, of ECU_MISTAKE_MAX bytes, that says what is wrong and what is allowed. */
int32_t ecu_options_parse(ecu_options *self, const ecu_sockets *sockets, uint64_t now_ns, uint32_t argument_count,
                          char *const *arguments, char *mistake);

/* The words, one a line with its meaning. Static storage. */
const char *ecu_options_help(void);

/* Name of a bus on command lines and in logs: CAN1, CAN3, CANA, CANS, CANR. bus: enum can_bus. Static storage. */
const char *ecu_bus_name(uint32_t bus);

#endif
