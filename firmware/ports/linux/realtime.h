/* What makes a process regular: its priority, its processor, its memory in place. Each refusal is one line for people
 * that says what to do. */
#ifndef RACELOOP_PORT_REALTIME_H
#define RACELOOP_PORT_REALTIME_H

#include <stdint.h>

enum { REALTIME_TEXT_MAX = 256 };

/* Schedule the calling thread. priority: SCHED_FIFO 1..99, 0: as it is; threads and processes that it starts do not
 * inherit it. cpu: processor to pin to, -1: any. Wake-ups are exact either way: the timer slack goes.
 * Returns 0, or the errno with a line in text, of REALTIME_TEXT_MAX bytes. */
int32_t realtime_schedule(int32_t priority, int32_t cpu, char *text);

/* Keep all memory of the process in place, now and later, and have its stack ready: afterwards no page fault delays a
 * cycle. To be called when everything is mapped. Returns 0, or the errno with a line in text, of REALTIME_TEXT_MAX
 * bytes.
 */
int32_t realtime_lock_memory(char *text);

/* The same for a process that maps far more than it uses: a page stays in place once it was touched, so what a cycle
 * needs must have run before. Returns as realtime_lock_memory. */
int32_t realtime_keep_memory(char *text);

/* Get SIGTERM when the thread that started this process ends. One that ended before this call is not noticed. */
void realtime_end_with_parent(void);

#endif
