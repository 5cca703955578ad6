/* LiDAR scans from one process to another: a few places in shared memory that are used in turn.
 *
 * One writer, one reader, and neither waits for the other. A place is marked as long as it is written, so a scan that
 * is not whole, because its writer has died or has come round again, is never taken for one.
 */
#ifndef RACELOOP_CLOUD_RING_H
#define RACELOOP_CLOUD_RING_H

#include <stdbool.h>
#include <stdint.h>

enum {
    CLOUD_RING_PLACES = 4,
    CLOUD_RING_VALUES_MAX = 92160 * 4, /* of a scan */
};

/* A scan of the ring, which may be gone by the time that it is copied. */
typedef struct cloud_scan {
    uint64_t number; /* of all scans of the ring, from 1 */
    int64_t time_us;
    uint32_t points;
    uint32_t columns; /* values of a point */
} cloud_scan;

/* Bytes of a ring. Zeros are a ring without scans once it is marked. */
uint64_t cloud_ring_size(void);

/* Mark zeros as a ring; whether memory of the right size is one. */
void cloud_ring_mark(void *memory);
bool cloud_ring_is_one(const void *memory);

/* Write a scan: `points` times `columns` values, together at most CLOUD_RING_VALUES_MAX. Returns whether the scan
 * before it, if there is one, was looked at. */
bool cloud_ring_write(void *memory, int64_t time_us, const float *values, uint32_t points, uint32_t columns);

/* Find the newest scan that is not after now_us and that was not looked at, nor any after it. From now on it, and all
 * before it, count as looked at. Returns false when there is none. */
bool cloud_ring_find(void *memory, int64_t now_us, cloud_scan *found);

/* Copy the values of a scan that was found. Returns false when it has been overwritten since, entirely or in part: then
 * `values` holds nothing of use. */
bool cloud_ring_copy(const void *memory, const cloud_scan *scan, float *values);

#endif
