#include "bridge/native/trc.h"

#include <stdbool.h>

#include "bridge/native/text_cursor.h"

enum {
    MILLISECOND_DECIMALS = 3, /* microseconds */
    CHANNEL_DIGITS_MAX = 4,
    IDENTIFIER_DIGITS_MAX = 8,
    STANDARD_DIGITS_MAX = 4,
};

static bool is_blank(char character)
{
    return character == ' ' || character == '\t' || character == '\r' || character == '\n';
}

static bool take_identifier(text_cursor *self, can_frame *frame)
{
    const uint32_t digits = text_take_hexadecimal(self, IDENTIFIER_DIGITS_MAX, &frame->id);
    const bool extended = digits > (uint32_t)STANDARD_DIGITS_MAX;
    frame->flags = extended ? (uint8_t)CAN_FLAG_EXTENDED : (uint8_t)0;
    return digits != 0U && frame->id <= (uint32_t)(extended ? CAN_ID_EXTENDED_MAX : CAN_ID_STANDARD_MAX);
}

static bool take_channel(text_cursor *self, uint16_t *channel)
{
    uint64_t number;
    const uint32_t digits = text_take_decimal(self, CHANNEL_DIGITS_MAX, &number);
    *channel = (uint16_t)number;
    return digits != 0U;
}

static bool take_length(text_cursor *self, can_frame *frame)
{
    uint64_t number;
    const uint32_t digits = text_take_decimal(self, 1U, &number);
    frame->dlc = (uint8_t)number;
    return digits != 0U && number <= (uint64_t)CAN_DATA_MAX;
}

static bool take_data(text_cursor *self, can_frame *frame)
{
    for (uint32_t i = 0U; i < (uint32_t)frame->dlc; i++) {
        uint32_t byte;
        if ((i != 0U && text_take_blanks(self) == 0U) || text_take_hexadecimal(self, 2U, &byte) != 2U) {
            return false;
        }
        frame->data[i] = (uint8_t)byte;
    }
    return true;
}

/* Anything. */
static bool take_word(text_cursor *self)
{
    const char *begin = self->at;
    while (self->at != self->end && !is_blank(*self->at)) {
        self->at++;
    }
    return self->at != begin;
}

static bool take_column(text_cursor *self, char column, can_frame *frame, uint16_t *channel)
{
    switch (column) {
    case 'O':
        return text_take_fixed(self, MILLISECOND_DECIMALS, true, &frame->time_us);
    case 'T':
        return text_take(self, 'D') && text_take(self, 'T');
    case 'B':
        return take_channel(self, channel);
    case 'I':
        return take_identifier(self, frame);
    case 'd':
        return (text_take(self, 'R') || text_take(self, 'T')) && text_take(self, 'x');
    case 'L':
    case 'l':
        return take_length(self, frame);
    case 'D':
        return take_data(self, frame);
    default:
        return take_word(self);
    }
}

static bool take_line(text_cursor *self, const char *columns, can_frame *frame, uint16_t *channel)
{
    *frame = (can_frame){0};
    *channel = 1U;
    for (const char *column = columns; *column != '\0'; column++) {
        (void)text_take_blanks(self);
        if (!take_column(self, *column, frame, channel) || (self->at != self->end && !is_blank(*self->at))) {
            return false;
        }
    }
    (void)text_take_blanks(self);
    (void)text_take(self, '\r');
    return text_take(self, '\n');
}

uint32_t trc_read(const char *text, uint32_t length, const char *columns, can_frame *frames, uint16_t *channels,
                  uint32_t capacity, uint32_t *used)
{
    text_cursor line = {.at = text, .end = text + length};
    uint32_t count = 0U;
    *used = 0U;
    while (count < capacity && take_line(&line, columns, &frames[count], &channels[count])) {
        count++;
        *used = (uint32_t)(line.at - text);
    }
    return count;
}
