#include "obc/fault_monitor.h"

static void push_event(fault_monitor *self, uint8_t id, bool active, uint16_t detail, uint64_t now_us)
{
    if (self->event_count >= FAULT_EVENTS_MAX) {
        self->events_lost++;
        return;
    }
    const uint32_t slot = ((uint32_t)self->event_first + self->event_count) % FAULT_EVENTS_MAX;
    self->events[slot] =
        (fault_event){.time_ms = (uint32_t)(now_us / 1000U), .detail = detail, .id = id, .active = active};
    self->event_count++;
}

static void count_up(uint16_t *counter, uint16_t limit)
{
    if (*counter < limit) {
        (*counter)++;
    }
}

/* True when the fault's condition has been gone long enough and its latch lets go. */
static bool may_clear(const fault_state *state, const fault_row *row, bool reset)
{
    if (row->latch == FAULT_LATCH_UNTIL_RESTART || state->absent_cycles < row->clear_cycles) {
        return false;
    }
    return row->latch == FAULT_LATCH_WHILE_PRESENT || reset;
}

void fault_monitor_step(fault_monitor *self, const fault_conditions *conditions, uint8_t scope, bool reset,
                        uint64_t now_us)
{
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        fault_state *state = &self->faults[id];
        const fault_row *row = &fault_table[id];
        const bool was_active = state->active;
        if (conditions->present[id] && row->scope <= scope) {
            state->absent_cycles = 0U;
            count_up(&state->present_cycles, row->debounce_cycles);
            if (state->present_cycles >= row->debounce_cycles) {
                state->active = true;
            }
        } else {
            state->present_cycles = 0U;
            count_up(&state->absent_cycles, row->clear_cycles);
            if (may_clear(state, row, reset)) {
                state->active = false;
            }
        }
        if (state->active != was_active) {
            push_event(self, (uint8_t)id, state->active, conditions->detail[id], now_us);
        }
    }
}

uint8_t fault_monitor_worst(const fault_monitor *self)
{
    uint32_t worst = FAULT_NONE;
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        if (self->faults[id].active && fault_table[id].reaction > fault_table[worst].reaction) {
            worst = id;
        }
    }
    return (uint8_t)worst;
}

fault_share fault_monitor_share(const fault_monitor *self)
{
    fault_share least = fault_table[FAULT_NONE].share;
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        const fault_share *share = &fault_table[id].share;
        if (self->faults[id].active && share->speed < least.speed) {
            least.speed = share->speed;
        }
        if (self->faults[id].active && share->acceleration < least.acceleration) {
            least.acceleration = share->acceleration;
        }
    }
    return least;
}

bool fault_monitor_demands(const fault_monitor *self, uint8_t reaction)
{
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        if (self->faults[id].active && fault_table[id].reaction == reaction) {
            return true;
        }
    }
    return false;
}

uint8_t fault_monitor_active_count(const fault_monitor *self)
{
    uint8_t count = 0U;
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        count = (uint8_t)(count + (self->faults[id].active ? 1U : 0U));
    }
    return count;
}

bool fault_monitor_allows(const fault_monitor *self, uint8_t controller)
{
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        if (self->faults[id].active && fault_table[id].disables == controller) {
            return false;
        }
    }
    return true;
}

bool fault_monitor_launch_clear(const fault_conditions *conditions)
{
    for (uint32_t id = FAULT_NONE + 1U; id < FAULT_COUNT; id++) {
        if (conditions->present[id] && fault_table[id].blocks_launch) {
            return false;
        }
    }
    return true;
}

bool fault_monitor_next_event(fault_monitor *self, fault_event *event)
{
    if (self->event_count == 0U) {
        return false;
    }
    *event = self->events[self->event_first];
    self->event_first = (uint16_t)((self->event_first + 1U) % FAULT_EVENTS_MAX);
    self->event_count--;
    return true;
}
