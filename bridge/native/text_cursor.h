/* A place in the text of a log, for readers that go through it once. Every step fails at the end of the text. */
#ifndef BRIDGE_TEXT_CURSOR_H
#define BRIDGE_TEXT_CURSOR_H

#include <stdbool.h>
#include <stdint.h>

typedef struct text_cursor {
    const char *at;
    const char *end;
} text_cursor;

/* One character. Returns whether it was the next. */
bool text_take(text_cursor *self, char wanted);

/* Blanks and tabulators. Returns how many there were. */
uint32_t text_take_blanks(text_cursor *self);

/* Up to limit decimal digits, at most 19. Returns how many there were. */
uint32_t text_take_decimal(text_cursor *self, uint32_t limit, uint64_t *value);

/* A number with a fraction, in units of 10^-decimals (at most 6), rounded. At most 12 digits before the point and 9
 * behind it; the fraction may be missing if it is optional. Returns whether there was one. */
bool text_take_fixed(text_cursor *self, uint32_t decimals, bool optional, uint64_t *value);

/* Up to limit hexadecimal digits, at most 8. Returns how many there were. */
uint32_t text_take_hexadecimal(text_cursor *self, uint32_t limit, uint32_t *value);

#endif
