/* What every cycle of a process took: records in a file that is mapped into memory.
 *
 * The file outlives a process that is killed, and can be read while it grows. It is a ring: when it is full, the
 * oldest records are overwritten. Python reads it through bridge/realtime/cycle_log.py.
 */
#ifndef RACELOOP_PORT_CYCLE_LOG_H
#define RACELOOP_PORT_CYCLE_LOG_H

#include <stdbool.h>
#include <stdint.h>

enum {
    CYCLE_LOG_MAGIC = 0x4C435952, /* "RYCL" */
    CYCLE_LOG_VERSION = 2,
    CYCLE_LOG_NAME_MAX = 24, /* with its final zero */
    CYCLE_LOG_TASKS_MAX = 16,
    CYCLE_LOG_BUSES = 5,
};

/* One cycle. Times in ns on CLOCK_MONOTONIC, in the order in which they happen. */
typedef struct cycle_record {
    uint64_t slot;                       /* number in the grid of the run */
    uint64_t deadline_ns;                /* when it was due */
    uint64_t wake_ns;                    /* the wait returned */
    uint64_t received_ns;                /* inputs are in */
    uint64_t ticked_ns;                  /* the logic is done */
    uint64_t sent_ns;                    /* outputs are with the kernel */
    uint64_t newest_ns[CYCLE_LOG_BUSES]; /* when the newest frame read in this cycle was on its bus; 0: none */
    uint32_t cpu_ns;                     /* processor time of this thread from wake_ns to sent_ns */
    uint32_t run_queue_ns;               /* time this thread was ready but did not run since the last cycle's end */
    uint32_t skipped;                    /* slots passed unused before this one */
    uint32_t page_faults;                /* since the last cycle's end */
    uint16_t preemptions;                /* involuntary context switches since the last cycle's end */
    uint16_t cpu;                        /* processor at wake_ns */
    uint16_t frames_in;
    uint16_t frames_out;
    uint16_t refused;   /* frames that the kernel did not take */
    uint16_t tasks_run; /* bit n: task n ran */
    uint32_t reserved;
    uint16_t task_us[CYCLE_LOG_TASKS_MAX]; /* execution time of each task that ran, saturating */
} cycle_record;

/* Start of the file; the records follow. */
typedef struct cycle_log_header {
    uint32_t magic;
    uint32_t version;
    uint32_t record_size;
    uint32_t capacity; /* records that fit */
    uint64_t epoch_ns;
    uint64_t phase_ns;
    uint64_t period_ns;
    uint64_t written; /* records ever written; released after the record is complete */
    uint32_t process; /* id */
    int32_t priority; /* SCHED_FIFO priority, 0 for none */
    int32_t cpu;      /* pinned to, -1 for none */
    uint32_t task_count;
    char name[CYCLE_LOG_NAME_MAX]; /* of the station */
    char task_names[CYCLE_LOG_TASKS_MAX][CYCLE_LOG_NAME_MAX];
} cycle_log_header;

/* An open log: zero it before opening. */
typedef struct cycle_log {
    cycle_log_header *header; /* null: closed, writing does nothing */
    uint64_t size;            /* bytes mapped */
} cycle_log;

/* Create the file at `path`, of `capacity` records, and map it. header: what describes the process; magic, version,
 * sizes and counts are filled in here. Returns 0, or the errno. */
int32_t cycle_log_create(cycle_log *self, const char *path, const cycle_log_header *header, uint32_t capacity);

/* Append a record. */
void cycle_log_write(cycle_log *self, const cycle_record *record);

/* Unmap. */
void cycle_log_close(cycle_log *self);

/* What the kernel has counted for the calling thread so far. */
typedef struct thread_usage {
    uint64_t cpu_ns;
    uint64_t run_queue_ns; /* 0 where the kernel does not tell */
    uint64_t preemptions;
    uint64_t page_faults;
} thread_usage;

/* Read it; costs a few microseconds, so once a cycle. schedstat_fd: from cycle_log_open_schedstat, or -1. */
void thread_usage_read(thread_usage *self, int32_t schedstat_fd);

/* Open the calling thread's scheduler statistics; -1 where the kernel has none. */
int32_t cycle_log_open_schedstat(void);

#endif
