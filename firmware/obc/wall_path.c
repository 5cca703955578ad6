#include "obc/wall_path.h"

#include <math.h>

#include "obc/numeric.h"

enum { ITERATIONS = 4 };

/* Value and derivatives of the polynomial. */
typedef struct wall_point {
    float y;
    float slope;
    float bend; /* second derivative, 1/m */
} wall_point;

static wall_point point_at(const wall_polynomial *wall, float x)
{
    const float *c = wall->coefficient;
    return (wall_point){
        .y = c[0] + x * (c[1] + x * (c[2] + x * c[3])),
        .slope = c[1] + x * (2.0f * c[2] + 3.0f * x * c[3]),
        .bend = 2.0f * c[2] + 6.0f * x * c[3],
    };
}

void wall_path_foot(const wall_polynomial *wall, float x, float y, wall_foot *foot)
{
    float at = x;
    wall_point p = point_at(wall, at);
    for (uint32_t i = 0U; i < ITERATIONS; i++) {
        /* The foot of the perpendicular on the tangent; its error shrinks with the square of distance times bend. */
        at -= ((at - x) + (p.y - y) * p.slope) / (1.0f + p.slope * p.slope);
        p = point_at(wall, at);
    }
    const float square = 1.0f + p.slope * p.slope;
    foot->x = at;
    foot->distance = sqrtf((at - x) * (at - x) + (p.y - y) * (p.y - y));
    foot->side = p.y <= y ? 1.0f : -1.0f;
    foot->curvature = p.bend / (square * sqrtf(square));
}

float wall_path_distance(float distance)
{
    return fmaxf(distance, WALL_PATH_BIAS);
}

wall_target wall_path_target(const wall_polynomial *wall, float side, float distance, float x, float y, float lookahead)
{
    wall_target target = {x, y};
    float at = x + lookahead;
    for (uint32_t i = 0U; i < ITERATIONS; i++) {
        at = numeric_clamp(at, wall->begin, wall->end);
        const wall_point p = point_at(wall, at);
        const float off = side * distance / sqrtf(1.0f + p.slope * p.slope);
        target = (wall_target){at - off * p.slope, p.y + off};
        const float dx = target.x - x;
        const float dy = target.y - y;
        at += lookahead - sqrtf(dx * dx + dy * dy);
    }
    return target;
}
