#define _POSIX_C_SOURCE 200809L

#include "bridge/native/candump.h"

#include <stdbool.h>
#include <string.h>

#include "bridge/native/text_cursor.h"

enum {
    MICROS_DIGITS = 6,
    SECONDS_DIGITS_MAX = 12, /* microseconds stay within 64 bits */
    STANDARD_DIGITS = 3,
    EXTENDED_DIGITS = 8,
};

static bool take_time(text_cursor *self, uint64_t *time_us)
{
    uint64_t seconds;
    uint64_t micros;
    if (!text_take(self, '(') || text_take_decimal(self, SECONDS_DIGITS_MAX, &seconds) == 0U || !text_take(self, '.') ||
        text_take_decimal(self, MICROS_DIGITS, &micros) != MICROS_DIGITS || !text_take(self, ')') ||
        !text_take(self, ' ')) {
        return false;
    }
    *time_us = seconds * 1000000U + micros;
    return true;
}

static bool take_channel(text_cursor *self, const candump_channel *channels, uint32_t count, uint8_t *bus)
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

static bool take_identifier(text_cursor *self, can_frame *frame)
{
    const uint32_t digits = text_take_hexadecimal(self, EXTENDED_DIGITS, &frame->id);
    const bool extended = digits == EXTENDED_DIGITS;
    frame->flags = extended ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
    return (extended || digits == STANDARD_DIGITS) && text_take(self, '#') &&
           frame->id <= (uint32_t)(extended ? CAN_ID_EXTENDED_MAX : CAN_ID_STANDARD_MAX);
}

static bool take_data(text_cursor *self, can_frame *frame)
{
    uint32_t byte;
    uint32_t digits = text_take_hexadecimal(self, 2U, &byte);
    while (digits == 2U && frame->dlc < CAN_DATA_MAX) {
        frame->data[frame->dlc++] = (uint8_t)byte;
        digits = text_take_hexadecimal(self, 2U, &byte);
    }
    return digits == 0U;
}

/* Which way the frame went, if the logger says so, and the end of the line. */
static bool take_end(text_cursor *self)
{
    if (text_take(self, ' ') && !text_take(self, 'R') && !text_take(self, 'T')) {
        return false;
    }
    return text_take(self, '\n');
}

uint32_t candump_read(const char *text, uint32_t length, const candump_channel *channels, uint32_t channel_count,
                      can_frame *frames, uint32_t capacity, uint32_t *used)
{
    text_cursor line = {.at = text, .end = text + length};
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
