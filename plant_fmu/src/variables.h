/* Storage, value references and table of all variables, unfolded from variables.def. */
#ifndef RACELOOP_PLANT_VARIABLES_H
#define RACELOOP_PLANT_VARIABLES_H

#include <stddef.h>
#include <stdint.h>

/** Inner integration step, s. 1 ms keeps the stiffest mode (a wheel on its tyre, about 700 rad/s
 * under full downforce) inside the stability limit of the semi-implicit Euler rule. */
#define PLANT_INNER_STEP_S 0.001

/** Number of wheels and their order in every array. */
enum wheel { FL = 0, FR, RL, RR, WHEELS };

/** Types. BOOL is stored as 0 or 1 in an int, so that restored bytes are always valid. */
enum plant_type { PLANT_REAL, PLANT_INT, PLANT_BOOL };
enum plant_causality { PLANT_INDEPENDENT, PLANT_PARAMETER, PLANT_INPUT, PLANT_OUTPUT };
enum plant_variability { PLANT_FIXED, PLANT_TUNABLE, PLANT_DISCRETE, PLANT_CONTINUOUS };

/** Value references: PLANT_VR_<name>. */
enum plant_vr {
#define VAR(type, name, ...) PLANT_VR_##name,
#include "variables.def"
#undef VAR
    PLANT_VARIABLE_COUNT
};

#define PLANT_STORAGE_REAL double
#define PLANT_STORAGE_INT  int32_t
#define PLANT_STORAGE_BOOL int32_t

/** All variables by name, SI units. */
struct plant_vars {
#define VAR(type, name, ...) PLANT_STORAGE_##type name;
#include "variables.def"
#undef VAR
};

/** What is known of one variable. */
struct plant_variable {
    const char *name;
    const char *unit;
    size_t offset; /**< in struct plant_vars */
    double start;
    double min;
    double max;
    enum plant_type type;
    enum plant_causality causality;
    enum plant_variability variability;
};

extern const struct plant_variable plant_variables[PLANT_VARIABLE_COUNT];

#endif
