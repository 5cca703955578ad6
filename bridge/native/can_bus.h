/* simcan: one CAN bus with its nodes, exact to the bit time.
 *
 * Nodes queue frames; whenever the bus is idle the frame of lowest arbitration value among the heads of their queues is
 * sent, takes as long as its bits with stuffing take, and is acknowledged by whoever listens. Errors destroy frames,
 * move the nodes' error counters, make them error-passive and take them off the bus, as fault confinement of
 * ISO 11898-1:2015 (12.1) says; a destroyed frame is sent again. CAN FD with bit rate switch.
 *
 * Time is what the caller says: nothing here waits or reads a clock, and the same calls give the same events.
 * Propagation and clock tolerance are not modelled: all nodes sample the same bit at once. An error frame lasts 6 bits
 * of flag, 6 of the others' echo when somebody else is there, and 8 of delimiter.
 */
#ifndef RACELOOP_CAN_BUS_H
#define RACELOOP_CAN_BUS_H

#include <stdbool.h>
#include <stdint.h>

#include "can_wire.h"
#include "common/can_frame.h"

enum {
    CAN_BUS_NODES_MAX = 32,
    CAN_BUS_PENDING_MAX = 512,     /* frames waiting at once, of all nodes together */
    CAN_BUS_MESSAGES_MAX = 256,    /* identifiers whose delays are kept */
    CAN_BUS_DISTURBANCES_MAX = 16, /* waiting at once */
    CAN_BUS_NOBODY = 255,
    CAN_BUS_NO_SLOT = 65535,
};

/* A frame with room for the data of CAN FD. */
typedef struct can_bus_frame {
    can_frame frame;                                   /* its dlc counts up to 64, its flags have those of can_wire.h */
    uint8_t more[CAN_WIRE_FD_DATA_MAX - CAN_DATA_MAX]; /* data behind the first 8 bytes */
} can_bus_frame;

/* How a node behaves. */
typedef enum can_bus_mode {
    CAN_BUS_FIFO = 1,        /* sends in order of submission, as a driver's queue does; else by identifier */
    CAN_BUS_LISTEN_ONLY = 2, /* neither sends nor acknowledges nor signals errors */
    CAN_BUS_CLASSIC = 4,     /* takes FD frames for errors, and destroys them */
} can_bus_mode;

/* Fault confinement. */
typedef enum can_bus_state {
    CAN_BUS_ABSENT = 0,
    CAN_BUS_ERROR_ACTIVE = 1,
    CAN_BUS_ERROR_PASSIVE = 2, /* a counter is above 127 */
    CAN_BUS_OFF = 3,           /* the transmit error counter was above 255; hears and sends nothing */
} can_bus_state;

/* Bits of the identifier of an error frame, those of SocketCAN (linux/can/error.h). */
typedef enum can_bus_error {
    CAN_BUS_ERROR_CONTROLLER = 0x004, /* data[1]: what the sender's state has become */
    CAN_BUS_ERROR_PROTOCOL = 0x008,   /* data[2]: bit 0 single bit, bit 1 form, bit 7 while sending */
    CAN_BUS_ERROR_NO_ACK = 0x020,     /* nobody acknowledged */
    CAN_BUS_ERROR_OFF = 0x040,        /* the sender is off the bus */
    CAN_BUS_ERROR_ON_WIRE = 0x080,    /* an error frame was seen */
    CAN_BUS_ERROR_RESTARTED = 0x100,  /* the node is back */
    CAN_BUS_ERROR_COUNTERS = 0x200,   /* data[6], data[7]: transmit and receive error counter of the sender */
} can_bus_error;

/* Bits of data[1] with CAN_BUS_ERROR_CONTROLLER. */
typedef enum can_bus_controller {
    CAN_BUS_WARNING_RECEIVE = 0x04,
    CAN_BUS_WARNING_SEND = 0x08,
    CAN_BUS_PASSIVE_RECEIVE = 0x10,
    CAN_BUS_PASSIVE_SEND = 0x20,
} can_bus_controller;

