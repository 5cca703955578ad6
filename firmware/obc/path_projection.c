#include "obc/path_projection.h"

#include <math.h>

#include "obc/numeric.h"

enum { NEWTON_STEPS = 3 };

static const float segment_min = 1.0e-3f; /* m; points that coincide carry no direction */

/* One segment as r(t) = p + t (v + t (a + t b)), t in 0..1. */
typedef struct hermite {
    float px, py;
    float vx, vy;
    float ax, ay;
    float bx, by;
} hermite;

static void hermite_between(const trajectory_point *from, const trajectory_point *to, hermite *h)
{
    const float length = to->s - from->s;
    const float dx = to->x - from->x;
    const float dy = to->y - from->y;
    const float ux = length * cosf(to->yaw);
    const float uy = length * sinf(to->yaw);
    h->px = from->x;
    h->py = from->y;
    h->vx = length * cosf(from->yaw);
    h->vy = length * sinf(from->yaw);
    h->ax = 3.0f * dx - 2.0f * h->vx - ux;
    h->ay = 3.0f * dy - 2.0f * h->vy - uy;
    h->bx = h->vx + ux - 2.0f * dx;
    h->by = h->vy + uy - 2.0f * dy;
}

/* Everything at parameter t of the segment that starts at point i. */
static void evaluate(const trajectory *plan, uint32_t i, float t, path_point *point)
{
    const trajectory_point *from = &plan->points[i];
    const trajectory_point *to = &plan->points[i + 1u];
    const float length = to->s - from->s;
    const float energy_from = from->speed * from->speed;
    const float energy_to = to->speed * to->speed;
    hermite h;
    hermite_between(from, to, &h);
    point->s = from->s + t * length;
    point->x = h.px + t * (h.vx + t * (h.ax + t * h.bx));
    point->y = h.py + t * (h.vy + t * (h.ay + t * h.by));
    point->curvature = from->curvature + t * (to->curvature - from->curvature);
    point->bank = from->bank + t * (to->bank - from->bank);
    point->speed = sqrtf(energy_from + t * (energy_to - energy_from));
    if (length < segment_min) {
        point->yaw = from->yaw;
        point->acceleration = 0.0f;
        return;
    }
    point->yaw = atan2f(h.vy + t * (2.0f * h.ay + t * 3.0f * h.by), h.vx + t * (2.0f * h.ax + t * 3.0f * h.bx));
    point->acceleration = (energy_to - energy_from) / (2.0f * length);
}

/* The straight extension `along` metres from an end point. */
static void extend(const trajectory *plan, const trajectory_point *end, float along, path_point *point)
{
    const bool stopped = along > 0.0f && plan->ends_in_stop;
    point->s = end->s + along;
    point->x = end->x + along * cosf(end->yaw);
    point->y = end->y + along * sinf(end->yaw);
    point->yaw = end->yaw;
    point->curvature = 0.0f;
    point->bank = end->bank;
    point->speed = stopped ? 0.0f : end->speed;
    point->acceleration = 0.0f;
}

void path_at(const trajectory *plan, float s, path_point *point)
{
    const trajectory_point *last = &plan->points[plan->count - 1u];
    if (!(s >= 0.0f)) {
        extend(plan, &plan->points[0], isfinite(s) ? s : 0.0f, point);
        return;
    }
    if (s >= last->s) {
        extend(plan, last, s - last->s, point);
        return;
    }
    uint32_t i = 0;
    while (i + 2u < plan->count && plan->points[i + 1u].s <= s) {
        i++;
    }
    const float length = plan->points[i + 1u].s - plan->points[i].s;
    evaluate(plan, i, length > 0.0f ? (s - plan->points[i].s) / length : 0.0f, point);
}

static uint32_t nearest_point(const trajectory *plan, float x, float y)
{
    uint32_t nearest = 0;
    float nearest_square = INFINITY;
    for (uint32_t i = 0; i < plan->count; i++) {
        const float dx = x - plan->points[i].x;
        const float dy = y - plan->points[i].y;
        const float square = dx * dx + dy * dy;
        if (square < nearest_square) {
            nearest_square = square;
            nearest = i;
        }
    }
    return nearest;
}

/* Distance along the tangent at a point: its sign tells which of the two segments holds the foot. */
static float ahead_of(const trajectory_point *point, float x, float y)
{
    return (x - point->x) * cosf(point->yaw) + (y - point->y) * sinf(point->yaw);
}

/* Parameter of the foot on segment i: Newton on the product of tangent and distance, from the chord's answer. */
static float foot_parameter(const trajectory *plan, uint32_t i, float x, float y)
{
    hermite h;
    hermite_between(&plan->points[i], &plan->points[i + 1u], &h);
    const float cx = plan->points[i + 1u].x - h.px;
    const float cy = plan->points[i + 1u].y - h.py;
    const float chord_square = cx * cx + cy * cy;
    if (chord_square < segment_min * segment_min) {
        return 0.0f;
    }
    float t = numeric_clamp(((x - h.px) * cx + (y - h.py) * cy) / chord_square, 0.0f, 1.0f);
    for (uint32_t n = 0; n < NEWTON_STEPS; n++) {
        const float ex = h.px + t * (h.vx + t * (h.ax + t * h.bx)) - x;
        const float ey = h.py + t * (h.vy + t * (h.ay + t * h.by)) - y;
        const float tx = h.vx + t * (2.0f * h.ax + t * 3.0f * h.bx);
        const float ty = h.vy + t * (2.0f * h.ay + t * 3.0f * h.by);
        const float nx = 2.0f * h.ax + t * 6.0f * h.bx;
        const float ny = 2.0f * h.ay + t * 6.0f * h.by;
        const float slope = tx * tx + ty * ty + ex * nx + ey * ny;
        if (slope <= 0.0f) {
            break; /* beyond the centre of curvature: the chord's answer stands */
        }
        t = numeric_clamp(t - (ex * tx + ey * ty) / slope, 0.0f, 1.0f);
    }
    return t;
}

void path_project(const trajectory *plan, float x, float y, path_projection *projection)
{
    const uint32_t last = plan->count - 1u;
    const uint32_t near = nearest_point(plan, x, y);
    const float ahead = ahead_of(&plan->points[near], x, y);
    projection->outside = (near == 0u && ahead < 0.0f) || (near == last && ahead > 0.0f);
    if (projection->outside) {
        extend(plan, &plan->points[near], ahead, &projection->foot);
    } else {
        const uint32_t segment = (ahead < 0.0f || near == last) ? near - 1u : near;
        evaluate(plan, segment, foot_parameter(plan, segment, x, y), &projection->foot);
    }
    const path_point *foot = &projection->foot;
    projection->lateral = (y - foot->y) * cosf(foot->yaw) - (x - foot->x) * sinf(foot->yaw);
}
