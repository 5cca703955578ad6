/* Motion of a rigid body with a constant twist, for what moves while a sensor scans. */
#ifndef RACELOOP_RIGID_MOTION_H
#define RACELOOP_RIGID_MOTION_H

/* A place and the axes of something there, in another frame. */
typedef struct rigid_pose {
    double place[3]; /* m */
    double axes[9];  /* rotation matrix by rows: its columns are the axes */
} rigid_pose;

/* A pose at time 0 and a twist that stays as it is in the body's own axes. */
typedef struct rigid_motion {
    rigid_pose pose;
    double velocity[3]; /* m/s, in the body's axes */
    double rate[3];     /* rad/s, in the body's axes */
} rigid_motion;

/* Pose at a time, s, before or after 0: the exponential of the twist (Murray, Li, Sastry, A Mathematical Introduction
 * to Robotic Manipulation, 1994, section 2.3). Precondition: the body turns by less than a full turn until then. */
rigid_pose rigid_motion_at(const rigid_motion *motion, double time);

/* What is given in the frame of `pose`, in the frame that `pose` is given in. */
rigid_pose rigid_pose_out(const rigid_pose *pose, const rigid_pose *inside);

/* What is given in the frame that `pose` is given in, in the frame of `pose`. */
rigid_pose rigid_pose_in(const rigid_pose *pose, const rigid_pose *outside);

#endif
