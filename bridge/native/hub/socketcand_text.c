#include "socketcand_text.h"

#include <stdbool.h>
#include <stdio.h>
#include <string.h>

#include "ports/linux/ecu_options.h"

enum {
    WORDS_MAX = 3 + CAN_DATA_MAX, /* send ID DLC BYTE... */
    STANDARD_DIGITS = 3,
    EXTENDED_DIGITS = 8,
    US_PER_S = 1000000,
};

typedef struct word {
    const char *text;
    uint32_t length;
} word;

/* Words of a request; `count` may exceed WORDS_MAX, the words beyond are not kept. */
typedef struct words {
    uint32_t count;
    word items[WORDS_MAX];
} words;

/* Channels have the names of the buses, or those of the SocketCAN interfaces that carry them. */
static const char *const INTERFACES[CAN_BUS_COUNT] = {"vcan0", "vcan1", "vcan2", "vcan3", "vcan4"};

static bool is_blank(char c)
{
    return c == ' ' || c == '\t' || c == '\r' || c == '\n';
}

static bool is_text(char c)
{
    return (c > ' ' && c <= '~' && c != '<' && c != '>') || is_blank(c);
}

static bool is_word(const word *self, const char *name)
{
    return self->length == strlen(name) && memcmp(self->text, name, self->length) == 0;
}

static words split(const char *text, uint32_t length)
{
    words result = {0};
    for (uint32_t i = 0; i < length;) {
        if (is_blank(text[i])) {
            i++;
            continue;
        }
        const uint32_t start = i;
        while (i < length && !is_blank(text[i])) {
            i++;
        }
        if (result.count < WORDS_MAX) {
            result.items[result.count] = (word){&text[start], i - start};
        }
        result.count++;
    }
    return result;
}

static bool read_hex(const word *self, uint32_t digits_max, uint32_t *value)
{
    if (self->length > digits_max) {
        return false;
    }
    uint32_t result = 0;
    for (uint32_t i = 0; i < self->length; i++) {
        const char c = self->text[i];
        uint32_t digit;
        if (c >= '0' && c <= '9') {
            digit = (uint32_t)(c - '0');
        } else if (c >= 'a' && c <= 'f') {
            digit = (uint32_t)(c - 'a') + 10U;
        } else if (c >= 'A' && c <= 'F') {
            digit = (uint32_t)(c - 'A') + 10U;
        } else {
            return false;
        }
        result = result << 4U | digit;
    }
    *value = result;
    return true;
}

static bool read_id(const word *self, can_frame *frame)
{
    if (self->length == EXTENDED_DIGITS) {
        frame->flags = CAN_FLAG_EXTENDED;
        return read_hex(self, EXTENDED_DIGITS, &frame->id) && frame->id <= CAN_ID_EXTENDED_MAX;
    }
    return read_hex(self, STANDARD_DIGITS, &frame->id) && frame->id <= CAN_ID_STANDARD_MAX;
}

static bool read_frame(const words *request, can_frame *frame)
{
    uint32_t dlc = 0;
    if (request->count < 3U || !read_id(&request->items[1], frame) || !read_hex(&request->items[2], 1, &dlc) ||
        dlc > CAN_DATA_MAX || request->count != 3U + dlc) {
        return false;
    }
    frame->dlc = (uint8_t)dlc;
    for (uint32_t i = 0; i < dlc; i++) {
        uint32_t byte = 0;
        if (!read_hex(&request->items[3U + i], 2, &byte)) {
            return false;
        }
        frame->data[i] = (uint8_t)byte;
    }
    return true;
}

static void understand(const words *said, socketcand_request *request)
{
    request->kind = SOCKETCAND_UNKNOWN;
    if (said->count == 0) {
        return;
    }
    const word *verb = &said->items[0];
    if (is_word(verb, "send")) {
        can_frame frame = {0};
        request->kind = SOCKETCAND_BAD_SEND;
        if (read_frame(said, &frame)) {
            request->kind = SOCKETCAND_SEND;
            request->frame = frame;
        }
    } else if (is_word(verb, "open") && said->count == 2U) {
        request->kind = SOCKETCAND_UNKNOWN_CHANNEL;
        for (uint8_t bus = 0; bus < CAN_BUS_COUNT; bus++) {
            if (is_word(&said->items[1], ecu_bus_name(bus)) || is_word(&said->items[1], INTERFACES[bus])) {
                request->kind = SOCKETCAND_OPEN;
                request->bus = bus;
            }
        }
    } else if (said->count == 1U && is_word(verb, "rawmode")) {
        request->kind = SOCKETCAND_RAWMODE;
    } else if (said->count == 1U && is_word(verb, "echo")) {
        request->kind = SOCKETCAND_ECHO;
    } else if (said->count == 1U &&
               (is_word(verb, "bcmmode") || is_word(verb, "controlmode") || is_word(verb, "isotpmode"))) {
        request->kind = SOCKETCAND_OTHER_MODE;
    }
}

uint32_t socketcand_read(const char *text, uint32_t length, socketcand_request *request)
{
    memset(request, 0, sizeof *request);
    uint32_t start = 0;
    while (start < length && is_blank(text[start])) {
        start++;
    }
    for (uint32_t i = start; i < length; i++) {
        if (i > start && i - start < SOCKETCAND_REQUEST_MAX && text[i] == '>') {
            const words said = split(&text[start + 1U], i - start - 1U);
            understand(&said, request);
            return i + 1U;
        }
        if (i == start ? text[i] != '<' : !is_text(text[i]) || i - start >= SOCKETCAND_REQUEST_MAX) {
            request->kind = SOCKETCAND_GARBAGE;
            return length;
        }
    }
    return start;
}

uint32_t socketcand_write(char *text, const can_frame *frame, uint64_t wall_us)
{
    static const char DIGITS[] = "0123456789ABCDEF";
    const unsigned long long seconds = wall_us / US_PER_S;
    const unsigned microseconds = (unsigned)(wall_us % US_PER_S);
    if ((frame->flags & CAN_FLAG_ERROR) != 0) {
        return (uint32_t)snprintf(text, SOCKETCAND_FRAME_MAX, "< error %03X %llu.%06u >", (unsigned)frame->id, seconds,
                                  microseconds);
    }
    if ((frame->flags & CAN_FLAG_REMOTE) != 0) {
        text[0] = '\0';
        return 0;
    }
    const int digits = (frame->flags & CAN_FLAG_EXTENDED) != 0 ? EXTENDED_DIGITS : STANDARD_DIGITS;
    uint32_t length = (uint32_t)snprintf(text, SOCKETCAND_FRAME_MAX, "< frame %0*X %llu.%06u ", digits,
                                         (unsigned)frame->id, seconds, microseconds);
    for (uint32_t i = 0; i < frame->dlc && i < CAN_DATA_MAX; i++) {
        text[length++] = DIGITS[frame->data[i] >> 4U];
        text[length++] = DIGITS[frame->data[i] & 0xFU];
    }
    memcpy(&text[length], " >", sizeof " >");
    return length + 2U;
}
