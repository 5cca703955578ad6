#include "bridge/native/text_cursor.h"

enum {
    WHOLE_DIGITS_MAX = 12, /* with six decimals within 64 bits */
    FRACTION_DIGITS_MAX = 9,
};

bool text_take(text_cursor *self, char wanted)
{
    if (self->at == self->end || *self->at != wanted) {
        return false;
    }
    self->at++;
    return true;
}

uint32_t text_take_blanks(text_cursor *self)
{
    uint32_t count = 0U;
    while (text_take(self, ' ') || text_take(self, '\t')) {
        count++;
    }
    return count;
}

uint32_t text_take_decimal(text_cursor *self, uint32_t limit, uint64_t *value)
{
    uint32_t count = 0U;
    *value = 0U;
    while (count < limit && self->at != self->end && *self->at >= '0' && *self->at <= '9') {
        *value = *value * 10U + (uint64_t)(*self->at++ - '0');
        count++;
    }
    return count;
}

bool text_take_fixed(text_cursor *self, uint32_t decimals, bool optional, uint64_t *value)
{
    uint64_t whole;
    uint64_t fraction = 0U;
    uint32_t digits = 0U;
    if (text_take_decimal(self, WHOLE_DIGITS_MAX, &whole) == 0U) {
        return false;
    }
    if (text_take(self, '.')) {
        digits = text_take_decimal(self, FRACTION_DIGITS_MAX, &fraction);
    }
    if (digits == 0U && !optional) {
        return false;
    }
    for (; digits < decimals; digits++) {
        fraction *= 10U;
    }
    uint64_t unit = 1U;
    for (; digits > decimals; digits--) {
        unit *= 10U;
    }
    for (uint32_t i = 0U; i < decimals; i++) {
        whole *= 10U;
    }
    *value = whole + (fraction + unit / 2U) / unit;
    return true;
}

/* Value of a hexadecimal digit, or a number above 15. */
static uint32_t digit(char character)
{
    if (character >= '0' && character <= '9') {
        return (uint32_t)(character - '0');
    }
    const char lower = (char)(character | 0x20);
    return lower >= 'a' && lower <= 'f' ? (uint32_t)(lower - 'a') + 10U : 16U;
}

uint32_t text_take_hexadecimal(text_cursor *self, uint32_t limit, uint32_t *value)
{
    uint32_t count = 0U;
    *value = 0U;
    while (count < limit && self->at != self->end && digit(*self->at) < 16U) {
        *value = *value << 4U | digit(*self->at++);
        count++;
    }
    return count;
}
