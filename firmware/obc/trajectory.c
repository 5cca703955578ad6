#include "obc/trajectory.h"

#include <math.h>
#include <stddef.h>

#include "generated/autonomy.h"
#include "obc/numeric.h"

/* Plausibility of a path between two neighbouring points. */
static const float spacing_max = 100.0f;        /* m */
static const float heading_checked_from = 0.5f; /* m; rounding on the wire bends shorter chords */
static const float heading_mismatch_max = 0.5f; /* rad, chord against the mean of both yaws */

static trajectory *assembly(trajectory_receiver *self)
{
    return &self->buffers[self->latest ^ 1u];
}

static void give_up(trajectory_receiver *self)
{
    if (self->assembling) {
        self->assembling = false;
        self->incomplete++;
    }
}

/* Fill in the arc length of every point. False when the points do not form a path. */
static bool finish_path(trajectory *plan)
{
    plan->points[0].s = 0.0f;
    for (uint32_t i = 1; i < plan->count; i++) {
        const trajectory_point *from = &plan->points[i - 1u];
        trajectory_point *to = &plan->points[i];
        const float dx = to->x - from->x;
        const float dy = to->y - from->y;
        const float chord = sqrtf(dx * dx + dy * dy);
        const float turn = numeric_wrap_angle(to->yaw - from->yaw);
        if (!(chord <= spacing_max)) {
            return false;
        }
        if (chord > heading_checked_from) {
            const float mean_yaw = from->yaw + 0.5f * turn;
            if (fabsf(numeric_wrap_angle(atan2f(dy, dx) - mean_yaw)) > heading_mismatch_max) {
                return false;
            }
        }
        to->s = from->s + chord * (1.0f + turn * turn / 24.0f); /* arc over its chord, second order */
    }
    return true;
}

static void hand_over_when_complete(trajectory_receiver *self, uint64_t now_us)
{
    trajectory *plan = assembly(self);
    const uint64_t all = (UINT64_C(1) << plan->count) - 1u;
    if (self->pose_seen != all || self->motion_seen != all) {
        return;
    }
    self->assembling = false;
    if (!finish_path(plan)) {
        self->malformed++;
        return;
    }
    plan->received_us = now_us;
    self->latest ^= 1u;
    self->available = true;
    self->completed++;
}

static void take_header(trajectory_receiver *self, const can_frame *frame, uint64_t now_us)
{
    struct autonomy_trajectory_header_t raw;
    give_up(self);
    if (autonomy_trajectory_header_unpack(&raw, frame->data, sizeof frame->data) != 0 ||
        raw.plan_point_count < TRAJECTORY_POINTS_MIN) {
        self->rejected++;
        return;
    }
    trajectory *plan = assembly(self);
    plan->count = raw.plan_point_count;
    plan->mission = raw.plan_mission;
    plan->plan_counter = raw.plan_counter;
    plan->ends_in_stop = raw.plan_ends_in_stop != 0u;
    plan->plan_time_ms = raw.plan_time;
    plan->origin_s = (float)autonomy_trajectory_header_plan_origin_s_decode(raw.plan_origin_s);
    self->pose_seen = 0;
    self->motion_seen = 0;
    self->started_us = now_us;
    self->assembling = true;
}

/* Note that a frame of point `index` arrived. seen: the bits of that kind of frame. same: its content equals what is
 * stored. True when the content is new and is to be stored. */
static bool claim(trajectory_receiver *self, uint64_t *seen, uint8_t index, bool same)
{
    const uint64_t bit = UINT64_C(1) << index;
    if ((*seen & bit) == 0u) {
        *seen |= bit;
        return true;
    }
    if (same) {
        self->repeated++;
    } else {
        self->rejected++;
        give_up(self);
    }
    return false;
}

/* True when a point frame belongs to the plan being assembled. */
static bool belongs(trajectory_receiver *self, uint8_t plan_counter, uint8_t index)
{
    const trajectory *plan = assembly(self);
    if (!self->assembling) {
        self->rejected++;
        return false;
    }
    if (plan_counter != plan->plan_counter || index >= plan->count) {
        self->rejected++;
        give_up(self);
        return false;
    }
    return true;
}

static void take_pose(trajectory_receiver *self, const can_frame *frame, uint64_t now_us)
{
    struct autonomy_trajectory_pose_t raw;
    if (autonomy_trajectory_pose_unpack(&raw, frame->data, sizeof frame->data) != 0 ||
        !belongs(self, raw.pose_plan_counter, raw.pose_index)) {
        return;
    }
    trajectory_point *point = &assembly(self)->points[raw.pose_index];
    const float x = (float)autonomy_trajectory_pose_pose_x_decode(raw.pose_x);
    const float y = (float)autonomy_trajectory_pose_pose_y_decode(raw.pose_y);
    if (claim(self, &self->pose_seen, raw.pose_index, point->x == x && point->y == y)) {
        point->x = x;
        point->y = y;
        hand_over_when_complete(self, now_us);
    }
}

static void take_motion(trajectory_receiver *self, const can_frame *frame, uint64_t now_us)
{
    struct autonomy_trajectory_motion_t raw;
    if (autonomy_trajectory_motion_unpack(&raw, frame->data, sizeof frame->data) != 0 ||
        !belongs(self, raw.motion_plan_counter, raw.motion_index)) {
        return;
    }
    trajectory_point *point = &assembly(self)->points[raw.motion_index];
    const float yaw = (float)autonomy_trajectory_motion_motion_yaw_decode(raw.motion_yaw);
    const float curvature = (float)autonomy_trajectory_motion_motion_curvature_decode(raw.motion_curvature);
    const float speed = (float)autonomy_trajectory_motion_motion_speed_decode(raw.motion_speed);
    const float bank = (float)autonomy_trajectory_motion_motion_bank_decode(raw.motion_bank);
    const bool same =
        point->yaw == yaw && point->curvature == curvature && point->speed == speed && point->bank == bank;
    if (claim(self, &self->motion_seen, raw.motion_index, same)) {
        point->yaw = yaw;
        point->curvature = curvature;
        point->speed = speed;
        point->bank = bank;
        hand_over_when_complete(self, now_us);
    }
}

void trajectory_receiver_push(trajectory_receiver *self, const can_frame *frame, uint64_t now_us)
{
    const bool header = frame->id == AUTONOMY_TRAJECTORY_HEADER_FRAME_ID;
    const bool pose = frame->id == AUTONOMY_TRAJECTORY_POSE_FRAME_ID;
    const bool motion = frame->id == AUTONOMY_TRAJECTORY_MOTION_FRAME_ID;
    if (frame->bus != CAN_BUS_A || !(header || pose || motion)) {
        return;
    }
    if (frame->flags != 0u || frame->dlc < CAN_DATA_MAX) {
        self->rejected++;
        return;
    }
    if (self->assembling && now_us - self->started_us > TRAJECTORY_ASSEMBLY_TIMEOUT_US) {
        give_up(self);
    }
    if (header) {
        take_header(self, frame, now_us);
    } else if (pose) {
        take_pose(self, frame, now_us);
    } else {
        take_motion(self, frame, now_us);
    }
}

const trajectory *trajectory_receiver_latest(const trajectory_receiver *self)
{
    return self->available ? &self->buffers[self->latest] : NULL;
}
