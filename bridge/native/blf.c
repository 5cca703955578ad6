#include "bridge/native/blf.h"

#include <stdbool.h>
#include <string.h>

enum {
    HEADER = 16,    /* bytes of an object up to its type */
    HEADER_V1 = 32, /* bytes of an object up to its content */
    HEADER_V2 = 40,
    PADDING_MAX = 4, /* an object begins at most that much behind the end of the one before */
    SIGNATURE = 4,
    LENGTHS_MAX = 15,
    FD64_FIELDS = 40,

    TYPE_MESSAGE = 1,
    TYPE_ERROR_EXT = 73,
    TYPE_MESSAGE2 = 86,
    TYPE_FD_MESSAGE = 100,
    TYPE_FD_MESSAGE_64 = 101,

    TEN_MICROSECONDS = 1, /* in the header's flags: the unit of time; otherwise nanoseconds */
    REMOTE = 0x80,        /* in a message's flags */
    REMOTE_FD64 = 0x10,
};

#define IDENTIFIER 0x1FFFFFFFU
#define EXTENDED   0x80000000U

/* Data bytes by the length code of CAN FD. */
static const uint8_t LENGTHS[LENGTHS_MAX + 1] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64};

static uint8_t length_of(uint32_t code)
{
    return LENGTHS[code < (uint32_t)LENGTHS_MAX ? code : (uint32_t)LENGTHS_MAX];
}

/* A piece of memory; reading beyond its end gives zeros, and is remembered. */
typedef struct bytes {
    const uint8_t *at;
    uint32_t length;
    bool short_of;
} bytes;

/* Whether there are `size` bytes from `offset` on. */
static bool holds(bytes *self, uint32_t offset, uint32_t size)
{
    const bool there = offset + size <= self->length;
    self->short_of = self->short_of || !there;
    return there;
}

/* A number of up to 4 bytes. */
static uint32_t number(bytes *self, uint32_t offset, uint32_t size)
{
    if (!holds(self, offset, size)) {
        return 0U;
    }
    uint32_t value = 0U;
    for (uint32_t i = 0U; i < size; i++) {
        value |= (uint32_t)self->at[offset + i] << (8U * i);
    }
    return value;
}

static uint64_t time_of(bytes *object, uint64_t start_us)
{
    const uint64_t ticks = (uint64_t)number(object, 28U, 4U) << 32U | number(object, 24U, 4U);
    const uint64_t room_us = (uint64_t)INT64_MAX - (start_us < (uint64_t)INT64_MAX ? start_us : (uint64_t)INT64_MAX);
    if (number(object, 16U, 4U) == (uint32_t)TEN_MICROSECONDS) {
        return ticks > room_us / 10U ? (uint64_t)INT64_MAX : start_us + 10U * ticks;
    }
    const uint64_t micros = ticks / 1000U + (ticks % 1000U >= 500U ? 1U : 0U);
    return micros > room_us ? (uint64_t)INT64_MAX : start_us + micros;
}

static void set_identifier(can_frame *frame, uint32_t identifier)
{
    frame->id = identifier & IDENTIFIER;
    const bool extended = (identifier & EXTENDED) != 0U;
    frame->flags = extended ? (uint8_t)CAN_FLAG_EXTENDED : (uint8_t)0;
}

/* Up to 8 of the data bytes there are; what the object does not hold stays zero. */
static void set_data(can_frame *frame, const bytes *object, uint32_t offset, uint32_t count)
{
    const uint32_t there = offset < object->length ? object->length - offset : 0U;
    uint32_t size = count < (uint32_t)CAN_DATA_MAX ? count : (uint32_t)CAN_DATA_MAX;
    size = size < there ? size : there;
    if ((frame->flags & CAN_FLAG_REMOTE) == 0U) {
        memcpy(frame->data, object->at + offset, size);
    }
}

static uint16_t take_message(bytes *object, uint32_t content, can_frame *frame)
{
    set_identifier(frame, number(object, content + 4U, 4U));
    if ((number(object, content + 2U, 1U) & REMOTE) != 0U) {
        frame->flags = (uint8_t)(frame->flags | CAN_FLAG_REMOTE);
    }
    frame->dlc = (uint8_t)number(object, content + 3U, 1U);
    (void)holds(object, content + 8U, (uint32_t)CAN_DATA_MAX);
    set_data(frame, object, content + 8U, frame->dlc);
    return (uint16_t)number(object, content, 2U);
}

static uint16_t take_error(bytes *object, uint32_t content, can_frame *frame)
{
    set_identifier(frame, number(object, content + 16U, 4U));
    frame->flags = (uint8_t)(frame->flags | CAN_FLAG_ERROR);
    frame->dlc = (uint8_t)number(object, content + 10U, 1U);
    set_data(frame, object, content + 24U, frame->dlc);
    return (uint16_t)number(object, content, 2U);
}

