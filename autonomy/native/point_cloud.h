/* Points of one LiDAR scan. Vehicle frame (ISO 8855): x forward, y left, z up, m. */
#ifndef AUTONOMY_POINT_CLOUD_H
#define AUTONOMY_POINT_CLOUD_H

#include <stdint.h>

enum {
    CLOUD_POINTS_MAX = 98304, /* of one scan, all LiDARs together */
    CLOUD_RANGE_M = 128,      /* what lies farther off in x, y or z is not looked at */
};

/* As a row of a float32 array of shape (n, 3). */
typedef struct cloud_point {
    float x;
    float y;
    float z;
} cloud_point;

/* Where the points of a cloud went; the sum is the number of points that came in. */
typedef struct cloud_tally {
    uint32_t kept;
    uint32_t removed;    /* by what the filter is for */
    uint32_t far;        /* beyond the range */
    uint32_t not_finite; /* a coordinate is NaN or infinite */
} cloud_tally;

#endif
