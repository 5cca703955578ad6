#include "obc/wall_receiver.h"

#include <stddef.h>

#include "generated/autonomy.h"
#include "generated/codec_table.h"

enum {
    LINE = 0,
    BEND = 1,
};

static void take_line(wall_receiver *self, const uint8_t *data)
{
    struct autonomy_wall_line_t line;
    (void)autonomy_wall_line_unpack(&line, data, CAN_DATA_MAX);
    self->halves.coefficient[0] = (float)autonomy_wall_line_wall_offset_decode(line.wall_offset);
    self->halves.coefficient[1] = (float)autonomy_wall_line_wall_slope_decode(line.wall_slope);
    self->found = line.wall_order != AUTONOMY_WALL_LINE_WALL_ORDER_NONE_CHOICE;
    self->counter[LINE] = line.wall_line_counter;
}

static void take_bend(wall_receiver *self, const uint8_t *data)
{
    struct autonomy_wall_bend_t bend;
    (void)autonomy_wall_bend_unpack(&bend, data, CAN_DATA_MAX);
    self->halves.coefficient[2] = (float)autonomy_wall_bend_wall_second_decode(bend.wall_second);
    self->halves.coefficient[3] = (float)autonomy_wall_bend_wall_third_decode(bend.wall_third);
    self->halves.begin = (float)autonomy_wall_bend_wall_begin_decode(bend.wall_begin);
    self->halves.end = (float)autonomy_wall_bend_wall_end_decode(bend.wall_end);
    self->counter[BEND] = bend.wall_bend_counter;
}

static void join(wall_receiver *self)
{
    const uint8_t counter = self->counter[LINE];
    const bool whole = self->half_seen[LINE] && self->half_seen[BEND] && counter == self->counter[BEND];
    if (whole && self->found && !(self->seen && counter == self->wall_counter)) {
        const uint64_t line_us = self->half_us[LINE];
        const uint64_t bend_us = self->half_us[BEND];
        self->wall = self->halves;
        self->wall_counter = counter;
        self->received_us = line_us < bend_us ? line_us : bend_us;
        self->count++;
        self->seen = true;
    }
}

void wall_receiver_push(wall_receiver *self, const can_frame *frame, uint64_t now_us)
{
    const codec_message *message = NULL;
    if (codec_accept(frame, &message) != CODEC_OK) {
        return;
    }
    const uint32_t half = frame->id == AUTONOMY_WALL_LINE_FRAME_ID ? LINE : BEND;
    if (half == LINE) {
        take_line(self, frame->data);
    } else {
        take_bend(self, frame->data);
    }
    self->half_us[half] = now_us;
    self->half_seen[half] = true;
    join(self);
}

uint16_t wall_receiver_age_ms(const wall_receiver *self, uint64_t now_us)
{
    const uint64_t age = self->seen ? (now_us - self->received_us) / 1000U : UINT16_MAX;
    return age < UINT16_MAX ? (uint16_t)age : (uint16_t)UINT16_MAX;
}

uint16_t wall_receiver_timeout_ms(void)
{
    return codec_table[CODEC_AUTONOMY_WALL_BEND].timeout_ms;
}
