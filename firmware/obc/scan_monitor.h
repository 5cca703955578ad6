/* Health of the sensors whose scans autonomy receives: age, update rate, size and progress, by its notices of them.
 *
 * A scan that is the one before again keeps its sequence: the sensor is there, and has frozen. Nothing is healthy until
 * it was seen.
 */
#ifndef RACELOOP_OBC_SCAN_MONITOR_H
#define RACELOOP_OBC_SCAN_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "obc/rate_counter.h"

enum scan_sensor {
    SCAN_LIDAR = 0,
    SCAN_RADAR = 1,
    SCAN_COUNT = 2,
};

/* sensor_notice.sensor_id of the first; those before it are sensors that the computer hears itself. */
enum { SCAN_FIRST_ID = 3 };

/* Limits of one sensor. */
typedef struct scan_limits {
    uint32_t timeout_ms; /* age of the newest scan, and time without a new one */
    float min_rate;      /* scans per second */
    uint32_t min_size;   /* in the units of sensor_data_size */
    uint32_t max_size;
} scan_limits;

/* Verdict on one sensor. Milliseconds saturate; they are 65535 when there was no scan. */
typedef struct scan_health {
    uint16_t age_ms;   /* of the newest scan's data */
    uint16_t still_ms; /* since the newest one that was new */
    uint32_t rate;     /* in the last full second */
    uint32_t size;     /* of the newest scan; 0: none yet */
    bool timed_out;
    bool low_rate;
    bool wrong_size;
    bool frozen; /* scans come, none of them new */
} scan_health;

/* Reception state of one sensor. */
typedef struct scan_state {
    uint64_t notice_us; /* newest notice */
    uint64_t new_us;    /* newest notice of a scan that is new */
    rate_counter rate;
    uint32_t size;
    uint16_t sequence;
    uint16_t sample_age_ms; /* of the data when the newest notice left */
    bool seen;
} scan_state;

/* All sensors: zero it to start. */
typedef struct scan_monitor {
    scan_state sensors[SCAN_COUNT];
    uint32_t rejected; /* frames that cannot be read, or of a sensor that is not there */
} scan_monitor;

/* Take a sensor_notice frame from CAN-A. now_us: time of the tick, monotonic. */
void scan_monitor_push(scan_monitor *self, const can_frame *frame, uint64_t now_us);

/* Verdict on a sensor. sensor: enum scan_sensor below SCAN_COUNT. now_us: not before the newest push. */
scan_health scan_monitor_check(scan_monitor *self, uint32_t sensor, const scan_limits *limits, uint64_t now_us);

#endif
