/* One classic CAN frame as every part of the bench passes it on, and the buses it can travel on.
 *
 * The layout is fixed (24 bytes, little-endian hosts): Python reads arrays of frames as numpy records
 * (dbc/frames.py), and the recorder writes them as they are.
 */
#ifndef RACELOOP_CAN_FRAME_H
#define RACELOOP_CAN_FRAME_H

#include <stdbool.h>
#include <stdint.h>

enum {
    CAN_DATA_MAX = 8,
    CAN_FRAME_SIZE = 24,
    CAN_ID_STANDARD_MAX = 0x7FF,
    CAN_ID_EXTENDED_MAX = 0x1FFFFFFF,
};

/* Buses of the bench. The number is the `bus` of a frame. */
enum can_bus {
    CAN_BUS_1 = 0, /* raptor.dbc: OBC and Raptor, 500 kbit/s */
    CAN_BUS_3 = 1, /* space_drive.dbc: Raptor and Space Drive, 500 kbit/s */
    CAN_BUS_A = 2, /* autonomy.dbc: autonomy, operator and OBC, 1 Mbit/s */
    CAN_BUS_S = 3, /* sensors.dbc: localisation sensors, 500 kbit/s */
    CAN_BUS_R = 4, /* radar_esr.dbc: front radar and autonomy, 500 kbit/s; only in a car with the radar */
    CAN_BUS_COUNT = 5,
};

/* Stations that send. The number is the `sender` of a frame; it does not travel on the wire. */
enum can_station {
    CAN_STATION_NONE = 0, /* unknown: from a tap, a log or a test */
    CAN_STATION_SENSORS = 1,
    CAN_STATION_AUTONOMY = 2,
    CAN_STATION_OBC = 3,
    CAN_STATION_RAPTOR = 4,
    CAN_STATION_SPACE_DRIVE = 5,
    CAN_STATION_OPERATOR = 6,
    CAN_STATION_COUNT = 7,
};

/* Bits of can_frame.flags. */
enum can_frame_flag {
    CAN_FLAG_EXTENDED = 1, /* 29-bit identifier */
    CAN_FLAG_REMOTE = 2,   /* remote transmission request: no data */
    CAN_FLAG_ERROR = 4,    /* error frame as SocketCAN reports it */
};

typedef struct can_frame {
    uint64_t time_us; /* end of the frame on the bus, simulated microseconds; 0 before it was sent */
    uint32_t id;      /* identifier without flag bits */
    uint8_t bus;      /* enum can_bus */
    uint8_t dlc;      /* data bytes, 0..8; receivers treat more as 8 */
    uint8_t flags;    /* enum can_frame_flag */
    uint8_t sender;   /* enum can_station */
    uint8_t data[8];
} can_frame;

/* Frames that a tick sends: storage belongs to the caller; what does not fit is counted and lost. */
typedef struct can_outbox {
    can_frame *frames;
    uint32_t capacity;
    uint32_t count;
    uint32_t dropped;
} can_outbox;

/* Append a zeroed data frame with its address filled in.
 *
 * out: not null. bus: enum can_bus. id: 11 or 29 bits by flags. dlc: 0..8.
 * Returns the frame to fill, or null when the outbox is full (counted in out->dropped).
 */
can_frame *can_outbox_add(can_outbox *out, uint8_t bus, uint32_t id, uint8_t flags, uint8_t dlc);

#endif
