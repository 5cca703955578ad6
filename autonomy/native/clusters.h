/* Objects in a cloud without ground: connectivity-based clustering in two steps, a box around each cluster.
 *
 * Clustering by connectivity is sensitive to outliers, and may leave one object in pieces (Jung et al. 2023). So the
 * first step links points over a short distance and drops what stays small; the second joins what is left over a longer
 * one, which no outlier can bridge any more, and which is longer along the road than across: of a car ahead nose and
 * rear wing are seen with nothing in between, and cars are never as near behind each other as side by side.
 * Distances are in the XY plane: on a track nothing stands over another. */
#ifndef AUTONOMY_CLUSTERS_H
#define AUTONOMY_CLUSTERS_H

#include <stdint.h>

#include "autonomy/native/connectivity.h"
#include "autonomy/native/oriented_box.h"
#include "autonomy/native/point_cloud.h"

enum {
    CLUSTERS_OBJECTS_MAX = 64,
    CLUSTERS_OUTLIER = -1,
};

typedef struct clusters_config {
    float link_distance; /* m, first step: from point to point; CONNECTIVITY_DISTANCE_MIN..CLOUD_RANGE_M */
    uint32_t points_min; /* at least 1; a cluster of the first step with fewer is outliers */
    float join_along;    /* m, second step: from cluster to cluster, between their nearest points, in x; likewise */
    float join_across;   /* m, in y; not more than join_along */
} clusters_config;

typedef struct clusters_object {
    oriented_box box;
    float z_low; /* m, of the lowest point */
    float z_high;
    float range; /* m in the XY plane, of the nearest point */
    uint32_t points;
} clusters_object;

typedef enum clusters_status {
    CLUSTERS_OK = 0,
    CLUSTERS_TOO_DENSE = 1,        /* see connectivity_find; no objects */
    CLUSTERS_TOO_MANY_OBJECTS = 2, /* the nearest are there */
} clusters_status;

/* What came of a cloud. Removed are the outliers, and the points of objects that were too many. */
typedef struct clusters_result {
    clusters_status status;
    uint32_t object_count;
    cloud_tally tally;
} clusters_result;

typedef struct clusters {
    clusters_config config;
    /* The rest is working space. */
    connectivity connectivity;
    oriented_box_hull hull;
    cloud_point points[CLOUD_POINTS_MAX]; /* that are looked at */
    uint32_t places[CLOUD_POINTS_MAX];    /* of them in the cloud */
    uint32_t component[CLOUD_POINTS_MAX];
    uint32_t sizes[CLOUD_POINTS_MAX];  /* of components, points */
    uint32_t ranges[CLOUD_POINTS_MAX]; /* of components, as keys */
    uint32_t keys[CLOUD_POINTS_MAX];
    uint32_t order[CLOUD_POINTS_MAX];
    uint32_t scratch[CLOUD_POINTS_MAX];
    float x[CLOUD_POINTS_MAX];
    float y[CLOUD_POINTS_MAX];
} clusters;

/* Find the objects of a cloud; the same for any order of its points.
 *
 * self: its configuration is read.
 * points: of the vehicle frame, count of them, at most CLOUD_POINTS_MAX.
 * labels: receives, for each point, the number of its object or CLUSTERS_OUTLIER.
 * objects: receives up to CLUSTERS_OBJECTS_MAX objects, nearest first; of equally near ones that whose first cell has
 * the smaller y, then x. */
clusters_result clusters_find(clusters *self, const cloud_point *points, uint32_t count, int32_t *labels,
                              clusters_object *objects);

#endif
