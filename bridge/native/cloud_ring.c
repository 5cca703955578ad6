#include "bridge/native/cloud_ring.h"

#include <stdatomic.h>
#include <stddef.h>
#include <string.h>

enum {
    MAGIC = 0x53444c43, /* "CLDS" */
    VERSION = 1,
    WORDS = CLOUD_RING_VALUES_MAX / 2, /* two values in each */
};

/* The words are atomic, so a torn read is no undefined behaviour but one that the number gives away. */
typedef struct place {
    _Atomic uint64_t number; /* of the scan in it; 0 while it is written */
    _Atomic int64_t time_us;
    _Atomic uint64_t points;
    _Atomic uint64_t columns;
    _Atomic uint64_t words[WORDS];
} place;

typedef struct ring {
    _Atomic uint64_t mark;
    _Atomic uint64_t newest; /* number of the last scan that is whole; 0 before the first */
    _Atomic uint64_t seen;   /* number of the last scan that was looked at */
    place places[CLOUD_RING_PLACES];
} ring;

_Static_assert(ATOMIC_LLONG_LOCK_FREE == 2, "processes share no lock");
_Static_assert(CLOUD_RING_VALUES_MAX % 2 == 0 && sizeof(float) == 4U, "two values are a word");

static const uint64_t marked = (uint64_t)MAGIC << 32 | VERSION;

uint64_t cloud_ring_size(void)
{
    return sizeof(ring);
}

void cloud_ring_mark(void *memory)
{
    ring *self = memory;
    atomic_store_explicit(&self->mark, marked, memory_order_release);
}

bool cloud_ring_is_one(const void *memory)
{
    const ring *self = memory;
    return atomic_load_explicit(&self->mark, memory_order_acquire) == marked;
}

bool cloud_ring_write(void *memory, int64_t time_us, const float *values, uint32_t points, uint32_t columns)
{
    ring *self = memory;
    const uint64_t count = (uint64_t)points * columns;
    if (count > CLOUD_RING_VALUES_MAX) {
        return true;
    }
    const uint64_t before = atomic_load_explicit(&self->newest, memory_order_relaxed);
    const bool looked_at = atomic_load_explicit(&self->seen, memory_order_relaxed) >= before;
    place *target = &self->places[(before + 1U) % CLOUD_RING_PLACES];
    atomic_store_explicit(&target->number, 0U, memory_order_relaxed);
    atomic_thread_fence(memory_order_release);
    atomic_store_explicit(&target->time_us, time_us, memory_order_relaxed);
    atomic_store_explicit(&target->points, points, memory_order_relaxed);
    atomic_store_explicit(&target->columns, columns, memory_order_relaxed);
    const size_t whole = (size_t)(count / 2U);
    for (size_t i = 0U; i < whole; i++) {
        uint64_t word;
        memcpy(&word, &values[2U * i], sizeof word);
        atomic_store_explicit(&target->words[i], word, memory_order_relaxed);
    }
    if (count % 2U != 0U) {
        uint64_t word = 0U;
        memcpy(&word, &values[count - 1U], sizeof(float));
        atomic_store_explicit(&target->words[whole], word, memory_order_relaxed);
    }
    atomic_store_explicit(&target->number, before + 1U, memory_order_release);
    atomic_store_explicit(&self->newest, before + 1U, memory_order_release);
    return looked_at;
}

bool cloud_ring_find(void *memory, int64_t now_us, cloud_scan *found)
{
    ring *self = memory;
    const uint64_t newest = atomic_load_explicit(&self->newest, memory_order_acquire);
    const uint64_t seen = atomic_load_explicit(&self->seen, memory_order_relaxed);
    for (uint64_t back = 0U; back < CLOUD_RING_PLACES && newest - back > seen; back++) {
        const uint64_t number = newest - back;
        const place *source = &self->places[number % CLOUD_RING_PLACES];
        if (atomic_load_explicit(&source->number, memory_order_acquire) != number) {
            continue; /* the writer has come round meanwhile, to this and to all before it */
        }
        found->number = number;
        found->time_us = atomic_load_explicit(&source->time_us, memory_order_relaxed);
        found->points = (uint32_t)atomic_load_explicit(&source->points, memory_order_relaxed);
        found->columns = (uint32_t)atomic_load_explicit(&source->columns, memory_order_relaxed);
        atomic_thread_fence(memory_order_acquire);
        if (atomic_load_explicit(&source->number, memory_order_relaxed) == number && found->time_us <= now_us) {
            atomic_store_explicit(&self->seen, number, memory_order_relaxed);
            return true;
        }
    }
    return false;
}

bool cloud_ring_copy(const void *memory, const cloud_scan *scan, float *values)
{
    const ring *self = memory;
    const place *source = &self->places[scan->number % CLOUD_RING_PLACES];
    const uint64_t count = (uint64_t)scan->points * scan->columns;
    if (count > CLOUD_RING_VALUES_MAX || atomic_load_explicit(&source->number, memory_order_acquire) != scan->number) {
        return false;
    }
    const size_t whole = (size_t)(count / 2U);
    for (size_t i = 0U; i < whole; i++) {
        const uint64_t word = atomic_load_explicit(&source->words[i], memory_order_relaxed);
        memcpy(&values[2U * i], &word, sizeof word);
    }
    if (count % 2U != 0U) {
        const uint64_t word = atomic_load_explicit(&source->words[whole], memory_order_relaxed);
        memcpy(&values[count - 1U], &word, sizeof(float));
    }
    atomic_thread_fence(memory_order_acquire);
    return atomic_load_explicit(&source->number, memory_order_relaxed) == scan->number;
}
