/* FMI 2.0 for co-simulation, on top of model.h. What every function does is in the standard. The
 * functions that this FMU does not support are in fmi2_unsupported.c. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi2_report.h"
#include "plant_token.h"

typedef struct fmi_instance instance_t;

fmi2Status fmi2_report(struct fmi_instance *instance, fmi2Status status)
{
    const fmi2CallbackFunctions *callbacks = instance->callbacks;
    if (callbacks != NULL && callbacks->logger != NULL) {
        callbacks->logger(callbacks->componentEnvironment, instance->name, status,
                          status == fmi2Discard ? "logStatusDiscard" : "logStatusError", "%s", instance->message);
    }
    return status;
}

static const int mode_get = MODE_INITIALIZATION | MODE_STEP | MODE_TERMINATED;
static const int mode_set = MODE_INSTANTIATED | MODE_INITIALIZATION | MODE_STEP;

const char *fmi2GetTypesPlatform(void)
{
    return fmi2TypesPlatform;
}

const char *fmi2GetVersion(void)
{
    return fmi2Version;
}

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[])
{
    BEGIN(MODE_ANY)
    (void)nCategories;
    (void)categories;
    instance->logging = loggingOn != fmi2False ? 1 : 0;
    return fmi2OK;
}

static fmi2Component refuse(const fmi2CallbackFunctions *functions, const char *name, const char *message)
{
    if (functions != NULL && functions->logger != NULL) {
        functions->logger(functions->componentEnvironment, name != NULL ? name : "", fmi2Error, "logStatusError",
                          "fmi2Instantiate: %s", message);
    }
    return NULL;
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation, const fmi2CallbackFunctions *functions,
                              fmi2Boolean visible, fmi2Boolean loggingOn)
{
    (void)fmuResourceLocation;
    (void)visible;
    if (instanceName == NULL || instanceName[0] == '\0') {
        return refuse(functions, instanceName, "instanceName is missing.");
    }
    if (fmuType != fmi2CoSimulation) {
        return refuse(functions, instanceName, "only co-simulation is supported.");
    }
    if (fmuGUID == NULL || strcmp(fmuGUID, PLANT_TOKEN) != 0) {
        return refuse(functions, instanceName, "wrong GUID, expected " PLANT_TOKEN ".");
    }
    instance_t *instance = calloc(1, sizeof *instance);
    if (instance == NULL) {
        return refuse(functions, instanceName, "out of memory.");
    }
    (void)snprintf(instance->name, sizeof instance->name, "%s", instanceName);
    instance->callbacks = functions;
    instance->logging = loggingOn != fmi2False ? 1 : 0;
    fmi_instance_reset(instance);
    return instance;
}

void fmi2FreeInstance(fmi2Component c)
{
    free(c);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance, fmi2Real startTime,
                               fmi2Boolean stopTimeDefined, fmi2Real stopTime)
{
    BEGIN(MODE_INSTANTIATED)
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    instance->start_time = startTime;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c)
{
    BEGIN(MODE_INSTANTIATED)
    instance->mode = MODE_INITIALIZATION;
    instance->dirty = 1;
    return fmi2OK;
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c)
{
    BEGIN(MODE_INITIALIZATION)
    fmi_finish_initialization(instance);
    return fmi2OK;
}

fmi2Status fmi2Terminate(fmi2Component c)
{
    BEGIN(MODE_STEP)
    instance->mode = MODE_TERMINATED;
    return fmi2OK;
}

fmi2Status fmi2Reset(fmi2Component c)
{
    BEGIN(MODE_ANY)
    fmi_instance_reset(instance);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Real value[])
{
    BEGIN(mode_get)
    if (nvr == 0) {
        return fmi2OK;
    }
    NOT_NULL(vr)
    NOT_NULL(value)
    fmi_refresh(instance);
    for (size_t i = 0; i < nvr; ++i) {
        if (!fmi_readable(instance, __func__, vr[i], PLANT_REAL)) {
            return fmi2_report(instance, fmi2Error);
        }
        value[i] = plant_get_real(&instance->plant, vr[i]);
    }
    return fmi2OK;
}

static fmi2Status get_ints(instance_t *instance, const char *function, enum plant_type type,
                           const fmi2ValueReference vr[], size_t nvr, int value[])
{
    fmi_refresh(instance);
    for (size_t i = 0; i < nvr; ++i) {
        if (!fmi_readable(instance, function, vr[i], type)) {
            return fmi2_report(instance, fmi2Error);
        }
        value[i] = plant_get_int(&instance->plant, vr[i]);
    }
    return fmi2OK;
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Integer value[])
{
    BEGIN(mode_get)
    if (nvr == 0) {
        return fmi2OK;
    }
    NOT_NULL(vr)
    NOT_NULL(value)
    return get_ints(instance, __func__, PLANT_INT, vr, nvr, value);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2Boolean value[])
{
    BEGIN(mode_get)
    if (nvr == 0) {
        return fmi2OK;
    }
    NOT_NULL(vr)
    NOT_NULL(value)
    return get_ints(instance, __func__, PLANT_BOOL, vr, nvr, value);
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, fmi2String value[])
{
    BEGIN(mode_get)
    (void)vr;
    (void)value;
    if (nvr == 0) {
        return fmi2OK;
    }
    UNSUPPORTED("string variables");
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Real value[])
{
    BEGIN(mode_set)
    if (nvr == 0) {
        return fmi2OK;
    }
    NOT_NULL(vr)
    NOT_NULL(value)
    for (size_t i = 0; i < nvr; ++i) {
        if (!fmi_writable(instance, __func__, vr[i], PLANT_REAL)) {
            return fmi2_report(instance, fmi2Error);
        }
        if (!fmi_write_real(instance, vr[i], value[i])) {
            return fmi2_report(instance, fmi2Discard);
        }
    }
    return fmi2OK;
}

static fmi2Status set_ints(instance_t *instance, const char *function, enum plant_type type,
                           const fmi2ValueReference vr[], size_t nvr, const int value[])
{
    for (size_t i = 0; i < nvr; ++i) {
        if (!fmi_writable(instance, function, vr[i], type)) {
            return fmi2_report(instance, fmi2Error);
        }
        if (!fmi_write_int(instance, vr[i], value[i])) {
            return fmi2_report(instance, fmi2Discard);
        }
    }
    return fmi2OK;
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Integer value[])
{
    BEGIN(mode_set)
    if (nvr == 0) {
        return fmi2OK;
    }
    NOT_NULL(vr)
    NOT_NULL(value)
    return set_ints(instance, __func__, PLANT_INT, vr, nvr, value);
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2Boolean value[])
{
    BEGIN(mode_set)
    if (nvr == 0) {
        return fmi2OK;
    }
    NOT_NULL(vr)
    NOT_NULL(value)
    return set_ints(instance, __func__, PLANT_BOOL, vr, nvr, value);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr, const fmi2String value[])
{
    BEGIN(mode_set)
    (void)vr;
    (void)value;
    if (nvr == 0) {
        return fmi2OK;
    }
    UNSUPPORTED("string variables");
}

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUstate)
    if (*FMUstate == NULL) {
        *FMUstate = malloc(sizeof(struct fmi_saved_state));
    }
    if (*FMUstate == NULL) {
        fmi_message(instance, "%s: out of memory.", __func__);
        return fmi2_report(instance, fmi2Error);
    }
    fmi_save(instance, *FMUstate);
    return fmi2OK;
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUstate)
    return fmi_restore(instance, __func__, FMUstate) ? fmi2OK : fmi2_report(instance, fmi2Error);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate)
{
    BEGIN(MODE_ANY)
    if (FMUstate != NULL) {
        free(*FMUstate);
        *FMUstate = NULL;
    }
    return fmi2OK;
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUstate)
    NOT_NULL(size)
    *size = sizeof(struct fmi_saved_state);
    return fmi2OK;
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[], size_t size)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUstate)
    NOT_NULL(serializedState)
    if (size < sizeof(struct fmi_saved_state)) {
        fmi_message(instance, "%s: size is %zu but %zu bytes are needed.", __func__, size,
                    sizeof(struct fmi_saved_state));
        return fmi2_report(instance, fmi2Error);
    }
    memcpy(serializedState, FMUstate, sizeof(struct fmi_saved_state));
    return fmi2OK;
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate)
{
    BEGIN(MODE_ANY)
    NOT_NULL(serializedState)
    NOT_NULL(FMUstate)
    if (size != sizeof(struct fmi_saved_state)) {
        fmi_message(instance, "%s: size is %zu but a state has %zu bytes.", __func__, size,
                    sizeof(struct fmi_saved_state));
        return fmi2_report(instance, fmi2Error);
    }
    if (*FMUstate == NULL) {
        *FMUstate = malloc(size);
    }
    if (*FMUstate == NULL) {
        fmi_message(instance, "%s: out of memory.", __func__);
        return fmi2_report(instance, fmi2Error);
    }
    memcpy(*FMUstate, serializedState, size);
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint, fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint)
{
    BEGIN(MODE_STEP)
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!fmi_step(instance, __func__, currentCommunicationPoint, communicationStepSize)) {
        return fmi2_report(instance, fmi2Error);
    }
    return fmi2OK;
}
