#include "autonomy/native/geofence.h"

#include <math.h>

#include "autonomy/native/kernel.h"

enum { STRIDES_MAX = 4 }; /* from the node of the raster's cell to the one nearest to a point in it */

/* Half of the diagonal of a cell of size 1. */
#define HALF_DIAGONAL 0.7072f

/* From the middle of a cell of size 1 to the fence, for all of it to be on one side where the width changes too. */
#define WHOLE_CELL 0.9f

static int32_t wrapped(int32_t node, int32_t count)
{
    return node < 0 ? node + count : node >= count ? node - count : node;
}

/* Square of the distance from the middle of a raster cell to a node. */
static float distance_squared(const geofence *self, uint32_t column, uint32_t row, uint32_t node)
{
    return square(((float)column + 0.5f) * self->cell_size - self->nodes[node].x) +
           square(((float)row + 0.5f) * self->cell_size - self->nodes[node].y);
}

static uint32_t cell_at(float place, float cell_size, uint32_t cells)
{
    return (uint32_t)least(greatest(place / cell_size, 0.0f), (float)(cells - 1U));
}

static void draw_node(geofence *self, uint32_t node)
{
    const geofence_node *at = &self->nodes[node];
    const float reach = greatest(at->left, at->right) + self->spacing + HALF_DIAGONAL * self->cell_size;
    const uint32_t last_column = cell_at(at->x + reach, self->cell_size, self->columns);
    const uint32_t last_row = cell_at(at->y + reach, self->cell_size, self->rows);
    for (uint32_t row = cell_at(at->y - reach, self->cell_size, self->rows); row <= last_row; row++) {
        for (uint32_t column = cell_at(at->x - reach, self->cell_size, self->columns); column <= last_column;
             column++) {
            uint16_t *cell = &self->raster[row * self->columns + column];
            if (*cell == (uint16_t)GEOFENCE_OUTSIDE ||
                distance_squared(self, column, row, node) < distance_squared(self, column, row, *cell)) {
                *cell = (uint16_t)node;
            }
        }
    }
}

/* How far a place is from the fence, m, positive inside.
 *
 * near: a node not far from it. */
static float clearance(const geofence *self, uint32_t near, float x, float y)
{
    const int32_t count = (int32_t)self->node_count;
    int32_t i = (int32_t)near;
    for (uint32_t stride = 0U;; stride++) {
        const geofence_node *node = &self->nodes[i];
        const float dx = x - node->x;
        const float dy = y - node->y;
        const float along = dx * node->cosine + dy * node->sine;
        const float across = dy * node->cosine - dx * node->sine;
        const float shrink = 1.0f - node->curvature * across;
        const float nodes = along / (self->spacing * greatest(shrink, 0.5f));
        const float further = fabsf(nodes);
        if (further <= 0.5f || further > (float)count || stride == (uint32_t)STRIDES_MAX) {
            /* From the circle of the node, written so that a straight is no special case and nothing cancels. */
            const float radius = sqrtf(square(node->curvature * along) + square(shrink));
            const float left = (2.0f * across - node->curvature * (along * along + across * across)) / (1.0f + radius);
            const geofence_node *next = &self->nodes[wrapped(i + (nodes < 0.0f ? -1 : 1), count)];
            const float fraction = least(further, 1.0f);
            return least(node->left + fraction * (next->left - node->left) - left,
                         node->right + fraction * (next->right - node->right) + left);
        }
        i = wrapped(i + (int32_t)(nodes < 0.0f ? nodes - 0.5f : nodes + 0.5f), count);
    }
}

static bool edge_is_outside(const geofence *self)
{
    bool outside = true;
    for (uint32_t column = 0U; column < self->columns; column++) {
        outside = outside && self->raster[column] == (uint16_t)GEOFENCE_OUTSIDE &&
                  self->raster[(self->rows - 1U) * self->columns + column] == (uint16_t)GEOFENCE_OUTSIDE;
    }
    for (uint32_t row = 0U; row < self->rows; row++) {
        outside = outside && self->raster[row * self->columns] == (uint16_t)GEOFENCE_OUTSIDE &&
                  self->raster[row * self->columns + self->columns - 1U] == (uint16_t)GEOFENCE_OUTSIDE;
    }
    return outside;
}

