#include "obc/rate_counter.h"

/* Move on to the bucket of now_us, emptying those that are entered. */
static void advance(rate_counter *self, uint64_t now_us)
{
    const uint64_t bucket = now_us / RATE_BUCKET_US;
    for (uint32_t i = 0U; i < RATE_BUCKETS && self->bucket < bucket; i++) {
        self->bucket++;
        self->buckets[self->bucket % RATE_BUCKETS] = 0U;
    }
    self->bucket = bucket; /* after a gap of more than all buckets, which are empty now */
}

void rate_counter_add(rate_counter *self, uint64_t now_us)
{
    advance(self, now_us);
    self->buckets[self->bucket % RATE_BUCKETS]++;
}

uint32_t rate_counter_get(rate_counter *self, uint64_t now_us)
{
    advance(self, now_us);
    uint32_t rate = 0U;
    for (uint32_t i = 0U; i < RATE_BUCKETS; i++) {
        rate += i == self->bucket % RATE_BUCKETS ? 0U : self->buckets[i];
    }
    return rate;
}
