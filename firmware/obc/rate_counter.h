/* Events per second, counted in buckets of time so that the memory does not grow with the rate. */
#ifndef RACELOOP_OBC_RATE_COUNTER_H
#define RACELOOP_OBC_RATE_COUNTER_H

#include <stdint.h>

enum {
    RATE_BUCKET_US = 100000, /* buckets of that length ... */
    RATE_BUCKETS = 11,       /* ... of which ten are full and make one second */
};

/* State: zero it to start. */
typedef struct rate_counter {
    uint64_t bucket;                /* number of the bucket being filled */
    uint16_t buckets[RATE_BUCKETS]; /* events, by number modulo RATE_BUCKETS */
} rate_counter;

/* Count one event. self: not null. now_us: not before the newest call. */
void rate_counter_add(rate_counter *self, uint64_t now_us);

/* Events in the last full second. self, now_us: as above. */
uint32_t rate_counter_get(rate_counter *self, uint64_t now_us);

#endif
