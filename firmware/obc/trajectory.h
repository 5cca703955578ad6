/* The plan that control follows, and its reception from CAN-A.
 *
 * A plan travels as one trajectory_header, then a trajectory_pose and a trajectory_motion for each point, spread
 * over several ticks. Control only ever sees whole plans: points are collected in one buffer while the other one
 * holds the newest complete plan.
 */
#ifndef RACELOOP_OBC_TRAJECTORY_H
#define RACELOOP_OBC_TRAJECTORY_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"

enum {
    TRAJECTORY_POINTS_MAX = 63,
    TRAJECTORY_POINTS_MIN = 2,
    TRAJECTORY_ASSEMBLY_TIMEOUT_US = 200000, /* far below the 16 plans after which plan_counter repeats */
};

/* One point of a plan, track frame. */
typedef struct trajectory_point {
    float x;         /* m */
    float y;         /* m */
    float yaw;       /* rad, direction of the path */
    float curvature; /* 1/m, left positive */
    float speed;     /* m/s */
    float bank;      /* rad, positive with the left side low */
    float s;         /* m along the plan from its first point */
} trajectory_point;

typedef struct trajectory {
    trajectory_point points[TRAJECTORY_POINTS_MAX];
    uint64_t received_us;  /* tick in which the last missing frame arrived */
    uint32_t plan_time_ms; /* as the planner stamped it */
    float origin_s;        /* m, track coordinate of the first point */
    uint8_t count;         /* points, TRAJECTORY_POINTS_MIN..TRAJECTORY_POINTS_MAX */
    uint8_t mission;
    uint8_t plan_counter; /* 0..15 */
    bool ends_in_stop;    /* the car is to stand at the last point */
} trajectory;

/* Reception state: zero it to start. */
typedef struct trajectory_receiver {
    trajectory buffers[2];
    uint64_t pose_seen;   /* bit i: the pose of point i has arrived */
    uint64_t motion_seen; /* bit i: the motion of point i has arrived */
    uint64_t started_us;  /* when the header of the plan being assembled arrived */
    uint32_t completed;   /* plans handed over */
    uint32_t incomplete;  /* plans given up with points missing */
    uint32_t malformed;   /* whole plans whose points do not form a path */
    uint32_t rejected;    /* plan frames that belong to no plan being assembled, or cannot be read */
    uint32_t repeated;    /* frames that arrived again with the same content */
    uint8_t latest;       /* buffer that holds the newest complete plan */
    bool available;       /* at least one plan was complete */
    bool assembling;      /* the other buffer is being filled */
} trajectory_receiver;

/* Take one frame from CAN-A; frames other than the three of a plan are ignored.
 *
 * A plan is handed over when its header and both frames of all its points have arrived under the same plan_counter
 * within TRAJECTORY_ASSEMBLY_TIMEOUT_US. A frame of another plan, or one that contradicts a point already received,
 * ends the assembly: a plan is never mixed from two.
 * frame: not null. now_us: time of the tick, monotonic.
 */
void trajectory_receiver_push(trajectory_receiver *self, const can_frame *frame, uint64_t now_us);

/* Newest complete plan, or null before the first. Valid until the next push. */
const trajectory *trajectory_receiver_latest(const trajectory_receiver *self);

#endif