static uint16_t take_fd_message(bytes *object, uint32_t content, can_frame *frame)
{
    set_identifier(frame, number(object, content + 4U, 4U));
    if ((number(object, content + 2U, 1U) & REMOTE) != 0U) {
        frame->flags = (uint8_t)(frame->flags | CAN_FLAG_REMOTE);
    }
    frame->dlc = length_of(number(object, content + 3U, 1U));
    set_data(frame, object, content + 20U, number(object, content + 14U, 1U));
    return (uint16_t)number(object, content, 2U);
}

static uint16_t take_fd_message_64(bytes *object, uint32_t content, can_frame *frame)
{
    set_identifier(frame, number(object, content + 4U, 4U));
    if ((number(object, content + 12U, 4U) & REMOTE_FD64) != 0U) {
        frame->flags = (uint8_t)(frame->flags | CAN_FLAG_REMOTE);
    }
    frame->dlc = length_of(number(object, content + 1U, 1U));
    /* Behind the data there may be more, from an offset that is given. */
    const uint32_t more = number(object, content + 35U, 1U);
    const uint32_t fields = number(object, 4U, 2U) + (uint32_t)FD64_FIELDS;
    const uint32_t room = more == 0U ? object->length : more;
    const uint32_t count = number(object, content + 2U, 1U);
    const uint32_t there = room > fields ? room - fields : 0U;
    set_data(frame, object, content + (uint32_t)FD64_FIELDS, count < there ? count : there);
    return (uint16_t)number(object, content, 1U);
}

/* Read one object. Returns whether it holds a frame. */
static bool take_object(bytes object, uint64_t start_us, can_frame *frame, uint16_t *channel)
{
    const uint32_t type = number(&object, 12U, 4U);
    const uint32_t content = number(&object, 6U, 2U) == 1U ? (uint32_t)HEADER_V1 : (uint32_t)HEADER_V2;
    *frame = (can_frame){.time_us = time_of(&object, start_us)};
    switch (type) {
    case TYPE_MESSAGE:
    case TYPE_MESSAGE2:
        *channel = take_message(&object, content, frame);
        break;
    case TYPE_ERROR_EXT:
        *channel = take_error(&object, content, frame);
        break;
    case TYPE_FD_MESSAGE:
        *channel = take_fd_message(&object, content, frame);
        break;
    case TYPE_FD_MESSAGE_64:
        *channel = take_fd_message_64(&object, content, frame);
        break;
    default:
        return false;
    }
    return !object.short_of;
}

/* Find the object that begins at a place or a few bytes of padding behind it. Moves the place to its beginning.
 *
 * Returns BLF_INCOMPLETE when the data end before the object does, BLF_DAMAGED when there is none, and BLF_FULL, as
 * nothing but room for it is missing, when *size is its length. */
static enum blf_end find_object(const uint8_t *data, uint32_t length, uint32_t *place, uint32_t *size)
{
    uint32_t padding = 0U;
    if (length - *place < (uint32_t)(PADDING_MAX + SIGNATURE)) {
        return BLF_INCOMPLETE;
    }
    while (padding <= (uint32_t)PADDING_MAX && memcmp(data + *place + padding, "LOBJ", SIGNATURE) != 0) {
        padding++;
    }
    if (padding > (uint32_t)PADDING_MAX) {
        return BLF_DAMAGED;
    }
    *place += padding;
    bytes rest = {.at = data + *place, .length = length - *place};
    const uint32_t version = number(&rest, 6U, 2U);
    *size = number(&rest, 8U, 4U);
    if (rest.short_of || rest.length < (uint32_t)HEADER) {
        return BLF_INCOMPLETE;
    }
    if (version < 1U || version > 2U || *size < (uint32_t)HEADER || *size > (uint32_t)BLF_OBJECT_MAX) {
        return BLF_DAMAGED;
    }
    return *size > rest.length ? BLF_INCOMPLETE : BLF_FULL;
}

blf_progress blf_read(const uint8_t *data, uint32_t length, uint64_t start_us, can_frame *frames, uint16_t *channels,
                      uint32_t capacity)
{
    blf_progress progress = {.end = BLF_FULL};
    uint32_t size = 0U;
    while (progress.count < capacity) {
        const enum blf_end found = find_object(data, length, &progress.used, &size);
        if (found != BLF_FULL) {
            progress.end = (uint32_t)found;
            break;
        }
        const bytes object = {.at = data + progress.used, .length = size};
        if (take_object(object, start_us, &frames[progress.count], &channels[progress.count])) {
            progress.count++;
        }
        progress.used += size;
    }
    return progress;
}
