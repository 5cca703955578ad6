/* The virtual path beside a wall: geometry in the frame of the wall's polynomial. */
#ifndef RACELOOP_OBC_WALL_PATH_H
#define RACELOOP_OBC_WALL_PATH_H

#include "obc/wall_receiver.h"

/* A car farther from the wall than this keeps its distance; a nearer one is led away to it, m (the paper's bias). */
#define WALL_PATH_BIAS 1.5f

/* The point of a wall that is nearest to a car. */
typedef struct wall_foot {
    float x;         /* m, of the wall's frame */
    float distance;  /* m, >= 0, from the car to the wall */
    float side;      /* 1: the wall is to the right, the path left of it; -1: the other way round */
    float curvature; /* 1/m of the wall, positive to the left */
} wall_foot;

/* A point of the virtual path. */
typedef struct wall_target {
    float x; /* m, of the wall's frame */
    float y;
} wall_target;

/* Foot of a car at (x, y), m. wall: finite. Within a few metres of the polynomial's own frame the error is below a
 * centimetre. */
void wall_path_foot(const wall_polynomial *wall, float x, float y, wall_foot *foot);

/* Distance from the wall that a virtual path leads to from a car at `distance`, m: its own, or the bias when that is
 * less. */
float wall_path_distance(float distance);

/* Point of the line parallel to the wall at `distance` that lies `lookahead` m from (x, y), ahead; nearer when the wall
 * was not seen so far. side: of the foot. */
wall_target wall_path_target(const wall_polynomial *wall, float side, float distance, float x, float y,
                             float lookahead);

#endif
