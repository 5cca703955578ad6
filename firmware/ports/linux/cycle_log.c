#define _GNU_SOURCE /* RUSAGE_THREAD */

#include "ports/linux/cycle_log.h"

#include <errno.h>
#include <fcntl.h>
#include <stdatomic.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/resource.h>
#include <time.h>
#include <unistd.h>

_Static_assert(sizeof(cycle_record) == 152, "Python reads this layout");
_Static_assert(sizeof(cycle_log_header) == 472, "Python reads this layout");
_Static_assert(ATOMIC_LLONG_LOCK_FREE == 2, "the count is published without a lock");

static cycle_record *records(const cycle_log *self)
{
    return (cycle_record *)(self->header + 1);
}

int32_t cycle_log_create(cycle_log *self, const char *path, const cycle_log_header *header, uint32_t capacity)
{
    if (capacity == 0U) {
        return EINVAL;
    }
    const uint64_t size = sizeof(cycle_log_header) + (uint64_t)capacity * sizeof(cycle_record);
    const int fd = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    if (fd < 0) {
        return errno;
    }
    /* Blocks are allocated now: a full disk is an error here, not a bus error in the middle of a run. */
    const int error = posix_fallocate(fd, 0, (off_t)size);
    void *memory = MAP_FAILED;
    if (error == 0) {
        memory = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_POPULATE, fd, 0);
    }
    const int32_t result = error != 0 ? error : memory == MAP_FAILED ? errno : 0;
    (void)close(fd);
    if (result != 0) {
        return result;
    }
    self->header = memory;
    self->size = size;
    *self->header = *header;
    self->header->magic = CYCLE_LOG_MAGIC;
    self->header->version = CYCLE_LOG_VERSION;
    self->header->record_size = sizeof(cycle_record);
    self->header->capacity = capacity;
    self->header->written = 0U;
    return 0;
}

void cycle_log_write(cycle_log *self, const cycle_record *record)
{
    if (self->header == NULL) {
        return;
    }
    const uint64_t place = self->header->written % self->header->capacity;
    records(self)[place] = *record;
    atomic_thread_fence(memory_order_release);
    atomic_store_explicit((_Atomic uint64_t *)&self->header->written, self->header->written + 1U, memory_order_release);
}

void cycle_log_close(cycle_log *self)
{
    if (self->header != NULL) {
        (void)munmap(self->header, self->size);
    }
    *self = (cycle_log){0};
}

int32_t cycle_log_open_schedstat(void)
{
    return open("/proc/thread-self/schedstat", O_RDONLY | O_CLOEXEC);
}

/* Second of the three numbers in /proc/.../schedstat: ns waited on a run queue. */
static uint64_t run_queue_time(int32_t schedstat_fd)
{
    char text[96];
    const ssize_t length = schedstat_fd < 0 ? -1 : pread(schedstat_fd, text, sizeof text - 1U, 0);
    if (length <= 0) {
        return 0U;
    }
    text[length] = '\0';
    char *second = NULL;
    (void)strtoull(text, &second, 10);
    return strtoull(second, NULL, 10);
}

void thread_usage_read(thread_usage *self, int32_t schedstat_fd)
{
    struct timespec cpu = {0};
    struct rusage usage = {0};
    (void)clock_gettime(CLOCK_THREAD_CPUTIME_ID, &cpu);
    (void)getrusage(RUSAGE_THREAD, &usage);
    self->cpu_ns = (uint64_t)cpu.tv_sec * 1000000000U + (uint64_t)cpu.tv_nsec;
    self->run_queue_ns = run_queue_time(schedstat_fd);
    self->preemptions = (uint64_t)usage.ru_nivcsw;
    self->page_faults = (uint64_t)usage.ru_minflt + (uint64_t)usage.ru_majflt;
}
