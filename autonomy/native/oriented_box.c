#include "autonomy/native/oriented_box.h"

#include <math.h>

#include "autonomy/native/kernel.h"
#include <stdbool.h>

static const float quarter_turn = 1.57079633f;

#define EDGE_MIN 1e-6f /* m */

/* Put a point on the hull, unless it is the last one again, and take off what it covers; those before `first` stay. */
static void hull_push(oriented_box_hull *hull, uint32_t first, float x, float y)
{
    if (hull->count > 0U && hull->x[hull->count - 1U] == x && hull->y[hull->count - 1U] == y) {
        return;
    }
    while (hull->count >= first + 2U) {
        const uint32_t a = hull->count - 2U;
        const uint32_t b = hull->count - 1U;
        const float turn = (hull->x[b] - hull->x[a]) * (y - hull->y[a]) - (hull->y[b] - hull->y[a]) * (x - hull->x[a]);
        if (turn > 0.0f) {
            break;
        }
        hull->count--;
    }
    hull->x[hull->count] = x;
    hull->y[hull->count] = y;
    hull->count++;
}

/* Andrew's monotone chain. */
static void hull_make(oriented_box_hull *hull, const float *x, const float *y, uint32_t count)
{
    hull->count = 0U;
    for (uint32_t i = 0U; i < count; i++) {
        hull_push(hull, 0U, x[i], y[i]);
    }
    const uint32_t first = hull->count - 1U;
    for (uint32_t i = count - 1U; i > 0U; i--) {
        hull_push(hull, first, x[i - 1U], y[i - 1U]);
    }
    if (hull->count > 1U) {
        hull->count--; /* the first point again */
    }
}

/* Axes of a box: origin and direction of its first side. */
typedef struct box_axes {
    float x;
    float y;
    float cosine;
    float sine;
} box_axes;

static float along(const box_axes *axes, const oriented_box_hull *hull, uint32_t i)
{
    const uint32_t at = i % hull->count;
    return (hull->x[at] - axes->x) * axes->cosine + (hull->y[at] - axes->y) * axes->sine;
}

static float across(const box_axes *axes, const oriented_box_hull *hull, uint32_t i)
{
    const uint32_t at = i % hull->count;
    return (hull->y[at] - axes->y) * axes->cosine - (hull->x[at] - axes->x) * axes->sine;
}

/* Box with its first side on the given axes. */
static oriented_box make_box(const box_axes *axes, float behind, float ahead, float depth)
{
    const float middle = 0.5f * (behind + ahead);
    const float long_side = ahead - behind;
    const bool turned = depth > long_side;
    float yaw = atan2f(axes->sine, axes->cosine) + (turned ? quarter_turn : 0.0f);
    if (yaw > quarter_turn) {
        yaw -= 2.0f * quarter_turn;
    }
    if (yaw <= -quarter_turn) {
        yaw += 2.0f * quarter_turn;
    }
    return (oriented_box){.x = axes->x + middle * axes->cosine - 0.5f * depth * axes->sine,
                          .y = axes->y + middle * axes->sine + 0.5f * depth * axes->cosine,
                          .length = turned ? depth : long_side,
                          .width = turned ? long_side : depth,
                          .yaw = yaw};
}

oriented_box oriented_box_fit(oriented_box_hull *hull, const float *x, const float *y, uint32_t count)
{
    hull_make(hull, x, y, count);
    oriented_box best = {.x = hull->x[0], .y = hull->y[0]};
    float best_size = INFINITY;
    /* The outermost points ahead, across and behind go once around while the edge does. */
    uint32_t ahead = 1U;
    uint32_t far = 1U;
    uint32_t behind = 1U;
    for (uint32_t i = 0U; hull->count > 1U && i < hull->count; i++) {
        const uint32_t next = (i + 1U) % hull->count;
        const float dx = hull->x[next] - hull->x[i];
        const float dy = hull->y[next] - hull->y[i];
        const float edge = sqrtf(dx * dx + dy * dy);
        if (edge < EDGE_MIN) {
            continue; /* has no direction */
        }
        const box_axes axes = {.x = hull->x[i], .y = hull->y[i], .cosine = dx / edge, .sine = dy / edge};
        const uint32_t end = i + hull->count;
        ahead = ahead > i + 1U ? ahead : i + 1U;
        while (ahead < end && along(&axes, hull, ahead + 1U) > along(&axes, hull, ahead)) {
            ahead++;
        }
        far = far > ahead ? far : ahead;
        while (far < end && across(&axes, hull, far + 1U) > across(&axes, hull, far)) {
            far++;
        }
        behind = behind > far ? behind : far;
        while (behind < end && along(&axes, hull, behind + 1U) < along(&axes, hull, behind)) {
            behind++;
        }
        const oriented_box box = make_box(&axes, along(&axes, hull, behind), along(&axes, hull, ahead),
                                          greatest(across(&axes, hull, far), 0.0f));
        if (box.length + box.width < best_size) {
            best = box;
            best_size = box.length + box.width;
        }
    }
    return best;
}
