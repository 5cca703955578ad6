/* Ground removal by the distribution of heights in a grid (Jung et al. 2023, Algorithm 1).
 *
 * The cloud is projected to the XY plane and sorted into square cells. A cell holds an object when it has more points
 * than one threshold and more height than another; all points of the others are ground. A banked road climbs inside a
 * cell too. So height is what remains between the lowest and the highest point of the cell beyond the steepest road:
 *
 *     height = z_high - z_low - slope_max * (distance of the two in the XY plane)
 *
 * which is at most zero on every plane up to that slope, in any direction. Of an object's cell with many points those
 * at its foot are removed too, by the same measure: they are the road beside the object, and would make it larger. A
 * cell with few points keeps them all. */
#ifndef AUTONOMY_GROUND_FILTER_H
#define AUTONOMY_GROUND_FILTER_H

#include <stdbool.h>
#include <stdint.h>

#include "autonomy/native/point_cloud.h"

enum { GROUND_CELLS = 520 }; /* along a side of the grid: the range both ways and some more, for rounding */

typedef struct ground_config {
    float cell_size;           /* m, at least GROUND_CELL_SIZE_MIN: the grid covers the range */
    uint32_t points_threshold; /* an object's cell has more points */
    float height_threshold;    /* m, above 0; an object's cell has more height */
    float slope_max;           /* tangent of the steepest road in the vehicle frame, 0 or more */
    uint32_t foot_points;      /* an object's cell with more points loses those at its foot */
} ground_config;

/* The smallest cell_size, m. */
#define GROUND_CELL_SIZE_MIN 0.5f

typedef struct ground_cell {
    uint32_t points;
    cloud_point low; /* of equally low points the one with the smallest x, then y; so is high */
    cloud_point high;
} ground_cell;

typedef struct ground_filter {
    ground_config config;
    ground_cell cells[GROUND_CELLS * GROUND_CELLS + 1]; /* without points between calls */
    bool is_object[GROUND_CELLS * GROUND_CELLS + 1];    /* of cells with points; apart, to be near each other */
    int32_t used[CLOUD_POINTS_MAX];                     /* cells with points */
    int32_t cell_of[CLOUD_POINTS_MAX];                  /* of each point */
} ground_filter;

/* Remove the ground from a cloud.
 *
 * self: zeroed but for its configuration, or as the last call left it.
 * points: of the vehicle frame, count of them, at most CLOUD_POINTS_MAX.
 * kept: receives the points of objects, in the order they came in; may be the same array as points. */
cloud_tally ground_filter_apply(ground_filter *self, const cloud_point *points, uint32_t count, cloud_point *kept);

#endif
