#include "obc/parameters.h"

#include <math.h>
#include <string.h>

/* Add one without wrapping: a flooding sender must not make a bad configuration look whole. */
static void count_up(uint16_t *counter)
{
    if (*counter < UINT16_MAX) {
        (*counter)++;
    }
}

static void report(parameters *self, uint32_t key, uint8_t status, uint32_t value)
{
    if (self->result_count >= PARAMETERS_RESULTS_MAX) {
        count_up(&self->results_lost);
        return;
    }
    const uint32_t slot = ((uint32_t)self->result_first + self->result_count) % PARAMETERS_RESULTS_MAX;
    self->results[slot] = (parameter_result){.key = key, .value = value, .status = status};
    self->result_count++;
}

static void reject(parameters *self, uint32_t key, uint8_t status, uint32_t value)
{
    count_up(&self->rejected);
    report(self, key, status, value);
}

/* Index of a key, or PARAMETER_COUNT. */
static uint32_t find(uint32_t key)
{
    uint32_t index = 0U;
    while (index < PARAMETER_COUNT && parameter_table[index].key != key) {
        index++;
    }
    return index;
}

void parameters_init(parameters *self)
{
    memset(self, 0, sizeof *self);
    for (uint32_t i = 0U; i < PARAMETER_COUNT; i++) {
        self->active[i] = parameter_table[i].standard;
    }
}

/* Turn the wire's bits into a number. Returns false when the type does not fit; an INT may stand for a FLOAT, since
 * what it loses by rounding lies beyond every allowed maximum. */
static bool convert(uint8_t wanted, uint8_t type, uint32_t raw, parameter_value *value)
{
    value->integer = 0;
    if (type == PARAMETER_FLOAT && wanted == PARAMETER_FLOAT) {
        memcpy(&value->real, &raw, sizeof raw);
        return true;
    }
    int32_t number;
    memcpy(&number, &raw, sizeof raw);
    value->real = (float)number;
    if (type == PARAMETER_INT && wanted == PARAMETER_FLOAT) {
        return true;
    }
    value->integer = number;
    return type == wanted;
}

uint8_t parameters_check(const parameter_row *row, uint8_t type, uint32_t raw, parameter_value *value)
{
    if (!convert(row->type, type, raw, value)) {
        return PARAMETER_WRONG_TYPE;
    }
    if (!isfinite(value->real)) {
        return PARAMETER_NOT_FINITE;
    }
    if (value->real * (float)row->sign < 0.0f) {
        return PARAMETER_WRONG_SIGN;
    }
    if (value->real < row->minimum) {
        return PARAMETER_BELOW_MINIMUM;
    }
    if (value->real > row->maximum) {
        return PARAMETER_ABOVE_MAXIMUM;
    }
    return PARAMETER_ACCEPTED;
}

void parameters_write(parameters *self, uint32_t key, uint8_t type, uint32_t raw)
{
    if (self->verdict != PARAMETER_VERDICT_PENDING) {
        count_up(&self->late);
        report(self, key, PARAMETER_LATE, raw);
        return;
    }
    count_up(&self->writes);
    const uint32_t index = find(key);
    if (index == PARAMETER_COUNT) {
        reject(self, key, PARAMETER_UNKNOWN_KEY, raw);
        return;
    }
    if (self->given[index]) {
        reject(self, key, PARAMETER_DUPLICATE, raw);
        return;
    }
    self->given[index] = true;
    const uint8_t status = parameters_check(&parameter_table[index], type, raw, &self->staged[index]);
    if (status != PARAMETER_ACCEPTED) {
        reject(self, key, status, raw);
        return;
    }
    self->valid[index] = true;
    count_up(&self->accepted);
    report(self, key, PARAMETER_ACCEPTED, raw);
}

static bool rule_holds(const parameters *self, const parameter_cross_check *check)
{
    if (!self->valid[check->left] || !self->valid[check->right]) {
        return true; /* reported already, and a rule about a wrong value says nothing more */
    }
    const float left = self->staged[check->left].real;
    const float right = self->staged[check->right].real;
    return check->rule == PARAMETER_RULE_LESS ? left < right : left * right >= check->bound;
}

void parameters_commit(parameters *self, uint16_t count, uint32_t schema)
{
    if (self->verdict != PARAMETER_VERDICT_PENDING) {
        count_up(&self->late);
        report(self, 0U, PARAMETER_LATE, count);
        return;
    }
    if (count != self->writes) {
        reject(self, 0U, PARAMETER_COUNT_MISMATCH, self->writes);
    }
    if (schema != parameter_schema_hash) {
        reject(self, 0U, PARAMETER_SCHEMA_MISMATCH, parameter_schema_hash);
    }
    for (uint32_t i = 0U; i < PARAMETER_COUNT; i++) {
        if (!self->given[i]) {
            count_up(&self->missing);
            report(self, parameter_table[i].key, PARAMETER_MISSING, 0U);
        }
    }
    for (uint32_t i = 0U; i < PARAMETER_CROSS_CHECK_COUNT; i++) {
        const parameter_cross_check *check = &parameter_cross_checks[i];
        if (!rule_holds(self, check)) {
            reject(self, parameter_table[check->left].key, PARAMETER_CROSS_CHECK, i);
        }
    }
    if (self->rejected == 0U && self->missing == 0U) {
        memcpy(self->active, self->staged, sizeof self->active);
        self->verdict = PARAMETER_VERDICT_ACCEPTED;
    } else {
        self->verdict = PARAMETER_VERDICT_REJECTED;
    }
}

bool parameters_next_result(parameters *self, parameter_result *result)
{
    if (self->result_count == 0U) {
        return false;
    }
    *result = self->results[self->result_first];
    self->result_first = (uint16_t)((self->result_first + 1U) % PARAMETERS_RESULTS_MAX);
    self->result_count--;
    return true;
}

float parameters_real(const parameters *self, uint32_t index)
{
    return self->active[index].real;
}

int32_t parameters_integer(const parameters *self, uint32_t index)
{
    return self->active[index].integer;
}
