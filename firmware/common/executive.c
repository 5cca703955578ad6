#include "common/executive.h"

#include <stddef.h>

enum {
    /* Least common multiple of the periods 1..10: after so many minor frames every schedule repeats. */
    SCHEDULE_REPEATS_FRAMES = 2520,
};

static uint32_t saturate_u32(uint64_t value)
{
    return value > UINT32_MAX ? UINT32_MAX : (uint32_t)value;
}

/* Compare the start of a minor frame with its due time and say when the next one is due. */
static void keep_time(executive *self, uint64_t now_us)
{
    if (self->frame == 0U || now_us + EXECUTIVE_FRAME_US / 2 < self->expected_us) {
        /* First frame, or a clock that was set back: the grid starts here. */
        self->expected_us = now_us + EXECUTIVE_FRAME_US;
        return;
    }
    if (now_us > self->expected_us) {
        const uint64_t behind_us = now_us - self->expected_us;
        const uint64_t missed = behind_us / EXECUTIVE_FRAME_US;
        self->missed_frames += saturate_u32(missed);
        self->expected_us += missed * EXECUTIVE_FRAME_US;
        if (now_us - self->expected_us > EXECUTIVE_FRAME_US / 2) {
            self->late_frames++;
        }
    }
    self->expected_us += EXECUTIVE_FRAME_US;
}

/* Run one task and record what it cost. Returns the cost in microseconds. */
static uint32_t run_task(const executive *self, const executive_task *task, executive_record *record, void *context)
{
    uint64_t cost_us = record->injected_cost_us;
    if (self->clock != NULL) {
        const uint64_t begin_us = self->clock(self->clock_context);
        task->run(context);
        cost_us += self->clock(self->clock_context) - begin_us;
    } else {
        task->run(context);
    }
    record->runs++;
    record->last_us = saturate_u32(cost_us);
    if (record->last_us > record->worst_us) {
        record->worst_us = record->last_us;
    }
    if (record->last_us > task->budget_us) {
        record->overruns++;
    }
    return record->last_us;
}

void executive_run(executive *self, const executive_task *table, uint32_t count, void *context, uint64_t now_us)
{
    const uint32_t tasks = count < EXECUTIVE_TASKS_MAX ? count : EXECUTIVE_TASKS_MAX;
    uint64_t frame_cost_us = 0U;

    keep_time(self, now_us);
    for (uint32_t i = 0; i < tasks; i++) {
        const executive_task *task = &table[i];
        if (task->run != NULL && task->period > 0U && self->frame % task->period == task->offset) {
            frame_cost_us += run_task(self, task, &self->records[i], context);
        }
    }
    self->frame++;
    if (frame_cost_us > self->worst_frame_us) {
        self->worst_frame_us = saturate_u32(frame_cost_us);
    }
    if (frame_cost_us > EXECUTIVE_FRAME_US) {
        self->overruns++;
    }
}

bool executive_table_valid(const executive_task *table, uint32_t count, uint32_t frame_budget_us)
{
    if (count > EXECUTIVE_TASKS_MAX) {
        return false;
    }
    for (uint32_t i = 0; i < count; i++) {
        const executive_task *task = &table[i];
        if (task->run == NULL || task->period < 1U || task->period > EXECUTIVE_MAJOR_FRAMES ||
            task->offset >= task->period || task->budget_us == 0U) {
            return false;
        }
    }
    for (uint32_t frame = 0; frame < SCHEDULE_REPEATS_FRAMES; frame++) {
        uint64_t budget_us = 0U;
        for (uint32_t i = 0; i < count; i++) {
            if (frame % table[i].period == table[i].offset) {
                budget_us += table[i].budget_us;
            }
        }
        if (budget_us > frame_budget_us) {
            return false;
        }
    }
    return true;
}
