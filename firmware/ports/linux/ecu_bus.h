/* One bus as an ECU hears it: a link with the filters that the DBC files give the ECU, and what of the received frames
 * the firmware gets to see. */
#ifndef RACELOOP_PORT_ECU_BUS_H
#define RACELOOP_PORT_ECU_BUS_H

#include <stdint.h>

#include "common/can_frame.h"
#include "ports/linux/can_link.h"

enum {
    ECU_BUS_FRAMES_MAX = 256,   /* that the firmware gets of one bus in one cycle */
    ECU_BUS_FRESH_PERIODS = 10, /* older frames are dropped: the firmware dates them by when it sees them */
};

/* What becomes of a frame. */
enum ecu_bus_verdict {
    ECU_BUS_TAKE = 0,
    ECU_BUS_SECOND_SENDER = 1, /* a message that only this ECU sends */
    ECU_BUS_LATE = 2,
};

/* State: zero it before opening. */
typedef struct ecu_bus {
    can_link link;
    uint8_t station;        /* enum can_station of this ECU */
    uint32_t fresh_us;      /* age up to which frames are taken */
    uint64_t second_sender; /* frames */
    uint64_t late;          /* frames */
    uint64_t crowded_out;   /* frames beyond ECU_BUS_FRAMES_MAX in a cycle */
    uint64_t newest_us;     /* time of the newest frame that the last receive read; 0: none */
    uint64_t down_us;       /* when it was seen to be down; 0: it is not */
    uint64_t outages_told;
    uint32_t second_id; /* of the newest frame of a second sender, with its flags: */
    uint8_t second_flags;
    uint8_t told; /* kinds of loss of which a line was written */
} ecu_bus;

/* What this ECU wants to hear on a bus: data frames that the DBC files mean for it, and its own messages, to notice a
 * second sender. station: enum can_station. bus: enum can_bus. filters: room for CAN_LINK_FILTERS_MAX.
 * Returns the number of filters. */
uint32_t ecu_bus_filters(uint8_t station, uint8_t bus, can_link_filter *filters);

/* Judge a frame. now_us: since the epoch, as in the frame. fresh_us: age up to which it is taken.
 * Returns enum ecu_bus_verdict. Error frames and unknown identifiers are for the firmware to judge. */
uint8_t ecu_bus_judge(uint8_t station, const can_frame *frame, uint64_t now_us, uint32_t fresh_us);

/* Attach; arguments and result as for can_link_open. fresh_us: see ecu_bus_judge. */
int32_t ecu_bus_open(ecu_bus *self, const char *address, uint8_t station, uint8_t bus, uint64_t epoch_ns,
                     uint32_t fresh_us);

/* Empty the receive queue, as far as a bounded time allows. frames: room for ECU_BUS_FRAMES_MAX; gets what the firmware
 * is to see, of a second sender's frames one. now_us: since the epoch. Returns the number of frames. */
uint32_t ecu_bus_receive(ecu_bus *self, can_frame *frames, uint64_t now_us);

/* Write a line for each change since the last call: down, up again, first losses of a kind, second sender.
 * now_us: since the epoch. name: of the ECU. */
void ecu_bus_tell(ecu_bus *self, const char *name, uint64_t now_us);

/* Write one line of statistics; nothing for a bus that was never opened. */
void ecu_bus_summarise(const ecu_bus *self);

#endif
