#define _POSIX_C_SOURCE 200809L

#include "bridge/native/candump.h"

#include <stdbool.h>
#include <string.h>

enum {
    MICROS_DIGITS = 6,
    SECONDS_DIGITS_MAX = 12, /* microseconds stay within 64 bits */
    STANDARD_DIGITS = 3,
    EXTENDED_DIGITS = 8,
    STANDARD_MAX = 0x7FF,
    EXTENDED_MAX = 0x1FFFFFFF,
};

/* A place in a text; every step fails at its end. */
typedef struct cursor {
    const char *at;
    const char *end;
} cursor;

static bool take(cursor *self, char wanted)
{
    if (self->at == self->end || *self->at != wanted) {
        return false;
    }
    self->at++;
    return true;
}

/* Up to limit decimal digits. Returns how many there were. */
static uint32_t take_decimal(cursor *self, uint32_t limit, uint64_t *value)
{
    uint32_t count = 0U;
    *value = 0U;
    while (count < limit && self->at != self->end && *self->at >= '0' && *self->at <= '9') {
        *value = *value * 10U + (uint64_t)(*self->at++ - '0');
        count++;
    }
    return count;
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

/* Up to limit hexadecimal digits. Returns how many there were. */
static uint32_t take_hexadecimal(cursor *self, uint32_t limit, uint32_t *value)
{
    uint32_t count = 0U;
    *value = 0U;
    while (count < limit && self->at != self->end && digit(*self->at) < 16U) {
        *value = *value << 4U | digit(*self->at++);
        count++;
    }
    return count;
}

static bool take_time(cursor *self, uint64_t *time_us)
{
    uint64_t seconds;
    uint64_t micros;
    if (!take(self, '(') || take_decimal(self, SECONDS_DIGITS_MAX, &seconds) == 0U || !take(self, '.') ||
        take_decimal(self, MICROS_DIGITS, &micros) != MICROS_DIGITS || !take(self, ')') || !take(self, ' ')) {
        return false;
    }
    *time_us = seconds * 1000000U + micros;
    return true;
}

static bool take_channel(cursor *self, const candump_channel *channels, uint32_t count, uint8_t *bus)
{
    for (uint32_t i = 0U; i < count; i++) {
        const size_t length = strnlen(channels[i].name, CANDUMP_NAME_SIZE);
        if ((size_t)(self->end - self->at) > length && memcmp(self->at, channels[i].name, length) == 0 &&
            self->at[length] == ' ') {
            self->at += length + 1U;
            *bus = channels[i].bus;
            return true;
        }
    }
    return false;
}

static bool take_identifier(cursor *self, can_frame *frame)
{
    const uint32_t digits = take_hexadecimal(self, EXTENDED_DIGITS, &frame->id);
    const bool extended = digits == EXTENDED_DIGITS;
    frame->flags = extended ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
    return (extended || digits == STANDARD_DIGITS) && take(self, '#') &&
           frame->id <= (uint32_t)(extended ? EXTENDED_MAX : STANDARD_MAX);
}

static bool take_data(cursor *self, can_frame *frame)
{
    uint32_t byte;
    uint32_t digits = take_hexadecimal(self, 2U, &byte);
    while (digits == 2U && frame->dlc < CAN_DATA_MAX) {
        frame->data[frame->dlc++] = (uint8_t)byte;
        digits = take_hexadecimal(self, 2U, &byte);
    }
    return digits == 0U;
}

/* Which way the frame went, if the logger says so, and the end of the line. */
static bool take_end(cursor *self)
{
    if (take(self, ' ') && !take(self, 'R') && !take(self, 'T')) {
        return false;
    }
    return take(self, '\n');
}

uint32_t candump_read(const char *text, uint32_t length, const candump_channel *channels, uint32_t channel_count,
                      can_frame *frames, uint32_t capacity, uint32_t *used)
{
    cursor line = {.at = text, .end = text + length};
    uint32_t count = 0U;
    *used = 0U;
    while (count < capacity) {
        can_frame frame = {0};
        if (!take_time(&line, &frame.time_us) || !take_channel(&line, channels, channel_count, &frame.bus) ||
            !take_identifier(&line, &frame) || !take_data(&line, &frame) || !take_end(&line)) {
            break;
        }
        frames[count++] = frame;
        *used = (uint32_t)(line.at - text);
    }
    return count;
}
