/* Faults: debounce, latches, the most severe reaction, the least share of the limits, and the events that tell of them.
 *
 * Everything about a single fault stands in the generated fault_table; this module knows none by name.
 */
#ifndef RACELOOP_OBC_FAULT_MONITOR_H
#define RACELOOP_OBC_FAULT_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "generated/fault_table.h"

enum { FAULT_EVENTS_MAX = 128 };

/* Conditions as the monitors found them in this cycle, before debounce. Index: enum fault_id. */
typedef struct fault_conditions {
    bool present[FAULT_COUNT];
    uint16_t detail[FAULT_COUNT]; /* meaning by fault, docs/faults.md */
} fault_conditions;

/* One fault's state: zero it to start. */
typedef struct fault_state {
    uint16_t present_cycles; /* consecutive, saturating at the debounce */
    uint16_t absent_cycles;  /* consecutive, saturating at the clear time */
    bool active;
} fault_state;

/* A fault became active or cleared. */
typedef struct fault_event {
    uint32_t time_ms;
    uint16_t detail;
    uint8_t id; /* enum fault_id */
    bool active;
} fault_event;

/* All faults: zero it to start. */
typedef struct fault_monitor {
    fault_state faults[FAULT_COUNT];
    fault_event events[FAULT_EVENTS_MAX];
    uint16_t event_first;
    uint16_t event_count;
    uint32_t events_lost;
} fault_monitor;

/* One 10 ms cycle. scope: the narrowest enum fault_scope that holds now. reset: the operator resets.
 * Conditions out of scope count as absent. now_us: time of the cycle. */
void fault_monitor_step(fault_monitor *self, const fault_conditions *conditions, uint8_t scope, bool reset,
                        uint64_t now_us);

/* The active fault with the most severe reaction (enum fault_id; the first of equals), or FAULT_NONE. */
uint8_t fault_monitor_worst(const fault_monitor *self);

/* What all active faults together leave: the least of each share; 100 percent while none is active. */
fault_share fault_monitor_share(const fault_monitor *self);

/* True when a fault with this reaction (enum fault_reaction) is active. */
bool fault_monitor_demands(const fault_monitor *self, uint8_t reaction);

/* Number of active faults. */
uint8_t fault_monitor_active_count(const fault_monitor *self);

/* True when no active fault disables the lateral controller (enum control_lateral above CONTROL_NONE). */
bool fault_monitor_allows(const fault_monitor *self, uint8_t controller);

/* True when no fault that blocks the launch has its condition present. */
bool fault_monitor_launch_clear(const fault_conditions *conditions);

/* Take the oldest event that was not told yet. Returns false when there is none. */
bool fault_monitor_next_event(fault_monitor *self, fault_event *event);

#endif
