/* The bicycle model that feed-forward and prediction share. ISO 8855 axes; bank positive with the left side low. */
#ifndef RACELOOP_OBC_VEHICLE_MODEL_H
#define RACELOOP_OBC_VEHICLE_MODEL_H

/* Steady cornering at one place of a path. */
typedef struct vehicle_cornering {
    float steer;           /* rad, road wheel angle that holds the curvature */
    float sideslip;        /* rad, vy / vx at the centre of gravity */
    float yaw_rate;        /* rad/s about the road's normal */
    float slip_front;      /* rad, slip angle of the front axle, positive with force to the left */
    float slip_rear;       /* rad */
    float stiffness_front; /* N/rad of the axle under its load */
    float stiffness_rear;  /* N/rad */
    float yaw_moment;      /* N m of the differential, to the left positive */
    float load_rear;       /* N, normal load of the driven axle */
    float load;            /* N, of both axles */
    float drag;            /* N, resistance from the slip of the tyres */
} vehicle_cornering;

/* Lateral motion of the car. */
typedef struct vehicle_motion {
    float x;        /* m */
    float y;        /* m */
    float yaw;      /* rad */
    float vy;       /* m/s */
    float yaw_rate; /* rad/s */
} vehicle_motion;

/* Steady cornering at a speed (m/s, >= 0), curvature (1/m, left positive) and bank (rad, |bank| < 1). Tyre stiffness
 * follows the axle's load: weight, downforce, and what presses the car into the banking. */
void vehicle_steady_cornering(float speed, float curvature, float bank, vehicle_cornering *out);

/* Advance the motion by dt (s) at constant speed (m/s, >= 0) with the road wheels at steer (rad).
 * Implicit, so it passes smoothly into rolling without slip as speed goes to zero.
 * tyres: stiffness and yaw moment in force. bank: rad. */
void vehicle_motion_step(vehicle_motion *motion, const vehicle_cornering *tyres, float speed, float bank, float steer,
                         float dt);

#endif
