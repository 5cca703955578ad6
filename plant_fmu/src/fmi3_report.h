/* Shared by the two FMI 3.0 files. */
#ifndef RACELOOP_PLANT_FMI3_REPORT_H
#define RACELOOP_PLANT_FMI3_REPORT_H

#include "fmi3Functions.h"

#include "fmi_support.h"

/** Send the instance's message to the importer's log and return `status`. */
fmi3Status fmi3_report(struct fmi_instance *instance, fmi3Status status);

#endif
