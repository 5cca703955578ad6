/* The rectangle of the smallest circumference around points of the plane.
 *
 * Circumference and not area: of an L, which is what a LiDAR sees of a car, the rectangle along the legs and the one
 * along the line between their ends have the same area. A smallest rectangle has a side on the convex hull, so only its
 * edges are tried (rotating calipers). */
#ifndef AUTONOMY_ORIENTED_BOX_H
#define AUTONOMY_ORIENTED_BOX_H

#include <stdint.h>

#include "autonomy/native/point_cloud.h"

typedef struct oriented_box {
    float x; /* middle, m */
    float y;
    float length; /* m, not less than the width */
    float width;  /* m */
    float yaw;    /* of the length, rad, (-pi/2, pi/2] */
} oriented_box;

/* Working space: a convex polygon. */
typedef struct oriented_box_hull {
    uint32_t count;
    float x[2 * CLOUD_POINTS_MAX];
    float y[2 * CLOUD_POINTS_MAX];
} oriented_box_hull;

/* Fit a box.
 *
 * hull: anything; receives the convex hull, counter-clockwise from the point with the smallest x, then y.
 * x, y: points in ascending order of x, then y; m, finite.
 * count: 1..CLOUD_POINTS_MAX.
 * Of equal boxes, that of the hull's first edge is returned. */
oriented_box oriented_box_fit(oriented_box_hull *hull, const float *x, const float *y, uint32_t count);

#endif
