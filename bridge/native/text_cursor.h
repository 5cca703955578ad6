/* A place in the text of a log, for readers that go through it once. Every step fails at the end of the text.
 * Here and not apart, because a call for every character would take as long again. */
#ifndef BRIDGE_TEXT_CURSOR_H
#define BRIDGE_TEXT_CURSOR_H

#include <stdbool.h>
#include <stdint.h>

typedef struct text_cursor {
    const char *at;
    const char *end;
} text_cursor;

enum {
    TEXT_WHOLE_DIGITS_MAX = 12, /* with six decimals within 64 bits */
    TEXT_FRACTION_DIGITS_MAX = 9,
};

/* One character. Returns whether it was the next. */
static inline bool text_take(text_cursor *self, char wanted)
{
    if (self->at == self->end || *self->at != wanted) {
        return false;
    }
    self->at++;
    return true;
}

/* Blanks and tabulators. Returns how many there were. */
static inline uint32_t text_take_blanks(text_cursor *self)
{
    uint32_t count = 0U;
    while (text_take(self, ' ') || text_take(self, '\t')) {
        count++;
    }
    return count;
}

/* Up to limit decimal digits, at most 19. Returns how many there were. */
static inline uint32_t text_take_decimal(text_cursor *self, uint32_t limit, uint64_t *value)
{
    uint32_t count = 0U;
    *value = 0U;
    while (count < limit && self->at != self->end && *self->at >= '0' && *self->at <= '9') {
        *value = *value * 10U + (uint64_t)(*self->at++ - '0');
        count++;
    }
    return count;
}

/* A number with a fraction, in units of 10^-decimals (at most 6), rounded. At most 12 digits before the point and 9
 * behind it; the fraction may be missing if it is optional. Returns whether there was one. */
static inline bool text_take_fixed(text_cursor *self, uint32_t decimals, bool optional, uint64_t *value)
{
    uint64_t whole;
    uint64_t fraction = 0U;
    uint32_t digits = 0U;
    if (text_take_decimal(self, TEXT_WHOLE_DIGITS_MAX, &whole) == 0U) {
        return false;
    }
    if (text_take(self, '.')) {
        digits = text_take_decimal(self, TEXT_FRACTION_DIGITS_MAX, &fraction);
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

/* Values of hexadecimal digits, plus 1; 0 for other characters. Most of a log is digits, and a look is faster than
 * comparisons. */
static const uint8_t TEXT_DIGITS[256] = {
    ['0'] = 1,  ['1'] = 2,  ['2'] = 3,  ['3'] = 4,  ['4'] = 5,  ['5'] = 6,  ['6'] = 7,  ['7'] = 8,
    ['8'] = 9,  ['9'] = 10, ['a'] = 11, ['b'] = 12, ['c'] = 13, ['d'] = 14, ['e'] = 15, ['f'] = 16,
    ['A'] = 11, ['B'] = 12, ['C'] = 13, ['D'] = 14, ['E'] = 15, ['F'] = 16};

/* Value of a hexadecimal digit, or a number above 15. */
static inline uint32_t text_digit(char character)
{
    return (uint32_t)TEXT_DIGITS[(uint8_t)character] - 1U;
}

/* Up to limit hexadecimal digits, at most 8. Returns how many there were. */
static inline uint32_t text_take_hexadecimal(text_cursor *self, uint32_t limit, uint32_t *value)
{
    uint32_t count = 0U;
    *value = 0U;
    while (count < limit && self->at != self->end && text_digit(*self->at) < 16U) {
        *value = *value << 4U | text_digit(*self->at++);
        count++;
    }
    return count;
}

#endif
