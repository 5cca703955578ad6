#define _GNU_SOURCE /* processor sets */

#include "ports/linux/realtime.h"

#include <errno.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>

enum {
    STACK_BYTES = 256 * 1024, /* more than a cycle uses */
    PAGE_BYTES = 4096,
    LIST_MAX = 96,
};

/* Processors that this process may use, as the kernel writes them: "0-3,7". */
static void allowed_processors(char list[LIST_MAX])
{
    static const char name[] = "Cpus_allowed_list:";
    char line[LIST_MAX + sizeof name];
    (void)snprintf(list, LIST_MAX, "unknown");
    FILE *file = fopen("/proc/self/status", "re");
    while (file != NULL && fgets(line, sizeof line, file) != NULL) {
        if (strncmp(line, name, sizeof name - 1U) == 0) {
            const char *value = line + sizeof name - 1U;
            value += strspn(value, " \t");
            (void)snprintf(list, LIST_MAX, "%.*s", (int)strcspn(value, "\n"), value);
        }
    }
    if (file != NULL) {
        (void)fclose(file);
    }
}

static int32_t pin(int32_t cpu, char *text)
{
    cpu_set_t processors;
    CPU_ZERO(&processors);
    if (cpu < CPU_SETSIZE) {
        CPU_SET((size_t)cpu, &processors);
    }
    if (sched_setaffinity(0, sizeof processors, &processors) == 0) {
        return 0;
    }
    const int32_t error = errno;
    char list[LIST_MAX];
    allowed_processors(list);
    (void)snprintf(text, REALTIME_TEXT_MAX, "no processor %d for this process: allowed are %s", (int)cpu, list);
    return error;
}

int32_t realtime_schedule(int32_t priority, int32_t cpu, char *text)
{
    text[0] = '\0';
    (void)prctl(PR_SET_TIMERSLACK, 1UL);
    const int32_t error = cpu >= 0 ? pin(cpu, text) : 0;
    if (error != 0 || priority == 0) {
        return error;
    }
    const struct sched_param parameter = {.sched_priority = priority};
    if (sched_setscheduler(0, SCHED_FIFO | SCHED_RESET_ON_FORK, &parameter) == 0) {
        return 0;
    }
    const int32_t refusal = errno;
    (void)snprintf(text, REALTIME_TEXT_MAX,
                   "no permission for SCHED_FIFO priority %d: run as root, or allow it with 'ulimit -r %d' (rtprio in "
                   "/etc/security/limits.conf)",
                   (int)priority, (int)priority);
    return refusal;
}

static void touch_stack(void)
{
    volatile uint8_t stack[STACK_BYTES];
    for (uint32_t i = 0U; i < STACK_BYTES; i += PAGE_BYTES) {
        stack[i] = 0U;
    }
    (void)stack[0];
}

static int32_t lock_memory(int flags, char *text)
{
    text[0] = '\0';
    if (mlockall(flags) == 0) {
        return 0;
    }
    const int32_t refusal = errno;
    (void)snprintf(text, REALTIME_TEXT_MAX,
                   "memory is not locked, page faults may delay a cycle: run as root, or allow it with 'ulimit -l "
                   "unlimited' (memlock in /etc/security/limits.conf)");
    return refusal;
}

int32_t realtime_lock_memory(char *text)
{
    touch_stack();
    return lock_memory(MCL_CURRENT | MCL_FUTURE, text);
}

int32_t realtime_keep_memory(char *text)
{
    return lock_memory(MCL_CURRENT | MCL_FUTURE | MCL_ONFAULT, text);
}

void realtime_end_with_parent(void)
{
    (void)prctl(PR_SET_PDEATHSIG, (unsigned long)SIGTERM);
}
