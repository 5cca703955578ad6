#include "fmi_support.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "plant_token.h"

#define SAVED_STATE_MAGIC UINT64_C(0x524C504C414E5431) /* "RLPLANT1" */

/* Times come as multiples of decimal fractions: this much rounding is forgiven. */
static const double time_tolerance = 1e-6;
static const double step_tolerance = 1e-6; /* of one inner step */
static const double max_inner_steps = 1e9;

static const char *const type_names[] = {"real", "integer", "boolean"};

void fmi_message(struct fmi_instance *instance, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(instance->message, sizeof instance->message, format, arguments);
    va_end(arguments);
}

void fmi_instance_reset(struct fmi_instance *instance)
{
    plant_reset(&instance->plant);
    instance->mode = MODE_INSTANTIATED;
    instance->dirty = 1;
    instance->start_time = 0.0;
}

static const char *mode_name(int mode)
{
    switch (mode) {
    case MODE_INSTANTIATED:
        return "instantiated";
    case MODE_INITIALIZATION:
        return "initialization mode";
    case MODE_STEP:
        return "step mode";
    default:
        return "terminated";
    }
}

bool fmi_allowed(struct fmi_instance *instance, const char *function, int mask)
{
    if ((instance->mode & mask) != 0) {
        return true;
    }
    fmi_message(instance, "%s: not allowed while the instance is in state \"%s\".", function,
                mode_name(instance->mode));
    return false;
}

bool fmi_not_null(struct fmi_instance *instance, const char *function, const char *argument, const void *pointer)
{
    if (pointer != NULL) {
        return true;
    }
    fmi_message(instance, "%s: argument %s must not be NULL.", function, argument);
    return false;
}

bool fmi_readable(struct fmi_instance *instance, const char *function, uint32_t vr, enum plant_type type)
{
    if (vr >= PLANT_VARIABLE_COUNT) {
        fmi_message(instance, "%s: value reference %u does not exist; the last one is %u.", function, (unsigned)vr,
                    (unsigned)PLANT_VARIABLE_COUNT - 1U);
        return false;
    }
    if (plant_variables[vr].type != type) {
        fmi_message(instance, "%s: %s (value reference %u) is %s, not %s.", function, plant_variables[vr].name,
                    (unsigned)vr, type_names[plant_variables[vr].type], type_names[type]);
        return false;
    }
    return true;
}

bool fmi_writable(struct fmi_instance *instance, const char *function, uint32_t vr, enum plant_type type)
{
    if (!fmi_readable(instance, function, vr, type)) {
        return false;
    }
    const struct plant_variable *info = &plant_variables[vr];
    if (info->causality != PLANT_INPUT && info->causality != PLANT_PARAMETER) {
        fmi_message(instance, "%s: %s is an output and cannot be set.", function, info->name);
        return false;
    }
    if (info->variability == PLANT_FIXED && instance->mode == MODE_STEP) {
        fmi_message(instance, "%s: %s is a fixed parameter; set it before initialization ends.", function, info->name);
        return false;
    }
    return true;
}

static bool write_result(struct fmi_instance *instance, uint32_t vr, double value, enum plant_set_result result)
{
    const struct plant_variable *info = &plant_variables[vr];
    instance->dirty = 1;
    switch (result) {
    case PLANT_SET_OK:
        return true;
    case PLANT_SET_NOT_FINITE:
        fmi_message(instance, "%s = %g is refused: the value must be finite.", info->name, value);
        return false;
    case PLANT_SET_OUT_OF_RANGE:
    default:
        fmi_message(instance, "%s = %g is refused: allowed is %g to %g.", info->name, value, info->min, info->max);
        return false;
    }
}

bool fmi_write_real(struct fmi_instance *instance, uint32_t vr, double value)
{
    return write_result(instance, vr, value, plant_set_real(&instance->plant, vr, value));
}

bool fmi_write_int(struct fmi_instance *instance, uint32_t vr, int32_t value)
{
    return write_result(instance, vr, (double)value, plant_set_int(&instance->plant, vr, value));
}

void fmi_refresh(struct fmi_instance *instance)
{
    if (instance->mode == MODE_INITIALIZATION && instance->dirty != 0) {
        plant_start(&instance->plant, instance->start_time);
        instance->dirty = 0;
    }
}

void fmi_finish_initialization(struct fmi_instance *instance)
{
    plant_start(&instance->plant, instance->start_time);
    instance->dirty = 0;
    instance->mode = MODE_STEP;
}

bool fmi_step(struct fmi_instance *instance, const char *function, double time, double step)
{
    const double now = plant_time(&instance->plant);
    if (!(fabs(time - now) <= time_tolerance)) {
        fmi_message(instance, "%s: communication point is %.9g s but the instance is at %.9g s.", function, time, now);
        return false;
    }
    const double count = step / PLANT_INNER_STEP_S;
    if (!(count >= 1.0 - step_tolerance && count <= max_inner_steps) ||
        fabs(count - nearbyint(count)) > step_tolerance * fmax(1.0, count)) {
        fmi_message(instance, "%s: step size %.9g s is not a positive multiple of %g s.", function, step,
                    PLANT_INNER_STEP_S);
        return false;
    }
    plant_advance(&instance->plant, (int64_t)nearbyint(count));
    return true;
}

void fmi_save(const struct fmi_instance *instance, struct fmi_saved_state *saved)
{
    memset(saved, 0, sizeof *saved);
    saved->magic = SAVED_STATE_MAGIC;
    saved->size = sizeof *saved;
    memcpy(saved->token, PLANT_TOKEN, sizeof PLANT_TOKEN);
    saved->start_time = instance->start_time;
    saved->mode = instance->mode;
    saved->dirty = instance->dirty;
    memcpy(&saved->plant, &instance->plant, sizeof saved->plant);
}

bool fmi_restore(struct fmi_instance *instance, const char *function, const struct fmi_saved_state *saved)
{
    if (saved->magic != SAVED_STATE_MAGIC || saved->size != sizeof *saved) {
        fmi_message(instance, "%s: these bytes are not a state of this FMU.", function);
        return false;
    }
    if (memcmp(saved->token, PLANT_TOKEN, sizeof PLANT_TOKEN) != 0) {
        fmi_message(instance, "%s: the state comes from another build of this FMU.", function);
        return false;
    }
    instance->start_time = saved->start_time;
    instance->mode = saved->mode;
    instance->dirty = saved->dirty;
    memcpy(&instance->plant, &saved->plant, sizeof instance->plant);
    return true;
}
