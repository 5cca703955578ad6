/* Cyclic executive: a static schedule table of tasks, run once per minor frame.
 *
 * Pure: it reads no clock. The port that has one passes a task clock; lock step passes none, and then a task
 * costs what `injected_cost_us` says (0 unless a fault asks for more), so simulated runs are reproducible.
 */
#ifndef RACELOOP_EXECUTIVE_H
#define RACELOOP_EXECUTIVE_H

#include <stdbool.h>
#include <stdint.h>

enum {
    EXECUTIVE_FRAME_US = 10000,  /* minor frame, 100 Hz */
    EXECUTIVE_MAJOR_FRAMES = 10, /* minor frames per major frame */
    EXECUTIVE_TASKS_MAX = 16,
};

/* One task. It runs in minor frames n with n % period == offset. */
typedef struct executive_task {
    void (*run)(void *context); /* not null */
    uint16_t period;            /* minor frames, 1..10 */
    uint16_t offset;            /* minor frames, < period */
    uint32_t budget_us;         /* execution time allowed per run */
} executive_task;

/* Execution record of one task. */
typedef struct executive_record {
    uint32_t runs;
    uint32_t overruns; /* runs over budget */
    uint32_t worst_us;
    uint32_t last_us;
    uint32_t injected_cost_us; /* added to every run by fault injection */
} executive_record;

/* Monotonic microseconds for measuring tasks; context as given to the executive. */
typedef uint64_t (*executive_clock)(void *clock_context);

/* State of one executive: zero it to start. */
typedef struct executive {
    uint64_t frame;         /* minor frames started */
    uint64_t expected_us;   /* when the next minor frame is due; 0 before the first */
    uint32_t late_frames;   /* minor frames that started more than half a frame late */
    uint32_t missed_frames; /* whole minor frames that never started */
    uint32_t overruns;      /* minor frames whose tasks took longer than the frame */
    uint32_t worst_frame_us;
    executive_clock clock; /* null in lock step */
    void *clock_context;
    executive_record records[EXECUTIVE_TASKS_MAX];
} executive;

/* Run the minor frame that starts at now_us.
 * table: const, count <= EXECUTIVE_TASKS_MAX tasks. context: handed to every task. now_us: monotonic. */
void executive_run(executive *self, const executive_task *table, uint32_t count, void *context, uint64_t now_us);

/* True when the table is sane: functions set, periods 1..10, offsets below their period, budgets positive and
 * every minor frame's budgets together at most frame_budget_us. */
bool executive_table_valid(const executive_task *table, uint32_t count, uint32_t frame_budget_us);

#endif
