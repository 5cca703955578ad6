/* Shared by the two FMI 2.0 files. */
#ifndef RACELOOP_PLANT_FMI2_REPORT_H
#define RACELOOP_PLANT_FMI2_REPORT_H

#include "fmi2Functions.h"

#include "fmi_support.h"

/** Send the instance's message to the importer's log and return `status`. */
fmi2Status fmi2_report(struct fmi_instance *instance, fmi2Status status);

/* Enter a function: null component, mode. */
#define BEGIN(mask)                                                                                                    \
    struct fmi_instance *instance = c;                                                                                 \
    if (instance == NULL) {                                                                                            \
        return fmi2Error;                                                                                              \
    }                                                                                                                  \
    if (!fmi_allowed(instance, __func__, (mask))) {                                                                    \
        return fmi2_report(instance, fmi2Error);                                                                       \
    }

#define NOT_NULL(argument)                                                                                             \
    if (!fmi_not_null(instance, __func__, #argument, argument)) {                                                      \
        return fmi2_report(instance, fmi2Error);                                                                       \
    }

#define UNSUPPORTED(what)                                                                                              \
    do {                                                                                                               \
        fmi_message(instance, "%s: this FMU has no %s.", __func__, what);                                              \
        return fmi2_report(instance, fmi2Error);                                                                       \
    } while (0)

#endif
