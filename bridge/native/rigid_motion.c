#include "bridge/native/rigid_motion.h"

#include <math.h>

/* Below this angle, rad, the series is exact to the last digit, and the closed form is not. */
#define SERIES_ANGLE 0.1

/* Coefficients of Rodrigues' formula and of the exponential's translation: sin a / a, (1 - cos a) / a^2,
 * (a - sin a) / a^3. */
typedef struct coefficients {
    double first;
    double second;
    double third;
} coefficients;

static coefficients coefficients_of(double square)
{
    coefficients result;
    if (square < SERIES_ANGLE * SERIES_ANGLE) {
        result.first = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)));
        result.second = 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0)));
        result.third = 1.0 / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)));
    } else {
        const double angle = sqrt(square);
        result.first = sin(angle) / angle;
        result.second = (1.0 - cos(angle)) / square;
        result.third = (1.0 - result.first) / square;
    }
    return result;
}

/* I + a [w] + b [w]^2, by rows. */
static void polynomial(const double w[3], double a, double b, double matrix[9])
{
    const double xx = w[0] * w[0];
    const double yy = w[1] * w[1];
    const double zz = w[2] * w[2];
    matrix[0] = 1.0 - b * (yy + zz);
    matrix[1] = b * w[0] * w[1] - a * w[2];
    matrix[2] = b * w[0] * w[2] + a * w[1];
    matrix[3] = b * w[0] * w[1] + a * w[2];
    matrix[4] = 1.0 - b * (xx + zz);
    matrix[5] = b * w[1] * w[2] - a * w[0];
    matrix[6] = b * w[0] * w[2] - a * w[1];
    matrix[7] = b * w[1] * w[2] + a * w[0];
    matrix[8] = 1.0 - b * (xx + yy);
}

rigid_pose rigid_motion_at(const rigid_motion *motion, double time)
{
    const double turn[3] = {motion->rate[0] * time, motion->rate[1] * time, motion->rate[2] * time};
    const coefficients by = coefficients_of(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2]);
    double mean[9]; /* of the rotation, over the time */
    polynomial(turn, by.second, by.third, mean);
    rigid_pose step;
    polynomial(turn, by.first, by.second, step.axes);
    for (unsigned i = 0U; i < 3U; i++) {
        step.place[i] = time * (mean[3U * i] * motion->velocity[0] + mean[3U * i + 1U] * motion->velocity[1] +
                                mean[3U * i + 2U] * motion->velocity[2]);
    }
    return rigid_pose_out(&motion->pose, &step);
}

rigid_pose rigid_pose_out(const rigid_pose *pose, const rigid_pose *inside)
{
    rigid_pose result;
    for (unsigned i = 0U; i < 3U; i++) {
        const double *row = &pose->axes[3U * i];
        result.place[i] =
            pose->place[i] + row[0] * inside->place[0] + row[1] * inside->place[1] + row[2] * inside->place[2];
        for (unsigned j = 0U; j < 3U; j++) {
            result.axes[3U * i + j] =
                row[0] * inside->axes[j] + row[1] * inside->axes[3U + j] + row[2] * inside->axes[6U + j];
        }
    }
    return result;
}

rigid_pose rigid_pose_in(const rigid_pose *pose, const rigid_pose *outside)
{
    const double away[3] = {outside->place[0] - pose->place[0], outside->place[1] - pose->place[1],
                            outside->place[2] - pose->place[2]};
    rigid_pose result;
    for (unsigned i = 0U; i < 3U; i++) {
        const double column[3] = {pose->axes[i], pose->axes[3U + i], pose->axes[6U + i]};
        result.place[i] = column[0] * away[0] + column[1] * away[1] + column[2] * away[2];
        for (unsigned j = 0U; j < 3U; j++) {
            result.axes[3U * i + j] =
                column[0] * outside->axes[j] + column[1] * outside->axes[3U + j] + column[2] * outside->axes[6U + j];
        }
    }
    return result;
}