bool geofence_draw(geofence *self)
{
    if (self->node_count < 2U || self->node_count > (uint32_t)GEOFENCE_NODES_MAX || self->columns == 0U ||
        self->rows == 0U || self->columns > (uint32_t)GEOFENCE_RASTER_MAX / self->rows) {
        return false;
    }
    for (uint32_t cell = 0U; cell < self->columns * self->rows; cell++) {
        self->raster[cell] = GEOFENCE_OUTSIDE;
    }
    for (uint32_t node = 0U; node < self->node_count; node++) {
        draw_node(self, node);
    }
    for (uint32_t row = 0U; row < self->rows; row++) {
        for (uint32_t column = 0U; column < self->columns; column++) {
            uint16_t *cell = &self->raster[row * self->columns + column];
            if (*cell != (uint16_t)GEOFENCE_OUTSIDE) {
                const float margin = clearance(self, *cell, ((float)column + 0.5f) * self->cell_size,
                                               ((float)row + 0.5f) * self->cell_size);
                if (margin > WHOLE_CELL * self->cell_size) {
                    *cell = GEOFENCE_INSIDE;
                } else if (margin < -WHOLE_CELL * self->cell_size) {
                    *cell = GEOFENCE_OUTSIDE;
                }
            }
        }
    }
    return edge_is_outside(self);
}

/* The cell of the raster that a place is in; for what is beside the raster, and for NaN, one at its edge. */
static int32_t raster_cell(const geofence *self, float x, float y, float cells_per_m)
{
    const int32_t column = (int32_t)least(greatest(x * cells_per_m, 0.0f), (float)(int32_t)self->columns - 1.0f);
    const int32_t row = (int32_t)least(greatest(y * cells_per_m, 0.0f), (float)(int32_t)self->rows - 1.0f);
    return row * (int32_t)self->columns + column;
}

static bool is_inside(const geofence *self, uint32_t cell, float x, float y)
{
    const uint32_t drawn = self->raster[cell];
    return drawn < (uint32_t)GEOFENCE_OUTSIDE ? clearance(self, drawn, x, y) > 0.0f
                                              : drawn == (uint32_t)GEOFENCE_INSIDE;
}

bool geofence_has(const geofence *self, float x, float y)
{
    return is_inside(self, (uint32_t)raster_cell(self, x, y, 1.0f / self->cell_size), x, y);
}

cloud_tally geofence_apply(const geofence *self, const geofence_pose *pose, const cloud_point *points, uint32_t count,
                           cloud_point *kept)
{
    cloud_tally tally = {0};
    const float cos_roll = cosf(pose->roll);
    const float sin_roll = sinf(pose->roll);
    const float cos_pitch = cosf(pose->pitch);
    const float sin_pitch = sinf(pose->pitch);
    const float cos_yaw = cosf(pose->yaw);
    const float sin_yaw = sinf(pose->yaw);
    const float xx = cos_yaw * cos_pitch;
    const float xy = cos_yaw * sin_pitch * sin_roll - sin_yaw * cos_roll;
    const float xz = cos_yaw * sin_pitch * cos_roll + sin_yaw * sin_roll;
    const float yx = sin_yaw * cos_pitch;
    const float yy = sin_yaw * sin_pitch * sin_roll + cos_yaw * cos_roll;
    const float yz = sin_yaw * sin_pitch * cos_roll - cos_yaw * sin_roll;
    const float cells_per_m = 1.0f / self->cell_size;
    for (uint32_t start = 0U; start < count; start += (uint32_t)CLOUD_BLOCK) {
        const uint32_t size = count - start < (uint32_t)CLOUD_BLOCK ? count - start : (uint32_t)CLOUD_BLOCK;
        float x[CLOUD_BLOCK];
        float y[CLOUD_BLOCK];
        int32_t cell[CLOUD_BLOCK];
        int32_t taken = 0;
        for (uint32_t i = 0U; i < size; i++) {
            const cloud_point point = points[start + i];
            const int32_t takes = cloud_takes(&point);
            x[i] = pose->x + xx * point.x + xy * point.y + xz * point.z;
            y[i] = pose->y + yx * point.x + yy * point.y + yz * point.z;
            cell[i] = takes * raster_cell(self, x[i], y[i], cells_per_m); /* the first is outside */
            taken += takes;
        }
        cloud_count_dropped(&points[start], size, size - (uint32_t)taken, &tally);
        uint32_t next = tally.kept;
        for (uint32_t i = 0U; i < size; i++) {
            kept[next] = points[start + i];
            next += (uint32_t)is_inside(self, (uint32_t)cell[i], x[i], y[i]);
        }
        tally.removed += (uint32_t)taken - (next - tally.kept);
        tally.kept = next;
    }
    return tally;
}
