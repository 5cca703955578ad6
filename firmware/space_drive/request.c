#include "space_drive/request.h"

#include "generated/space_drive.h"

/* Take position and speed of a request whose codec checks passed; false when its position is above counts_max. */
static bool take_content(space_drive_request *self, const can_frame *frame, uint16_t counts_max)
{
    uint16_t counts;
    uint16_t speed_kmh = 0;

    if (frame->id == SPACE_DRIVE_REQ_STEER_POS_FRAME_ID) {
        struct space_drive_req_steer_pos_t steer;
        (void)space_drive_req_steer_pos_unpack(&steer, frame->data, sizeof frame->data);
        counts = steer.cntrl_pos;
        speed_kmh = steer.veh_speed;
    } else {
        struct space_drive_req_brake_pos_t brake;
        (void)space_drive_req_brake_pos_unpack(&brake, frame->data, sizeof frame->data);
        counts = brake.contrl_pos_brk;
    }
    if (counts > counts_max) {
        return false;
    }
    self->counts = counts;
    self->speed_kmh = speed_kmh;
    return true;
}

void space_drive_request_receive(space_drive_request *self, const can_frame *frame, uint16_t counts_max,
                                 uint16_t bad_limit, uint64_t now_us)
{
    const bool good = codec_receive(&self->rx, frame, now_us) == CODEC_OK && take_content(self, frame, counts_max);

    if (good) {
        self->bad_in_row = 0;
        self->last_valid_us = now_us;
        self->state = SPACE_DRIVE_REQUEST_FRESH;
        return;
    }
    if (self->bad_in_row < UINT16_MAX) {
        self->bad_in_row++;
    }
    if (self->state == SPACE_DRIVE_REQUEST_FRESH && self->bad_in_row >= bad_limit) {
        self->state = SPACE_DRIVE_REQUEST_LOST;
    }
}

void space_drive_request_age(space_drive_request *self, uint32_t timeout_us, uint64_t now_us)
{
    if (self->state == SPACE_DRIVE_REQUEST_FRESH && now_us - self->last_valid_us > timeout_us) {
        self->state = SPACE_DRIVE_REQUEST_LOST;
    }
}
