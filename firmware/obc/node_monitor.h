/* Health of the autonomy nodes: status code, progress and reliability (SSM-5, SSM-7).
 *
 * A node is alive when its status arrives and its heartbeat moves: the heartbeat counts finished computations, so a
 * node that only repeats itself is found out.
 */
#ifndef RACELOOP_OBC_NODE_MONITOR_H
#define RACELOOP_OBC_NODE_MONITOR_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

/* Registered nodes; the numbers are those of node_status.node_id, and of perception_status.perception_id from
 * NODE_PERCEPTION on. */
enum node_id {
    NODE_ESTIMATION = 0,
    NODE_PLANNING = 1,
    NODE_WALL = 2,
    NODE_LIDAR_DETECTION = 3,
    NODE_RADAR_DETECTION = 4,
    NODE_TRACKING = 5,
    NODE_PREDICTION = 6,
    NODE_COUNT = 7,
    NODE_PERCEPTION = NODE_LIDAR_DETECTION, /* the first node of perception */
};

/* Status codes (SSM-5); the numbers are those of node_status.node_status_code. */
enum node_status_code {
    NODE_OK = 0,
    NODE_INITIALIZED = 64,
    NODE_INACTIVE = 100,
    NODE_NOT_INITIALIZED = 128,
    NODE_ERROR = 200,
    NODE_DEAD = 255,
};

/* Limits that all nodes share. */
typedef struct node_limits {
    uint32_t timeout_ms;           /* age of the newest status */
    uint32_t heartbeat_timeout_ms; /* time without progress */
    float min_reliability;         /* percent */
} node_limits;

/* Verdict on one node. */
typedef struct node_health {
    uint8_t status_code; /* as reported; DEAD when silent */
    float reliability;   /* percent, as reported */
    uint16_t heartbeat;
    bool ok;         /* reports OK */
    bool failed;     /* reports ERROR, DEAD or a code that does not exist, or is silent */
    bool stalled;    /* no progress */
    bool unreliable; /* reliability below the limit */
} node_health;

/* Reception state of one node. */
typedef struct node_state {
    uint64_t status_us;   /* newest status */
    uint64_t progress_us; /* newest change of the heartbeat */
    uint16_t heartbeat;
    uint8_t status_code;
    float reliability;
    bool seen;
} node_state;

/* All nodes: zero it to start. */
typedef struct node_monitor {
    node_state nodes[NODE_COUNT];
    uint32_t rejected; /* frames that cannot be read, or of a node that does not report in them */
} node_monitor;

/* Take a node_status or a perception_status frame from CAN-A. now_us: time of the tick, monotonic. */
void node_monitor_push(node_monitor *self, const can_frame *frame, uint64_t now_us);

/* Verdict on a node. node: enum node_id below NODE_COUNT. */
node_health node_monitor_check(const node_monitor *self, uint32_t node, const node_limits *limits, uint64_t now_us);

#endif
