#include "bridge/native/asc.h"

#include <stdbool.h>
#include <string.h>

#include "bridge/native/text_cursor.h"

enum {
    MICROS_DIGITS = 6,
    CHANNEL_DIGITS_MAX = 4,
    IDENTIFIER_DIGITS_MAX = 8,
};

static bool take_time(text_cursor *self, uint64_t *time_us)
{
    return text_take_fixed(self, MICROS_DIGITS, false, time_us) && text_take_blanks(self) != 0U;
}

static bool take_channel(text_cursor *self, uint16_t *channel)
{
    uint64_t number;
    const uint32_t digits = text_take_decimal(self, CHANNEL_DIGITS_MAX, &number);
    *channel = (uint16_t)number;
    return digits != 0U && text_take_blanks(self) != 0U;
}

static bool take_identifier(text_cursor *self, can_frame *frame)
{
    if (text_take_hexadecimal(self, IDENTIFIER_DIGITS_MAX, &frame->id) == 0U) {
        return false;
    }
    const bool extended = text_take(self, 'x');
    frame->flags = extended ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
    return frame->id <= (uint32_t)(extended ? CAN_ID_EXTENDED_MAX : CAN_ID_STANDARD_MAX) &&
           text_take_blanks(self) != 0U;
}

static bool take_direction(text_cursor *self)
{
    return (text_take(self, 'R') || text_take(self, 'T')) && text_take(self, 'x') && text_take_blanks(self) != 0U;
}

static bool take_data(text_cursor *self, can_frame *frame)
{
    uint32_t count;
    if (!text_take(self, 'd') || text_take_blanks(self) == 0U || text_take_hexadecimal(self, 1U, &count) == 0U ||
        count > (uint32_t)CAN_DATA_MAX) {
        return false;
    }
    frame->dlc = (uint8_t)count;
    for (uint32_t i = 0U; i < count; i++) {
        uint32_t byte;
        if (text_take_blanks(self) == 0U || text_take_hexadecimal(self, 2U, &byte) == 0U) {
            return false;
        }
        frame->data[i] = (uint8_t)byte;
    }
    return true;
}

/* What other programs write behind the data, and the end of the line. */
static bool take_end(text_cursor *self)
{
    if (self->at == self->end || (*self->at != ' ' && *self->at != '\t' && *self->at != '\r' && *self->at != '\n')) {
        return false;
    }
    const char *end = memchr(self->at, '\n', (size_t)(self->end - self->at));
    if (end == NULL) {
        return false;
    }
    self->at = end + 1;
    return true;
}

uint32_t asc_read(const char *text, uint32_t length, can_frame *frames, uint16_t *channels, uint32_t capacity,
                  uint32_t *used)
{
    text_cursor line = {.at = text, .end = text + length};
    uint32_t count = 0U;
    *used = 0U;
    while (count < capacity) {
        can_frame frame = {0};
        (void)text_take_blanks(&line);
        if (!take_time(&line, &frame.time_us) || !take_channel(&line, &channels[count]) ||
            !take_identifier(&line, &frame) || !take_direction(&line) || !take_data(&line, &frame) ||
            !take_end(&line)) {
            break;
        }
        frames[count++] = frame;
        *used = (uint32_t)(line.at - text);
    }
    return count;
}
