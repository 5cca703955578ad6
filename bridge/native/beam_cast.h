/* Ray casting for a LiDAR that sweeps columns of beams over surfaces made of quads, while it and they move.
 *
 * All beams of a column start at one place and lie in one plane. So a quad is cut by that plane once per column, into a
 * line per triangle, and the beams between the ends of the line meet it: a division per beam, and nothing for what lies
 * between two beams. Which columns can meet a quad follows from the azimuths of its corners. */
#ifndef RACELOOP_BEAM_CAST_H
#define RACELOOP_BEAM_CAST_H

#include <stdbool.h>
#include <stdint.h>

#include "bridge/native/rigid_motion.h"

enum {
    BEAM_COLUMNS_MAX = 1024,
    BEAM_LINES_MAX = 128,
    BEAM_BUCKETS = 256 /* of beam_pattern.bucket */
};

/* A quad whose last corner is no more than this, m, out of the plane of the others is flat. */
#define BEAM_QUAD_FLAT_M 1e-6

/* The beams of one LiDAR in its own axes: x in the middle of its field of view, y left, z up. */
typedef struct beam_pattern {
    uint32_t columns;     /* 1..BEAM_COLUMNS_MAX, from right to left, in the order of time */
    uint32_t lines;       /* 1..BEAM_LINES_MAX, from below */
    double azimuth_first; /* rad, of the first column; all of them within 75 degrees of the x axis */
    double azimuth_step;  /* rad, above 0 */
    double period;        /* s, of a scan, which ends at time 0; column i is taken (columns - i - 0.5) / columns of it
                             before */
    double range_min;     /* m, above 0; what is nearer is not seen and hides nothing */
    double range_max;     /* m */
    double azimuth[BEAM_COLUMNS_MAX][2]; /* cosine, sine */
    double elevation[BEAM_LINES_MAX][2]; /* cosine, sine */
    double slope[BEAM_LINES_MAX];        /* tangent of the elevation, ascending */
    double bucket_per_slope;             /* of the buckets that divide slope[0] .. slope[lines - 1] evenly */
    uint32_t bucket[BEAM_BUCKETS + 1];   /* lines whose slope is below the lower edge of the bucket */
} beam_pattern;

/* Fill the tables of a pattern. Preconditions: its other members are set; elevation: `lines` angles, rad, ascending,
 * within 80 degrees of the horizon. */
void beam_pattern_init(beam_pattern *self, const double *elevation);

/* Four corners in order around, folded along the diagonal from the first to the third: two triangles. */
typedef struct beam_quad {
    double corner[3][4]; /* m: x of all four, y, z */
    double normal[2][3]; /* unit vectors of the triangles 0 1 2 and 0 2 3; zero where one has no area */
    double offset[2];    /* m, of their planes: normal . corner */
    double centre[3];    /* m, of a sphere around all corners */
    double radius;       /* m */
    double reflectivity; /* 0..1 */
    bool folded;         /* whether it is not flat and convex, and so two triangles */
} beam_quad;

/* Fill the rest from corners and reflectivity. */
void beam_quad_init(beam_quad *self);

/* Where the beams of a LiDAR ended; column after column, each from below. */
typedef struct beam_hits {
    double range[BEAM_COLUMNS_MAX * BEAM_LINES_MAX]; /* m, to the nearest surface; range_max without one */
    double echo[BEAM_COLUMNS_MAX * BEAM_LINES_MAX];  /* reflectivity times sine of the incidence; below 0 without */
} beam_hits;

/* Where the columns are while a body is looked at: origin and axes in the body's frame. Room for beam_cast. */
typedef struct beam_column {
    double origin[3];
    double ahead[3]; /* of the column's plane, level for the LiDAR */
    double left[3];  /* normal of the plane */
    double up[3];
    double beside; /* m, left . origin */
} beam_column;

/* Begin a scan: no beam has met anything. */
void beam_hits_clear(const beam_pattern *pattern, beam_hits *hits);

/* Cast all beams on one body; bodies may come in any order, the nearest surface stays.
 * mount: of the LiDAR in the vehicle's frame.
 * vehicle, body: at the end of the scan, both in the same frame.
 * centre, radius: of a sphere around all quads, m, in the body's frame.
 * room: BEAM_COLUMNS_MAX columns, of no meaning before or after.
 * Quads are seen from both sides. One that passes a beam by less than rounding is met or not met. */
void beam_cast(const beam_pattern *pattern, const rigid_pose *mount, const rigid_motion *vehicle,
               const rigid_motion *body, const beam_quad *quads, uint32_t count, const double *centre, double radius,
               beam_column *room, beam_hits *hits);

#endif
