/* FMI 3.0 for co-simulation, on top of model.h. What every function does is in the standard. The
 * functions that this FMU does not support are in fmi3_unsupported.c. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3_report.h"
#include "plant_token.h"

#define BEGIN(mask)                                                                                                    \
    struct fmi_instance *self = instance;                                                                              \
    if (self == NULL) {                                                                                                \
        return fmi3Error;                                                                                              \
    }                                                                                                                  \
    if (!fmi_allowed(self, __func__, (mask))) {                                                                        \
        return fmi3_report(self, fmi3Error);                                                                           \
    }

#define NOT_NULL(argument)                                                                                             \
    if (!fmi_not_null(self, __func__, #argument, argument)) {                                                          \
        return fmi3_report(self, fmi3Error);                                                                           \
    }

/* All variables are scalars: one value per reference. */
#define SAME_COUNT(references, values)                                                                                 \
    if ((references) != (values)) {                                                                                    \
        fmi_message(self, "%s: %zu values for %zu value references; all variables are scalars.", __func__, (values),   \
                    (references));                                                                                     \
        return fmi3_report(self, fmi3Error);                                                                           \
    }                                                                                                                  \
    if ((references) == 0) {                                                                                           \
        return fmi3OK;                                                                                                 \
    }

static const int mode_get = MODE_INITIALIZATION | MODE_STEP | MODE_TERMINATED;
static const int mode_set = MODE_INSTANTIATED | MODE_INITIALIZATION | MODE_STEP;

fmi3Status fmi3_report(struct fmi_instance *instance, fmi3Status status)
{
    /* A function pointer does not fit into an object pointer: the instance holds its address. */
    const fmi3LogMessageCallback *log = instance->callbacks;
    if (log != NULL && *log != NULL) {
        (*log)(instance->environment, status, status == fmi3Discard ? "logStatusDiscard" : "logStatusError",
               instance->message);
    }
    return status;
}

/* Instance with room for the callback that `callbacks` points to. */
struct fmi3_instance {
    struct fmi_instance base;
    fmi3LogMessageCallback log;
};

const char *fmi3GetVersion(void)
{
    return fmi3Version;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[])
{
    BEGIN(MODE_ANY)
    (void)nCategories;
    (void)categories;
    self->logging = loggingOn ? 1 : 0;
    return fmi3OK;
}

static fmi3Instance refuse(fmi3InstanceEnvironment environment, fmi3LogMessageCallback log, const char *message)
{
    if (log != NULL) {
        log(environment, fmi3Error, "logStatusError", message);
    }
    return NULL;
}

fmi3Instance fmi3InstantiateCoSimulation(fmi3String instanceName, fmi3String instantiationToken,
                                         fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
                                         fmi3Boolean eventModeUsed, fmi3Boolean earlyReturnAllowed,
                                         const fmi3ValueReference requiredIntermediateVariables[],
                                         size_t nRequiredIntermediateVariables,
                                         fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
                                         fmi3IntermediateUpdateCallback intermediateUpdate)
{
    (void)resourcePath;
    (void)visible;
    (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables;
    (void)intermediateUpdate;
    if (instanceName == NULL || instanceName[0] == '\0') {
        return refuse(instanceEnvironment, logMessage, "fmi3InstantiateCoSimulation: instanceName is missing.");
    }
    if (instantiationToken == NULL || strcmp(instantiationToken, PLANT_TOKEN) != 0) {
        return refuse(instanceEnvironment, logMessage,
                      "fmi3InstantiateCoSimulation: wrong instantiationToken, expected " PLANT_TOKEN ".");
    }
    if (eventModeUsed || nRequiredIntermediateVariables > 0) {
        return refuse(instanceEnvironment, logMessage,
                      "fmi3InstantiateCoSimulation: event mode and intermediate variables are not "
                      "supported.");
    }
    struct fmi3_instance *self = calloc(1, sizeof *self);
    if (self == NULL) {
        return refuse(instanceEnvironment, logMessage, "fmi3InstantiateCoSimulation: out of memory.");
    }
    (void)snprintf(self->base.name, sizeof self->base.name, "%s", instanceName);
    self->log = logMessage;
    self->base.callbacks = &self->log;
    self->base.environment = instanceEnvironment;
    self->base.logging = loggingOn ? 1 : 0;
    fmi_instance_reset(&self->base);
    return &self->base;
}

void fmi3FreeInstance(fmi3Instance instance)
{
    free(instance); /* base is the first member, so this is the address calloc gave */
}

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined, fmi3Float64 tolerance,
                                       fmi3Float64 startTime, fmi3Boolean stopTimeDefined, fmi3Float64 stopTime)
{
    BEGIN(MODE_INSTANTIATED)
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    self->start_time = startTime;
    self->mode = MODE_INITIALIZATION;
    self->dirty = 1;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance)
{
    BEGIN(MODE_INITIALIZATION)
    fmi_finish_initialization(self);
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance)
{
    BEGIN(MODE_STEP)
    self->mode = MODE_TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance)
{
    BEGIN(MODE_ANY)
    fmi_instance_reset(self);
    return fmi3OK;
}

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Float64 values[], size_t nValues)
{
    BEGIN(mode_get)
    SAME_COUNT(nValueReferences, nValues)
    NOT_NULL(valueReferences)
    NOT_NULL(values)
    fmi_refresh(self);
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!fmi_readable(self, __func__, valueReferences[i], PLANT_REAL)) {
            return fmi3_report(self, fmi3Error);
        }
        values[i] = plant_get_real(&self->plant, valueReferences[i]);
    }
    return fmi3OK;
}

