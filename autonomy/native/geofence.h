/* Geofence by the track model: what lies on the track, at least a margin inside its boundaries, passes.
 *
 * The centre line is nodes at equal spacing. A raster over the track knows what is inside and what is outside, and for
 * the cells that the fence passes the nearest node, so that it matters neither where a point lies nor which came
 * before. Around its node a point's lateral offset is taken on the circle of the node's curvature, as
 * autonomy/frenet.py does. Where two parts of a track are near each other, the one whose centre line is nearer counts.
 */
#ifndef AUTONOMY_GEOFENCE_H
#define AUTONOMY_GEOFENCE_H

#include <stdbool.h>
#include <stdint.h>

#include "autonomy/native/point_cloud.h"

enum {
    GEOFENCE_NODES_MAX = 32768,
    GEOFENCE_RASTER_MAX = 4194304,
    /* In the raster, where all of a cell is on one side of the fence: */
    GEOFENCE_OUTSIDE = 65534,
    GEOFENCE_INSIDE = 65535,
};

/* A node of the centre line. */
typedef struct geofence_node {
    float x;         /* m, from the raster's corner with the smallest x and y */
    float y;         /* m */
    float cosine;    /* of the heading */
    float sine;      /* of the heading */
    float curvature; /* 1/m, positive to the left */
    float left;      /* m, from the centre line to the fence, positive; the margin is taken off already */
    float right;     /* m, likewise */
} geofence_node;

typedef struct geofence {
    float spacing;       /* m, from node to node along the centre line */
    float cell_size;     /* m, of the raster */
    uint32_t columns;    /* with at least one to spare on each side: its edge has to be outside */
    uint32_t rows;       /* likewise */
    uint32_t node_count; /* 2..GEOFENCE_NODES_MAX; the last is followed by the first */
    geofence_node nodes[GEOFENCE_NODES_MAX];
    uint16_t raster[GEOFENCE_RASTER_MAX]; /* node nearest to the middle of each cell, or on which side all of it is */
} geofence;

/* Where the vehicle frame lies in the track frame: rotated by yaw about z, then pitch about y, then roll about x (ISO
 * 8855, rad), and moved by x, y (m, from the raster's corner). */
typedef struct geofence_pose {
    float x;
    float y;
    float roll;
    float pitch;
    float yaw;
} geofence_pose;

/* Draw the nodes into the raster; to be called once, when everything above the raster is set.
 * Returns false when nodes or raster are too many, or the edge of the raster is not outside. */
bool geofence_draw(geofence *self);

/* Whether a place of the track frame, m from the raster's corner, is inside the fence. */
bool geofence_has(const geofence *self, float x, float y);

/* Keep the points of a cloud that are inside the fence.
 *
 * points: of the vehicle frame, count of them.
 * pose: finite.
 * kept: receives the points inside, in the order they came in; may be the same array as points. */
cloud_tally geofence_apply(const geofence *self, const geofence_pose *pose, const cloud_point *points, uint32_t count,
                           cloud_point *kept);

#endif
