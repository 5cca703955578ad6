/* FMI 2.0 functions that every FMU must export but this one has no use for: derivatives and
 * asynchronous steps. */
#include "fmi2_report.h"

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[], size_t nUnknown,
                                        const fmi2ValueReference vKnown_ref[], size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[])
{
    BEGIN(MODE_ANY)
    (void)vUnknown_ref;
    (void)nUnknown;
    (void)vKnown_ref;
    (void)nKnown;
    (void)dvKnown;
    (void)dvUnknown;
    UNSUPPORTED("directional derivatives");
}

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[])
{
    BEGIN(MODE_ANY)
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    UNSUPPORTED("input derivatives");
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[])
{
    BEGIN(MODE_ANY)
    (void)vr;
    (void)nvr;
    (void)order;
    (void)value;
    UNSUPPORTED("output derivatives");
}

fmi2Status fmi2CancelStep(fmi2Component c)
{
    BEGIN(MODE_ANY)
    UNSUPPORTED("asynchronous steps");
}

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value)
{
    BEGIN(MODE_ANY)
    (void)s;
    (void)value;
    UNSUPPORTED("asynchronous steps");
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value)
{
    BEGIN(MODE_ANY)
    NOT_NULL(value)
    if (s == fmi2LastSuccessfulTime) {
        *value = plant_time(&instance->plant);
        return fmi2OK;
    }
    UNSUPPORTED("such real status");
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value)
{
    BEGIN(MODE_ANY)
    (void)s;
    (void)value;
    UNSUPPORTED("integer status");
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value)
{
    BEGIN(MODE_ANY)
    NOT_NULL(value)
    if (s == fmi2Terminated) {
        *value = fmi2False;
        return fmi2OK;
    }
    UNSUPPORTED("such boolean status");
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value)
{
    BEGIN(MODE_ANY)
    (void)s;
    (void)value;
    UNSUPPORTED("string status");
}