fmi3Status fmi3GetInt32(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        fmi3Int32 values[], size_t nValues)
{
    BEGIN(mode_get)
    SAME_COUNT(nValueReferences, nValues)
    NOT_NULL(valueReferences)
    NOT_NULL(values)
    fmi_refresh(self);
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!fmi_readable(self, __func__, valueReferences[i], PLANT_INT)) {
            return fmi3_report(self, fmi3Error);
        }
        values[i] = plant_get_int(&self->plant, valueReferences[i]);
    }
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          fmi3Boolean values[], size_t nValues)
{
    BEGIN(mode_get)
    SAME_COUNT(nValueReferences, nValues)
    NOT_NULL(valueReferences)
    NOT_NULL(values)
    fmi_refresh(self);
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!fmi_readable(self, __func__, valueReferences[i], PLANT_BOOL)) {
            return fmi3_report(self, fmi3Error);
        }
        values[i] = plant_get_int(&self->plant, valueReferences[i]) != 0;
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Float64 values[], size_t nValues)
{
    BEGIN(mode_set)
    SAME_COUNT(nValueReferences, nValues)
    NOT_NULL(valueReferences)
    NOT_NULL(values)
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!fmi_writable(self, __func__, valueReferences[i], PLANT_REAL)) {
            return fmi3_report(self, fmi3Error);
        }
        if (!fmi_write_real(self, valueReferences[i], values[i])) {
            return fmi3_report(self, fmi3Discard);
        }
    }
    return fmi3OK;
}

fmi3Status fmi3SetInt32(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                        const fmi3Int32 values[], size_t nValues)
{
    BEGIN(mode_set)
    SAME_COUNT(nValueReferences, nValues)
    NOT_NULL(valueReferences)
    NOT_NULL(values)
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!fmi_writable(self, __func__, valueReferences[i], PLANT_INT)) {
            return fmi3_report(self, fmi3Error);
        }
        if (!fmi_write_int(self, valueReferences[i], values[i])) {
            return fmi3_report(self, fmi3Discard);
        }
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[], size_t nValueReferences,
                          const fmi3Boolean values[], size_t nValues)
{
    BEGIN(mode_set)
    SAME_COUNT(nValueReferences, nValues)
    NOT_NULL(valueReferences)
    NOT_NULL(values)
    for (size_t i = 0; i < nValueReferences; ++i) {
        if (!fmi_writable(self, __func__, valueReferences[i], PLANT_BOOL)) {
            return fmi3_report(self, fmi3Error);
        }
        if (!fmi_write_int(self, valueReferences[i], values[i] ? 1 : 0)) {
            return fmi3_report(self, fmi3Discard);
        }
    }
    return fmi3OK;
}

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUState)
    if (*FMUState == NULL) {
        *FMUState = malloc(sizeof(struct fmi_saved_state));
    }
    if (*FMUState == NULL) {
        fmi_message(self, "%s: out of memory.", __func__);
        return fmi3_report(self, fmi3Error);
    }
    fmi_save(self, *FMUState);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUState)
    return fmi_restore(self, __func__, FMUState) ? fmi3OK : fmi3_report(self, fmi3Error);
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState)
{
    BEGIN(MODE_ANY)
    if (FMUState != NULL) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUState)
    NOT_NULL(size)
    *size = sizeof(struct fmi_saved_state);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState, fmi3Byte serializedState[], size_t size)
{
    BEGIN(MODE_ANY)
    NOT_NULL(FMUState)
    NOT_NULL(serializedState)
    if (size < sizeof(struct fmi_saved_state)) {
        fmi_message(self, "%s: size is %zu but %zu bytes are needed.", __func__, size, sizeof(struct fmi_saved_state));
        return fmi3_report(self, fmi3Error);
    }
    memcpy(serializedState, FMUState, sizeof(struct fmi_saved_state));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[], size_t size,
                                   fmi3FMUState *FMUState)
{
    BEGIN(MODE_ANY)
    NOT_NULL(serializedState)
    NOT_NULL(FMUState)
    if (size != sizeof(struct fmi_saved_state)) {
        fmi_message(self, "%s: size is %zu but a state has %zu bytes.", __func__, size, sizeof(struct fmi_saved_state));
        return fmi3_report(self, fmi3Error);
    }
    if (*FMUState == NULL) {
        *FMUState = malloc(size);
    }
    if (*FMUState == NULL) {
        fmi_message(self, "%s: out of memory.", __func__);
        return fmi3_report(self, fmi3Error);
    }
    memcpy(*FMUState, serializedState, size);
    return fmi3OK;
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint, fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *eventHandlingNeeded,
                      fmi3Boolean *terminateSimulation, fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime)
{
    BEGIN(MODE_STEP)
    (void)noSetFMUStatePriorToCurrentPoint;
    NOT_NULL(eventHandlingNeeded)
    NOT_NULL(terminateSimulation)
    NOT_NULL(earlyReturn)
    NOT_NULL(lastSuccessfulTime)
    *eventHandlingNeeded = fmi3False;
    *terminateSimulation = fmi3False;
    *earlyReturn = fmi3False;
    const bool done = fmi_step(self, __func__, currentCommunicationPoint, communicationStepSize);
    *lastSuccessfulTime = plant_time(&self->plant);
    return done ? fmi3OK : fmi3_report(self, fmi3Error);
}
