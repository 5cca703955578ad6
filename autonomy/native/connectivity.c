#include "autonomy/native/connectivity.h"

#include <math.h>

#include "autonomy/native/kernel.h"
#include "autonomy/native/radix_sort.h"

enum {
    COLUMN_BITS = 11,
    HALF_COLUMNS = 1 << (COLUMN_BITS - 1),
    REACH = 2, /* cells; farther off, no point is within the distance */
};

/* Cell size over distance. Below 1/sqrt(2), so that two points of a cell are linked whatever the rounding, and above
 * 1/3, so that REACH is enough. */
#define CELL_SHARE 0.7f

static void sort_into_cells(connectivity *self, const cloud_point *points, uint32_t count, float compression,
                            float distance)
{
    const float per_m = 1.0f / (CELL_SHARE * distance);
    for (uint32_t i = 0U; i < count; i++) {
        const uint32_t column = (uint32_t)(points[i].x * compression * per_m + (float)HALF_COLUMNS);
        const uint32_t row = (uint32_t)(points[i].y * per_m + (float)HALF_COLUMNS);
        self->keys[i] = (row << COLUMN_BITS) | column;
        self->order[i] = i;
    }
    radix_sort(self->keys, self->order, self->scratch, count);
    self->cell_count = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        const uint32_t key = self->keys[self->order[i]];
        const float x = points[self->order[i]].x * compression;
        const float y = points[self->order[i]].y;
        self->x[i] = x;
        self->y[i] = y;
        if (self->cell_count == 0U || self->cells[self->cell_count - 1U].key != key) {
            self->cells[self->cell_count] = (connectivity_cell){
                .key = key, .start = i, .parent = self->cell_count, .x_low = x, .x_high = x, .y_low = y, .y_high = y};
            self->cell_count++;
        }
        connectivity_cell *cell = &self->cells[self->cell_count - 1U];
        cell->x_low = least(cell->x_low, x);
        cell->x_high = greatest(cell->x_high, x);
        cell->y_low = least(cell->y_low, y);
        cell->y_high = greatest(cell->y_high, y);
    }
    self->cells[self->cell_count].start = count;
}

/* The cell that stands for a component; shortens the way for the next time. */
static uint32_t root_of(connectivity *self, uint32_t cell)
{
    connectivity_cell *cells = self->cells;
    while (cells[cell].parent != cell) {
        cells[cell].parent = cells[cells[cell].parent].parent;
        cell = cells[cell].parent;
    }
    return cell;
}

/* Square of the distance from a point to the box of a cell. */
static float box_distance_squared(const connectivity_cell *cell, float x, float y)
{
    return square(greatest(greatest(cell->x_low - x, x - cell->x_high), 0.0f)) +
           square(greatest(greatest(cell->y_low - y, y - cell->y_high), 0.0f));
}

/* The point of a cell that is nearest to a place; of equally near ones that with the smallest x, then y. */
static uint32_t nearest_in(const connectivity *self, uint32_t cell, float x, float y)
{
    uint32_t best = self->cells[cell].start;
    float best_distance = square(self->x[best] - x) + square(self->y[best] - y);
    for (uint32_t i = best + 1U; i < self->cells[cell + 1U].start; i++) {
        const float distance = square(self->x[i] - x) + square(self->y[i] - y);
        if (distance < best_distance ||
            (distance <= best_distance &&
             (self->x[i] < self->x[best] || (self->x[i] <= self->x[best] && self->y[i] < self->y[best])))) {
            best = i;
            best_distance = distance;
        }
    }
    return best;
}

/* The points of a cell that are near enough to the box of another. */
static void collect(const connectivity *self, uint32_t cell, const connectivity_cell *box, float limit,
                    connectivity_side *side)
{
    side->count = 0U;
    for (uint32_t i = self->cells[cell].start; i < self->cells[cell + 1U].start; i++) {
        if (box_distance_squared(box, self->x[i], self->y[i]) <= limit) {
            side->x[side->count] = self->x[i];
            side->y[side->count] = self->y[i];
            side->count++;
        }
    }
}

