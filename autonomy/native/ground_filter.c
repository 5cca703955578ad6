#include "autonomy/native/ground_filter.h"

#include <math.h>

#include "autonomy/native/kernel.h"

/* For points that are not looked at. */
enum { NO_CELL = GROUND_CELLS * GROUND_CELLS };

/* A place in the grid; NaN is at its edge. */
static float bounded(float place)
{
    return least(greatest(place, 0.0f), (float)GROUND_CELLS - 1.0f);
}

/* Order of two points of equal height, so that it does not matter which of them came first. */
static bool comes_before(const cloud_point *one, const cloud_point *other)
{
    return one->x < other->x || (one->x <= other->x && one->y < other->y);
}

static void cell_add(ground_cell *cell, const cloud_point *point)
{
    if (cell->points == 0U) {
        cell->low = *point;
        cell->high = *point;
    }
    if (point->z <= cell->low.z && (point->z < cell->low.z || comes_before(point, &cell->low))) {
        cell->low = *point;
    }
    if (point->z >= cell->high.z && (point->z > cell->high.z || comes_before(point, &cell->high))) {
        cell->high = *point;
    }
    cell->points++;
}

/* Height of a point over the lowest of its cell, beyond what the road may climb between them. */
static float height_in(const ground_cell *cell, const cloud_point *point, const ground_config *config)
{
    const float dx = point->x - cell->low.x;
    const float dy = point->y - cell->low.y;
    return point->z - cell->low.z - config->slope_max * sqrtf(dx * dx + dy * dy);
}

static bool cell_is_object(const ground_cell *cell, const ground_config *config)
{
    return cell->points > config->points_threshold && height_in(cell, &cell->high, config) > config->height_threshold;
}

/* Whether a point of an object's cell stays. */
static bool point_stays(const ground_cell *cell, const cloud_point *point, const ground_config *config)
{
    return cell->points <= config->foot_points || height_in(cell, point, config) > config->height_threshold;
}

cloud_tally ground_filter_apply(ground_filter *self, const cloud_point *points, uint32_t count, cloud_point *kept)
{
    cloud_tally tally = {0};
    const float per_m = 1.0f / self->config.cell_size;
    const float half = 0.5f * (float)GROUND_CELLS;
    int32_t taken = 0;
    for (uint32_t i = 0U; i < count; i++) {
        const cloud_point point = points[i];
        const int32_t takes = cloud_takes(&point);
        const int32_t column = (int32_t)bounded(point.x * per_m + half);
        const int32_t row = (int32_t)bounded(point.y * per_m + half);
        self->cell_of[i] = takes != 0 ? row * GROUND_CELLS + column : NO_CELL;
        taken += takes;
    }
    cloud_count_dropped(points, count, count - (uint32_t)taken, &tally);
    uint32_t used = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        ground_cell *cell = &self->cells[self->cell_of[i]];
        if (cell->points == 0U) {
            self->used[used++] = self->cell_of[i];
        }
        cell_add(cell, &points[i]);
    }
    self->cells[NO_CELL].points = 0U; /* not an object, whatever lies in it */
    for (uint32_t i = 0U; i < used; i++) {
        self->is_object[self->used[i]] = cell_is_object(&self->cells[self->used[i]], &self->config);
    }
    uint32_t next = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        const int32_t cell = self->cell_of[i];
        if (self->is_object[cell] && point_stays(&self->cells[cell], &points[i], &self->config)) {
            kept[next++] = points[i];
        }
    }
    for (uint32_t i = 0U; i < used; i++) {
        self->cells[self->used[i]].points = 0U;
    }
    tally.kept = next;
    tally.removed = (uint32_t)taken - next;
    return tally;
}
