#include "variables.h"

#include <float.h>

#define NO_MIN (-DBL_MAX)
#define NO_MAX DBL_MAX

const struct plant_variable plant_variables[PLANT_VARIABLE_COUNT] = {
#define VAR(type_, name_, causality_, variability_, unit_, start_, min_, max_, description, source)                    \
    [PLANT_VR_##name_] = {.name = #name_,                                                                              \
                          .unit = unit_,                                                                               \
                          .offset = offsetof(struct plant_vars, name_),                                                \
                          .start = start_,                                                                             \
                          .min = min_,                                                                                 \
                          .max = max_,                                                                                 \
                          .type = PLANT_##type_,                                                                       \
                          .causality = PLANT_##causality_,                                                             \
                          .variability = PLANT_##variability_},
#include "variables.def"
#undef VAR
};
