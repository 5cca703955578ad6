/* Parameter validator, on the generated table: one call from any sound state. */
#include "obc/parameters.h"
#include "proofs/proof.h"

static bool sound(const parameters *self)
{
    return self->result_first < PARAMETERS_RESULTS_MAX && self->result_count <= PARAMETERS_RESULTS_MAX;
}

/* Whatever is written, an accepted value lies inside its row. */
void proof_check(void)
{
    const uint32_t index = nondet_uint32();
    ASSUME(index < PARAMETER_COUNT);
    const parameter_row *row = &parameter_table[index];
    parameter_value value;
    const uint8_t status = parameters_check(row, nondet_uint8(), nondet_uint32(), &value);
    PROVE(status <= PARAMETER_WRONG_SIGN, "a verdict on a value");
    PROVE(status != PARAMETER_ACCEPTED || (value.real >= row->minimum && value.real <= row->maximum),
          "inside its range");
    PROVE(status != PARAMETER_ACCEPTED || row->type == PARAMETER_FLOAT || value.real == (float)value.integer,
          "integers are exact");
}

/* Any sound state; `active` receives what is in force. */
static parameters any_parameters(parameter_value *active)
{
    parameters self;
    ASSUME(sound(&self));
    for (uint32_t i = 0U; i < PARAMETER_COUNT; i++) {
        self.given[i] = nondet_bool();
        self.valid[i] = nondet_bool();
        self.active[i].integer = nondet_int32();
        active[i] = self.active[i];
    }
    return self;
}

/* The set in force changes only with a good verdict, once. */
void proof_commit(void)
{
    parameter_value active[PARAMETER_COUNT];
    parameters self = any_parameters(active);
    const uint8_t verdict = self.verdict;
    const uint16_t rejected = self.rejected;
    parameters_commit(&self, nondet_uint16(), nondet_uint32());
    const bool decided = verdict == PARAMETER_VERDICT_PENDING;
    const bool accepted = decided && self.verdict == PARAMETER_VERDICT_ACCEPTED;
    PROVE(sound(&self), "the results stay inside their ring");
    PROVE(decided || self.verdict == verdict, "a verdict is final");
    PROVE(!decided || self.verdict != PARAMETER_VERDICT_PENDING, "a commit decides");
    PROVE(!accepted || rejected == 0U, "nothing rejected before");
    for (uint32_t i = 0U; i < PARAMETER_COUNT; i++) {
        PROVE(!accepted || self.given[i], "nothing missing");
        PROVE(accepted || self.active[i].integer == active[i].integer, "else nothing in force changes");
    }
}