static bool any_pair(const connectivity_side *one, const connectivity_side *other, float limit)
{
    for (uint32_t i = 0U; i < one->count; i++) {
        uint32_t found = 0U; /* without a way out, so that it is done several at a time */
        for (uint32_t j = 0U; j < other->count; j++) {
            found |= (uint32_t)(square(other->x[j] - one->x[i]) + square(other->y[j] - one->y[i]) <= limit);
        }
        if (found != 0U) {
            return true;
        }
    }
    return false;
}

typedef enum linked { LINKED_NO, LINKED_YES, LINKED_TOO_DENSE } linked;

static linked are_linked(connectivity *self, uint32_t one, uint32_t other, float limit)
{
    const connectivity_cell *a = &self->cells[one];
    const connectivity_cell *b = &self->cells[other];
    const float gap_x = greatest(greatest(b->x_low - a->x_high, a->x_low - b->x_high), 0.0f);
    const float gap_y = greatest(greatest(b->y_low - a->y_high, a->y_low - b->y_high), 0.0f);
    if (square(gap_x) + square(gap_y) > limit) {
        return LINKED_NO;
    }
    const uint32_t near_other = nearest_in(self, one, 0.5f * (b->x_low + b->x_high), 0.5f * (b->y_low + b->y_high));
    const uint32_t near_one = nearest_in(self, other, self->x[near_other], self->y[near_other]);
    if (square(self->x[near_one] - self->x[near_other]) + square(self->y[near_one] - self->y[near_other]) <= limit) {
        return LINKED_YES;
    }
    collect(self, one, b, limit, &self->one);
    collect(self, other, a, limit, &self->other);
    const uint64_t trials = (uint64_t)self->one.count * self->other.count;
    if (trials > self->trials) {
        return LINKED_TOO_DENSE;
    }
    self->trials -= (uint32_t)trials;
    return any_pair(&self->one, &self->other, limit) ? LINKED_YES : LINKED_NO;
}

/* Link all cells; false when there is too much to try. */
static bool link_cells(connectivity *self, float limit)
{
    uint32_t window[REACH + 1] = {0}; /* first cell that may be within reach, in this row and those above */
    for (uint32_t one = 0U; one < self->cell_count; one++) {
        for (uint32_t row = 0U; row <= (uint32_t)REACH; row++) {
            const uint32_t middle = self->cells[one].key + (row << COLUMN_BITS);
            uint32_t other = window[row];
            while (other < self->cell_count && self->cells[other].key + (uint32_t)REACH < middle) {
                other++;
            }
            window[row] = other;
            for (; other < self->cell_count && self->cells[other].key <= middle + (uint32_t)REACH; other++) {
                const uint32_t root = root_of(self, one);
                const uint32_t other_root = root_of(self, other);
                if (other <= one || root == other_root) {
                    continue;
                }
                const linked answer = are_linked(self, one, other, limit);
                if (answer == LINKED_TOO_DENSE) {
                    return false;
                }
                if (answer == LINKED_YES) {
                    const uint32_t first = root < other_root ? root : other_root;
                    self->cells[root].parent = first;
                    self->cells[other_root].parent = first;
                }
            }
        }
    }
    return true;
}

uint32_t connectivity_find(connectivity *self, const cloud_point *points, uint32_t count, float along, float across,
                           uint32_t *component)
{
    self->trials = CONNECTIVITY_TRIALS_MAX;
    sort_into_cells(self, points, count, across / along, across);
    if (!link_cells(self, across * across)) {
        return CONNECTIVITY_FAILED;
    }
    uint32_t components = 0U;
    for (uint32_t cell = 0U; cell < self->cell_count; cell++) {
        const uint32_t root = root_of(self, cell); /* not after the cell, so numbered already */
        self->cells[cell].component = root == cell ? components++ : self->cells[root].component;
        for (uint32_t i = self->cells[cell].start; i < self->cells[cell + 1U].start; i++) {
            component[self->order[i]] = self->cells[cell].component;
        }
    }
    return components;
}
