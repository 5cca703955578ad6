#define _POSIX_C_SOURCE 200809L

#include "ports/linux/wired_io.h"

#include <errno.h>
#include <fcntl.h>
#include <stdatomic.h>
#include <stddef.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

enum {
    CELL_WORDS = 32,    /* 256 bytes, more than the largest struct */
    READ_ATTEMPTS = 64, /* a writer takes well below a microsecond; one that died in the middle takes for ever */
};

/* A cell under a sequence lock: odd while it is written. The words are atomic, so a torn read is no undefined behaviour
 * but one that the sequence gives away. */
typedef struct cell {
    _Atomic uint64_t sequence;
    _Atomic uint64_t written_ns;
    _Atomic uint64_t words[CELL_WORDS];
} cell;

typedef struct memory {
    uint32_t magic;
    uint32_t version;
    cell cells[WIRED_CELLS];
} memory;

static const size_t value_size[WIRED_CELLS] = {
    [WIRED_RAPTOR_IN] = sizeof(raptor_wired_in),
    [WIRED_RAPTOR_OUT] = sizeof(raptor_wired_out),
    [WIRED_SPACE_DRIVE_IN] = sizeof(space_drive_wired_in),
    [WIRED_SPACE_DRIVE_OUT] = sizeof(space_drive_wired_out),
};

_Static_assert(sizeof(raptor_wired_in) <= CELL_WORDS * 8U, "a cell holds the largest struct");
_Static_assert(sizeof(space_drive_wired_in) <= CELL_WORDS * 8U, "a cell holds the largest struct");
_Static_assert(ATOMIC_LLONG_LOCK_FREE == 2, "processes share no lock");

/* Map a file of the right size. */
static int32_t map(wired_io *self, int fd)
{
    void *mapped = mmap(NULL, sizeof(memory), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    const int32_t error = mapped == MAP_FAILED ? errno : 0;
    (void)close(fd);
    self->memory = error == 0 ? mapped : NULL;
    return error;
}

int32_t wired_io_create(wired_io *self, const char *path)
{
    const int fd = open(path, O_RDWR | O_CREAT | O_TRUNC | O_CLOEXEC, 0644);
    if (fd < 0) {
        return errno;
    }
    const int allocated = posix_fallocate(fd, 0, (off_t)sizeof(memory));
    if (allocated != 0) {
        (void)close(fd);
        return allocated;
    }
    const int32_t error = map(self, fd);
    if (error == 0) {
        memory *shared = self->memory;
        shared->magic = WIRED_IO_MAGIC;
        shared->version = WIRED_IO_VERSION;
    }
    return error;
}

int32_t wired_io_open(wired_io *self, const char *path)
{
    const int fd = open(path, O_RDWR | O_CLOEXEC);
    if (fd < 0) {
        return errno;
    }
    struct stat status;
    if (fstat(fd, &status) != 0 || status.st_size != (off_t)sizeof(memory)) {
        (void)close(fd);
        return EPROTO;
    }
    const int32_t error = map(self, fd);
    if (error != 0) {
        return error;
    }
    const memory *shared = self->memory;
    if (shared->magic != WIRED_IO_MAGIC || shared->version != WIRED_IO_VERSION) {
        wired_io_close(self);
        return EPROTO;
    }
    return 0;
}

void wired_io_write(wired_io *self, uint32_t index, const void *value, uint64_t now_ns)
{
    if (self->memory == NULL || index >= WIRED_CELLS) {
        return;
    }
    cell *target = &((memory *)self->memory)->cells[index];
    uint64_t words[CELL_WORDS] = {0};
    memcpy(words, value, value_size[index]);
    /* Odd whatever it was: a predecessor may have died in the middle. */
    const uint64_t writing = atomic_load_explicit(&target->sequence, memory_order_relaxed) | 1U;
    atomic_store_explicit(&target->sequence, writing, memory_order_relaxed);
    atomic_thread_fence(memory_order_release);
    for (size_t i = 0U; i < CELL_WORDS; i++) {
        atomic_store_explicit(&target->words[i], words[i], memory_order_relaxed);
    }
    atomic_store_explicit(&target->written_ns, now_ns, memory_order_relaxed);
    atomic_store_explicit(&target->sequence, writing + 1U, memory_order_release);
}

uint64_t wired_io_read(const wired_io *self, uint32_t index, void *value)
{
    if (self->memory == NULL || index >= WIRED_CELLS) {
        return 0U;
    }
    cell *source = &((memory *)self->memory)->cells[index];
    for (uint32_t attempt = 0U; attempt < READ_ATTEMPTS; attempt++) {
        const uint64_t before = atomic_load_explicit(&source->sequence, memory_order_acquire);
        uint64_t words[CELL_WORDS];
        for (size_t i = 0U; i < CELL_WORDS; i++) {
            words[i] = atomic_load_explicit(&source->words[i], memory_order_relaxed);
        }
        const uint64_t written_ns = atomic_load_explicit(&source->written_ns, memory_order_relaxed);
        atomic_thread_fence(memory_order_acquire);
        if ((before & 1U) == 0U && atomic_load_explicit(&source->sequence, memory_order_relaxed) == before) {
            if (written_ns != 0U) {
                memcpy(value, words, value_size[index]);
            }
            return written_ns;
        }
    }
    return 0U;
}

void wired_io_close(wired_io *self)
{
    if (self->memory != NULL) {
        (void)munmap(self->memory, sizeof(memory));
    }
    self->memory = NULL;
}
