/* Connectivity-based (single-linkage) clustering in the XY plane: two points belong together when a chain of points
 * leads from one to the other with no link longer than a limit. Exact, and the same for any order of the points.
 *
 * Points in one cell of a grid are linked by its size; cells are linked when a pair of their points is. Most pairs of
 * cells are decided by their bounding boxes or by one pair of points; for the rest all pairs are tried, up to a limit
 * that bounds the time. */
#ifndef AUTONOMY_CONNECTIVITY_H
#define AUTONOMY_CONNECTIVITY_H

#include <stdint.h>

#include "autonomy/native/point_cloud.h"

enum {
    CONNECTIVITY_TRIALS_MAX = 8388608, /* pairs of points in one call */
    CONNECTIVITY_FAILED = 0,
};

/* The smallest distance, m: cells of the range have to have numbers. */
#define CONNECTIVITY_DISTANCE_MIN 0.2f

typedef struct connectivity_cell {
    uint32_t key;    /* row and column */
    uint32_t start;  /* in the sorted points; up to the next cell's */
    uint32_t parent; /* towards the cell that stands for the component; never greater than the cell itself */
    uint32_t component;
    float x_low; /* bounding box of the points */
    float x_high;
    float y_low;
    float y_high;
} connectivity_cell;

/* Points of two cells that can be near each other. */
typedef struct connectivity_side {
    uint32_t count;
    float x[CLOUD_POINTS_MAX];
    float y[CLOUD_POINTS_MAX];
} connectivity_side;

typedef struct connectivity {
    uint32_t keys[CLOUD_POINTS_MAX];
    uint32_t order[CLOUD_POINTS_MAX]; /* points by cell */
    uint32_t scratch[CLOUD_POINTS_MAX];
    float x[CLOUD_POINTS_MAX]; /* in that order, compressed so that the ellipse is a circle */
    float y[CLOUD_POINTS_MAX];
    connectivity_cell cells[CLOUD_POINTS_MAX + 1];
    uint32_t cell_count;
    uint32_t trials; /* left */
    connectivity_side one;
    connectivity_side other;
} connectivity;

/* Find the components of a cloud.
 *
 * self: anything; it is working space.
 * points: within the range (cloud_takes), count of them, 1..CLOUD_POINTS_MAX.
 * along, across: longest links in the directions of x and y, m, half axes of an ellipse;
 * CONNECTIVITY_DISTANCE_MIN <= across <= along <= CLOUD_RANGE_M.
 * component: receives the component of each point, numbered from 0 in ascending order of their first cells, which are
 * ordered by y, then x.
 * Returns the number of components, or CONNECTIVITY_FAILED when the points lie so densely that more than
 * CONNECTIVITY_TRIALS_MAX pairs would have to be tried. */
uint32_t connectivity_find(connectivity *self, const cloud_point *points, uint32_t count, float along, float across,
                           uint32_t *component);

#endif
