#include "autonomy/native/clusters.h"

#include <math.h>

#include "autonomy/native/kernel.h"
#include "autonomy/native/radix_sort.h"

/* Take in what can be looked at. Returns how many points. */
static uint32_t take_points(clusters *self, const cloud_point *points, uint32_t count, int32_t *labels,
                            cloud_tally *tally)
{
    uint32_t taken = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        labels[i] = CLUSTERS_OUTLIER;
        if (cloud_takes(&points[i]) != 0) {
            self->points[taken] = points[i];
            self->places[taken] = i;
            taken++;
        }
    }
    cloud_count_dropped(points, count, count - taken, tally);
    return taken;
}

static void count_sizes(clusters *self, uint32_t count, uint32_t components)
{
    for (uint32_t i = 0U; i < components; i++) {
        self->sizes[i] = 0U;
    }
    for (uint32_t i = 0U; i < count; i++) {
        self->sizes[self->component[i]]++;
    }
}

/* Drop the points of small components. Returns how many points are left. */
static uint32_t drop_outliers(clusters *self, uint32_t count)
{
    uint32_t left = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        if (self->sizes[self->component[i]] >= self->config.points_min) {
            self->points[left] = self->points[i];
            self->places[left] = self->places[i];
            left++;
        }
    }
    return left;
}

/* Number the components anew, nearest first. */
static void order_by_range(clusters *self, uint32_t count, uint32_t components)
{
    for (uint32_t i = 0U; i < components; i++) {
        self->ranges[i] = UINT32_MAX;
        self->order[i] = i;
    }
    for (uint32_t i = 0U; i < count; i++) {
        const cloud_point *point = &self->points[i];
        const uint32_t range = radix_key(point->x * point->x + point->y * point->y);
        uint32_t *nearest = &self->ranges[self->component[i]];
        *nearest = range < *nearest ? range : *nearest;
    }
    radix_sort(self->ranges, self->order, self->scratch, components);
    for (uint32_t rank = 0U; rank < components; rank++) {
        self->keys[self->order[rank]] = rank;
    }
    for (uint32_t i = 0U; i < count; i++) {
        self->component[i] = self->keys[self->component[i]];
    }
}

/* Bring points into the order of their components, then of x, then of y. */
static void sort_points(clusters *self, uint32_t count)
{
    for (uint32_t i = 0U; i < count; i++) {
        self->order[i] = i;
        self->keys[i] = radix_key(self->points[i].y);
    }
    radix_sort(self->keys, self->order, self->scratch, count);
    for (uint32_t i = 0U; i < count; i++) {
        self->keys[i] = radix_key(self->points[i].x);
    }
    radix_sort(self->keys, self->order, self->scratch, count);
    radix_sort(self->component, self->order, self->scratch, count);
    for (uint32_t i = 0U; i < count; i++) {
        self->x[i] = self->points[self->order[i]].x;
        self->y[i] = self->points[self->order[i]].y;
    }
}

/* The object that is the sorted points from start on. */
static clusters_object make_object(clusters *self, uint32_t start, uint32_t count)
{
    const float first_z = self->points[self->order[start]].z;
    clusters_object object = {.z_low = first_z, .z_high = first_z, .range = INFINITY, .points = count};
    for (uint32_t i = start; i < start + count; i++) {
        object.z_low = least(object.z_low, self->points[self->order[i]].z);
        object.z_high = greatest(object.z_high, self->points[self->order[i]].z);
        object.range = least(object.range, sqrtf(self->x[i] * self->x[i] + self->y[i] * self->y[i]));
    }
    object.box = oriented_box_fit(&self->hull, &self->x[start], &self->y[start], count);
    return object;
}

clusters_result clusters_find(clusters *self, const cloud_point *points, uint32_t count, int32_t *labels,
                              clusters_object *objects)
{
    clusters_result result = {.status = CLUSTERS_OK};
    const uint32_t taken = take_points(self, points, count, labels, &result.tally);
    result.tally.removed = taken;
    if (taken == 0U) {
        return result;
    }
    uint32_t components = connectivity_find(&self->connectivity, self->points, taken, self->config.link_distance,
                                            self->config.link_distance, self->component);
    if (components == (uint32_t)CONNECTIVITY_FAILED) {
        result.status = CLUSTERS_TOO_DENSE;
        return result;
    }
    count_sizes(self, taken, components);
    const uint32_t left = drop_outliers(self, taken);
    if (left == 0U) {
        return result;
    }
    components = connectivity_find(&self->connectivity, self->points, left, self->config.join_along,
                                   self->config.join_across, self->component);
    if (components == (uint32_t)CONNECTIVITY_FAILED) {
        result.status = CLUSTERS_TOO_DENSE;
        return result;
    }
    order_by_range(self, left, components);
    count_sizes(self, left, components);
    sort_points(self, left);
    result.object_count = components;
    if (components > (uint32_t)CLUSTERS_OBJECTS_MAX) {
        result.status = CLUSTERS_TOO_MANY_OBJECTS;
        result.object_count = CLUSTERS_OBJECTS_MAX;
    }
    uint32_t start = 0U;
    for (uint32_t rank = 0U; rank < result.object_count; rank++) {
        objects[rank] = make_object(self, start, self->sizes[rank]);
        for (uint32_t i = start; i < start + self->sizes[rank]; i++) {
            labels[self->places[self->order[i]]] = (int32_t)rank;
        }
        start += self->sizes[rank];
    }
    result.tally.kept = start;
    result.tally.removed = taken - start;
    return result;
}