typedef struct can_bus_node {
    uint8_t state; /* enum can_bus_state */
    uint8_t mode;  /* enum can_bus_mode */
    uint16_t transmit_errors;
    uint16_t receive_errors;
    uint16_t pending_count;
    uint16_t sending;       /* slot that is on the wire, or CAN_BUS_NO_SLOT */
    uint16_t recovery_left; /* sequences of 11 recessive bits to see before the bus may be used again */
    uint64_t ready_ns;      /* not to send before: suspended transmission, or the pause before recovery */
    uint64_t restart_ns;    /* pause between bus-off and the beginning of recovery; 0: until can_bus_restart */
    uint64_t cancelled;     /* frames thrown away when the node went off the bus or left */
    uint16_t pending[CAN_BUS_PENDING_MAX]; /* slots, the one of lowest rank last */
} can_bus_node;

/* A frame that waits. */
typedef struct can_bus_slot {
    uint64_t rank;       /* within its node; lowest first */
    uint64_t release_ns; /* when it was submitted */
    can_bus_frame content;
} can_bus_slot;

/* A planned error: the next `count` frames that match are destroyed. */
typedef struct can_bus_disturbance {
    uint32_t id;
    uint32_t mask;    /* of the identifier's bits that must match; 0: any frame */
    uint32_t count;   /* frames left to destroy */
    uint16_t bit;     /* from the start of frame, at which the error is; at most the last one */
    uint8_t sender;   /* node whose frames are meant, or CAN_BUS_NOBODY for any */
    uint8_t receiver; /* node that alone sees a wrong CRC, or CAN_BUS_NOBODY: then the bit is wrong for all */
} can_bus_disturbance;

/* Counts since the start. Bits and times include stuff bits, error frames and the intermission. */
typedef struct can_bus_statistics {
    uint64_t frames;
    uint64_t errors; /* error frames */
    uint64_t bits;
    uint64_t stuff_bits;
    uint64_t busy_ns;
    uint64_t busiest_slot_ns; /* most busy time in one slot */
    uint64_t deferred;        /* frames that were not through at the end of a slot, summed over slots */
    uint64_t lost;            /* frames refused because the queue was full, or the node could not send */
} can_bus_statistics;

/* What one identifier had to wait. */
typedef struct can_bus_message {
    uint32_t id;
    bool extended;
    uint64_t frames;            /* 0: the row is free */
    uint64_t worst_queueing_ns; /* from submission to the start of the transmission that succeeded */
    uint64_t worst_response_ns; /* from submission to the end of frame */
    uint64_t total_queueing_ns;
} can_bus_message;

/* What is on the wire now. */
typedef struct can_bus_transmission {
    bool active;
    bool destroyed;
    uint8_t winner;      /* node */
    uint8_t first_error; /* receiver that saw the error alone, or CAN_BUS_NOBODY */
    uint16_t cause;      /* enum can_bus_error */
    uint32_t senders;    /* bit n: node n sends too */
    uint32_t bits;       /* with error frame and intermission */
    uint32_t stuff_bits;
    uint64_t start_ns;
    uint64_t end_ns;  /* of the frame or of the error frame */
    uint64_t free_ns; /* intermission over */
} can_bus_transmission;

