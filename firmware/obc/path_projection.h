/* A plan as a smooth path: cubic Hermite segments through its points, tangent to their yaws.
 *
 * With points 5 to 8 m apart on a turn of 230 m radius the curve is exact to a fraction of a millimetre, where chords
 * would be off by 3 cm.
 */
#ifndef RACELOOP_OBC_PATH_PROJECTION_H
#define RACELOOP_OBC_PATH_PROJECTION_H

#include <stdbool.h>

#include "obc/trajectory.h"

/* The path at one place. */
typedef struct path_point {
    float s;            /* m from the first point of the plan */
    float x;            /* m */
    float y;            /* m */
    float yaw;          /* rad, (-pi, pi] */
    float curvature;    /* 1/m */
    float speed;        /* m/s, planned */
    float acceleration; /* m/s2, of the planned speed along the path */
    float bank;         /* rad */
} path_point;

/* Foot of the perpendicular from a position to the path. */
typedef struct path_projection {
    path_point foot;
    float lateral; /* m, position left of the path positive */
    bool outside;  /* before the first or beyond the last point: the path is extended straight */
} path_projection;

/* The path at arc length s. plan: count >= 2. s: m; outside the plan it is extended straight at its end's speed, or at
 * standstill beyond a plan that ends in a stop. Planned speed is interpolated at constant acceleration. */
void path_at(const trajectory *plan, float s, path_point *point);

/* Perpendicular foot of (x, y) on the path. At most count + 3 evaluations. */
void path_project(const trajectory *plan, float x, float y, path_projection *projection);

#endif
