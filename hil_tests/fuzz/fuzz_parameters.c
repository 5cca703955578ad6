/* parameter_write and parameter_commit -> validator. Input: a byte that picks what comes, then its fields. The first
 * byte of the whole says up to which row the standard values are written in advance, so that commits can succeed. */
#include "hil_tests/fuzz/fuzz_bytes.h"

#include <math.h>

#include "obc/parameters.h"

static void write_standard(parameters *self, uint32_t index)
{
    const parameter_row *row = &parameter_table[index];
    uint32_t raw;
    if (row->type == PARAMETER_FLOAT) {
        memcpy(&raw, &row->standard.real, sizeof raw);
    } else {
        memcpy(&raw, &row->standard.integer, sizeof raw);
    }
    parameters_write(self, row->key, row->type, raw);
}

static void check_active(const parameters *self)
{
    for (uint32_t i = 0; i < PARAMETER_COUNT; i++) {
        const parameter_row *row = &parameter_table[i];
        const float value = parameters_real(self, i);
        FUZZ_CHECK(value >= row->minimum && value <= row->maximum); /* NaN is not */
        FUZZ_CHECK(row->type == PARAMETER_FLOAT || (float)parameters_integer(self, i) == value);
    }
    if (self->verdict == PARAMETER_VERDICT_ACCEPTED) {
        for (uint32_t i = 0; i < PARAMETER_CROSS_CHECK_COUNT; i++) {
            const parameter_cross_check *rule = &parameter_cross_checks[i];
            const float left = parameters_real(self, rule->left);
            const float right = parameters_real(self, rule->right);
            FUZZ_CHECK(rule->rule == PARAMETER_RULE_LESS ? left < right : left * right >= rule->bound);
        }
    }
}

static void step(parameters *self, fuzz_bytes *in)
{
    const uint8_t kind = fuzz_u8(in);
    parameter_result result;
    switch (kind % 5U) {
    case 0U: {
        const uint32_t index = fuzz_u8(in) % PARAMETER_COUNT;
        const uint8_t type = fuzz_u8(in) % 6U;
        parameters_write(self, parameter_table[index].key, type, fuzz_u32(in));
        break;
    }
    case 1U: {
        const uint32_t key = fuzz_u32(in);
        const uint8_t type = fuzz_u8(in);
        parameters_write(self, key, type, fuzz_u32(in));
        break;
    }
    case 2U:
        write_standard(self, fuzz_u8(in) % PARAMETER_COUNT);
        break;
    case 3U:
        FUZZ_CHECK(!parameters_next_result(self, &result) || result.status <= PARAMETER_SCHEMA_MISMATCH);
        break;
    default:
        parameters_commit(self, (kind & 0x80U) != 0U ? fuzz_u16(in) : self->writes,
                          (kind & 0x40U) != 0U ? fuzz_u32(in) : parameter_schema_hash);
        break;
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static parameters self;
    static parameter_value before[PARAMETER_COUNT];
    fuzz_bytes in = {data, size};
    parameters_init(&self);
    const uint32_t first = fuzz_u8(&in);
    for (uint32_t i = 0; i < first && i < PARAMETER_COUNT; i++) {
        write_standard(&self, i);
    }
    while (in.left > 0U) {
        const uint8_t verdict = self.verdict;
        memcpy(before, self.active, sizeof before);
        step(&self, &in);
        FUZZ_CHECK(self.result_count <= PARAMETERS_RESULTS_MAX && self.result_first < PARAMETERS_RESULTS_MAX);
        FUZZ_CHECK(self.verdict == verdict || verdict == PARAMETER_VERDICT_PENDING);
        if (self.verdict == PARAMETER_VERDICT_ACCEPTED && verdict == PARAMETER_VERDICT_PENDING) {
            FUZZ_CHECK(self.rejected == 0U && self.missing == 0U && self.accepted == PARAMETER_COUNT);
        } else {
            FUZZ_CHECK(memcmp(before, self.active, sizeof before) == 0);
        }
    }
    check_active(&self);
    return 0;
}
