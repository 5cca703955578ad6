#include "autonomy/native/motion_compensation.h"

#include <math.h>

/* Frame of some time ago, as seen from the frame of now. */
typedef struct planar_shift {
    float x;
    float y;
    float cos;
    float sin;
} planar_shift;

/* The exponential of a twist: a turn by an angle, and a chord in the direction of half of it, as long as the way times
 * sin(half) / half (Murray, Li, Sastry, A Mathematical Introduction to Robotic Manipulation, 1994, 2.3). */
static planar_shift shift_of(const planar_twist *twist, double age)
{
    const double turn = -twist->yaw_rate * age;
    const double half = 0.5 * turn;
    const double chord = -age * (fabs(half) > 1.0e-9 ? sin(half) / half : 1.0);
    return (planar_shift){
        .x = (float)(chord * (twist->vx * cos(half) - twist->vy * sin(half))),
        .y = (float)(chord * (twist->vx * sin(half) + twist->vy * cos(half))),
        .cos = (float)cos(turn),
        .sin = (float)sin(turn),
    };
}

bool motion_compensate(const aged_point *points, uint32_t count, const planar_twist *twist, cloud_point *moved)
{
    bool finite = true;
    float age = 0.0F;
    planar_shift shift = shift_of(twist, 0.0);
    for (uint32_t i = 0U; i < count; i++) {
        const aged_point *point = &points[i];
        if (!(point->age == age)) {
            const bool known = isfinite(point->age);
            finite = finite && known;
            age = known ? point->age : 0.0F;
            shift = shift_of(twist, (double)age);
        }
        moved[i] = (cloud_point){
            .x = shift.x + shift.cos * point->x - shift.sin * point->y,
            .y = shift.y + shift.sin * point->x + shift.cos * point->y,
            .z = point->z,
        };
    }
    return finite;
}
