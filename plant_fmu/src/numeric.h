/* Small helpers shared by the model files. */
#ifndef RACELOOP_PLANT_NUMERIC_H
#define RACELOOP_PLANT_NUMERIC_H

#define PLANT_PI 3.14159265358979323846

/** Limit `value` to [low, high]. Precondition: low <= high. */
static inline double clamp(double value, double low, double high)
{
    return value < low ? low : (value > high ? high : value);
}

/** New value of a first-order lag after one step `dt`; stable for any dt and time_constant > 0. */
static inline double lag_step(double value, double target, double time_constant, double dt)
{
    return value + (target - value) * dt / (time_constant + dt);
}

#endif