/* State of one bus: start it with can_bus_init. */
typedef struct can_bus_model {
    can_wire wire;
    uint32_t bit_ns;
    uint32_t data_bit_ns;
    uint64_t sequence;
    uint64_t free_ns;       /* when the bus is idle again */
    uint64_t slot_start_ns; /* slot that slot_busy_ns counts */
    uint64_t slot_end_ns;
    uint64_t slot_busy_ns;
    double bit_error_rate;
    uint64_t random;        /* state of the generator of bit errors */
    uint64_t bits_to_error; /* bits until the next one */
    uint32_t disturbance_count;
    uint8_t node_count; /* nodes behind are absent */
    uint32_t waiting;   /* bit n: node n has frames to send */
    uint32_t off;       /* bit n: node n is off the bus */
    uint32_t counting;  /* bit n: an error counter of node n is above 0 */
    uint16_t free_count;
    can_bus_transmission wire_now;
    can_bus_statistics statistics;
    can_bus_disturbance disturbances[CAN_BUS_DISTURBANCES_MAX];
    can_bus_message messages[CAN_BUS_MESSAGES_MAX];
    can_bus_node nodes[CAN_BUS_NODES_MAX];
    uint16_t free_slots[CAN_BUS_PENDING_MAX];
    can_bus_slot slots[CAN_BUS_PENDING_MAX];
} can_bus_model;

/* An idle bus without nodes at time 0.
 * bit_rate: bit/s, 1000..1000000 and a divisor of 1e9; anything else gives a bus that never delivers.
 * data_bit_rate: of the fast part of FD frames, up to 8000000; anything else counts as bit_rate. */
void can_bus_init(can_bus_model *self, uint32_t bit_rate, uint32_t data_bit_rate);

/* Put a node on the bus, error-active, with an empty queue. mode: bits of enum can_bus_mode.
 * False when there is no such node, or it is present, or a frame of it is still on the wire. */
bool can_bus_join(can_bus_model *self, uint8_t node, uint8_t mode);

/* Take a node off the bus; its queue is thrown away, but what it has on the wire goes through. */
void can_bus_leave(can_bus_model *self, uint8_t node);

/* Throw away what waits at a node, but for what is on the wire. */
void can_bus_flush(can_bus_model *self, uint8_t node);

/* Queue a frame at a node. content: copied; its sender becomes the node.
 * now_ns: from when on it competes; not before that of the call before.
 * False, and counted as lost, when the queue is full, or the node is absent, off the bus, or only listens. */
bool can_bus_submit(can_bus_model *self, uint8_t node, const can_bus_frame *content, uint64_t now_ns);

/* Let the bus work on what is pending, up to events before until_ns. What has started by then and is not through is on
 * the wire, and cannot be overtaken. An idle bus waits where it is.
 *
 * out, capacity: receives frames with time_us at their end, and error frames, in order. Returns how many; as many as
 * `capacity` means that there may be more. */
uint32_t can_bus_run(can_bus_model *self, uint64_t until_ns, can_bus_frame *out, uint32_t capacity);

/* When the next event is, if nothing else is submitted: UINT64_MAX for never. */
uint64_t can_bus_next_ns(const can_bus_model *self);

/* Let a node that is off the bus come back: it does after 128 sequences of 11 recessive bits from now_ns on. */
void can_bus_restart(can_bus_model *self, uint8_t node, uint64_t now_ns);

/* An event as a node tells it: an error frame with its counters and state. id: bits of enum can_bus_error. node:
 * present. out: not null. */
void can_bus_report(const can_bus_model *self, uint8_t node, uint32_t id, uint64_t time_ns, can_bus_frame *out);

/* Plan an error. False when there are too many. */
bool can_bus_disturb(can_bus_model *self, const can_bus_disturbance *disturbance);

/* Forget what is left of the planned errors of these frames. Returns how many. */
uint32_t can_bus_calm(can_bus_model *self, uint32_t id, uint8_t sender);

/* Bits of frames are wrong at random from here on. rate: probability per bit, 0 to below 1. */
void can_bus_set_bit_error_rate(can_bus_model *self, double rate, uint64_t seed);

/* Open a slot [start_ns, end_ns), a tick of the bench, for which busy time is counted. */
void can_bus_begin_slot(can_bus_model *self, uint64_t start_ns, uint64_t end_ns);

/* Close the slot: count its busy time, and what is not through. */
void can_bus_end_slot(can_bus_model *self);

#endif
