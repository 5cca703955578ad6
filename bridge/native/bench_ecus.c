#include "bench_ecus.h"

static uint32_t finish(network *net, uint8_t station, const can_outbox *out)
{
    network_clear_inbox(net, station);
    network_submit(net, station, out->frames, out->count);
    return out->dropped;
}

uint32_t bench_obc_tick(network *net, obc *self, uint64_t now_us)
{
    const network_inbox *inbox = &net->inboxes[CAN_STATION_OBC];
    can_frame frames[BENCH_OUTBOX_MAX];
    can_outbox out = {.frames = frames, .capacity = BENCH_OUTBOX_MAX};
    obc_tick(self, now_us, inbox->frames, inbox->count, &out);
    return finish(net, CAN_STATION_OBC, &out);
}

uint32_t bench_raptor_tick(network *net, raptor *self, uint64_t now_us, const raptor_wired_in *wired,
                           raptor_wired_out *drive)
{
    const network_inbox *inbox = &net->inboxes[CAN_STATION_RAPTOR];
    can_frame frames[BENCH_OUTBOX_MAX];
    can_outbox out = {.frames = frames, .capacity = BENCH_OUTBOX_MAX};
    raptor_tick(self, now_us, wired, inbox->frames, inbox->count, drive, &out);
    return finish(net, CAN_STATION_RAPTOR, &out);
}

uint32_t bench_space_drive_tick(network *net, space_drive *self, uint64_t now_us, const space_drive_wired_in *wired,
                                space_drive_wired_out *drive)
{
    const network_inbox *inbox = &net->inboxes[CAN_STATION_SPACE_DRIVE];
    can_frame frames[BENCH_OUTBOX_MAX];
    can_outbox out = {.frames = frames, .capacity = BENCH_OUTBOX_MAX};
    space_drive_tick(self, now_us, wired, inbox->frames, inbox->count, drive, &out);
    return finish(net, CAN_STATION_SPACE_DRIVE, &out);
}
