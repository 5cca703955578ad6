#include "can_bus.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

enum {
    ERROR_FLAG_BITS = 6,
    ERROR_ECHO_BITS = 6, /* flags of the other nodes, which begin when the first one ends at the latest */
    ERROR_DELIMITER_BITS = 8,
    SUSPEND_BITS = 8, /* an error-passive sender waits so long before it sends again */
    END_OF_FRAME_BITS = 7,
    ACK_BITS = 2,       /* slot and delimiter */
    RECOVERY_BITS = 11, /* recessive bits of one sequence */
    RECOVERY_COUNT = 128,
    WARNING_LIMIT = 96,
    PASSIVE_LIMIT = 128,
    OFF_LIMIT = 256,
    TRANSMIT_ERROR = 8,
    FD_BIT = 14, /* from the start of frame: where a frame of 11 bits says that it is FD */
    FD_BIT_EXTENDED = 33,
    PROTOCOL_BIT = 0x01,
    PROTOCOL_FORM = 0x02,
    PROTOCOL_SENDING = 0x80,
};

static uint64_t later(uint64_t one, uint64_t other)
{
    return one > other ? one : other;
}

/* Place of the lowest bit of a mask that is not 0: loops over nodes go from bit to bit, since mostly few are set. */
static uint8_t lowest(uint32_t mask)
{
    return (uint8_t)__builtin_ctz(mask);
}

static uint32_t bit_of(uint8_t node)
{
    return UINT32_C(1) << node;
}

static bool takes_part(const can_bus_node *node)
{
    return (node->state == CAN_BUS_ERROR_ACTIVE || node->state == CAN_BUS_ERROR_PASSIVE) &&
           (node->mode & CAN_BUS_LISTEN_ONLY) == 0;
}

static uint32_t bit_time(uint32_t rate, uint32_t highest)
{
    return rate >= 1000U && rate <= highest && 1000000000U % rate == 0 ? 1000000000U / rate : 0U;
}

void can_bus_init(can_bus_model *self, uint32_t bit_rate, uint32_t data_bit_rate)
{
    memset(self, 0, sizeof *self);
    can_wire_init(&self->wire);
    self->bit_ns = bit_time(bit_rate, 1000000U);
    self->data_bit_ns = bit_time(data_bit_rate, 8000000U);
    if (self->data_bit_ns == 0) {
        self->data_bit_ns = self->bit_ns;
    }
    while (self->free_count < CAN_BUS_PENDING_MAX) {
        self->free_slots[self->free_count] = self->free_count;
        self->free_count++;
    }
}

bool can_bus_join(can_bus_model *self, uint8_t node, uint8_t mode)
{
    if (node >= CAN_BUS_NODES_MAX || self->nodes[node].state != CAN_BUS_ABSENT || self->nodes[node].pending_count > 0) {
        return false;
    }
    self->nodes[node] = (can_bus_node){.state = CAN_BUS_ERROR_ACTIVE, .mode = mode, .sending = CAN_BUS_NO_SLOT};
    if (self->node_count <= node) {
        self->node_count = (uint8_t)(node + 1U);
    }
    return true;
}

static void release_slot(can_bus_model *self, uint16_t slot)
{
    self->free_slots[self->free_count] = slot;
    self->free_count++;
}

/* Throw the queue of a node away, but for what is on the wire. */
static void cancel(can_bus_model *self, uint8_t index)
{
    can_bus_node *node = &self->nodes[index];
    uint16_t kept = 0;
    for (uint16_t i = 0; i < node->pending_count; i++) {
        if (node->pending[i] == node->sending) {
            node->pending[kept] = node->sending;
            kept++;
        } else {
            release_slot(self, node->pending[i]);
            node->cancelled++;
        }
    }
    node->pending_count = kept;
    if (kept == 0) {
        self->waiting &= ~bit_of(index);
    }
}

void can_bus_flush(can_bus_model *self, uint8_t node)
{
    if (node < CAN_BUS_NODES_MAX) {
        cancel(self, node);
    }
}

void can_bus_leave(can_bus_model *self, uint8_t node)
{
    can_bus_flush(self, node);
    if (node < CAN_BUS_NODES_MAX) {
        self->nodes[node].state = CAN_BUS_ABSENT;
        self->off &= ~bit_of(node);
        self->counting &= ~bit_of(node);
    }
}

/* Copy a frame; a classic one has nothing behind its first 8 bytes. */
static void copy(can_bus_frame *to, const can_bus_frame *from)
{
    to->frame = from->frame;
    if ((from->frame.flags & CAN_WIRE_FLAG_FD) != 0) {
        memcpy(to->more, from->more, sizeof to->more);
    }
}

bool can_bus_submit(can_bus_model *self, uint8_t node_index, const can_bus_frame *content, uint64_t now_ns)
{
    can_bus_node *node = node_index < self->node_count ? &self->nodes[node_index] : NULL;
    if (node == NULL || !takes_part(node) || self->free_count == 0) {
        self->statistics.lost++;
        return false;
    }
    self->free_count--;
    const uint16_t index = self->free_slots[self->free_count];
    can_bus_slot *slot = &self->slots[index];
    copy(&slot->content, content);
    slot->content.frame.sender = node_index;
    slot->release_ns = now_ns;
    const uint64_t arbitration = (node->mode & CAN_BUS_FIFO) != 0 ? 0U : can_wire_arbitration(&content->frame);
    slot->rank = arbitration << 32 | (self->sequence & UINT32_MAX);
    self->sequence++;
    uint16_t place = node->pending_count;
    while (place > 0 && self->slots[node->pending[place - 1U]].rank < slot->rank) {
        place--;
    }
    memmove(&node->pending[place + 1U], &node->pending[place],
            (size_t)(node->pending_count - place) * sizeof node->pending[0]);
    node->pending[place] = index;
    node->pending_count++;
    self->waiting |= bit_of(node_index);
    return true;
}

/* The frame that a node would send at a time: the best one that is there by then, or CAN_BUS_NO_SLOT. */
static uint16_t candidate(const can_bus_model *self, const can_bus_node *node, uint64_t time_ns)
{
    if (!takes_part(node) || node->ready_ns > time_ns) {
        return CAN_BUS_NO_SLOT;
    }
    for (uint16_t place = node->pending_count; place > 0; place--) {
        const uint16_t slot = node->pending[place - 1U];
        if (self->slots[slot].release_ns <= time_ns) {
            return slot;
        }
    }
    return CAN_BUS_NO_SLOT;
}

/* Since when a node that is off the bus has seen nothing but recessive bits: an end of frame has 11 of them. */
static uint64_t quiet_since_ns(const can_bus_model *self, const can_bus_node *node)
{
    const uint64_t tail_ns = (uint64_t)RECOVERY_BITS * self->bit_ns;
    return later(self->free_ns > tail_ns ? self->free_ns - tail_ns : 0U, node->ready_ns);
}

/* When a node has recovered from bus-off, if nothing is sent until then. */
static uint64_t recovered_ns(const can_bus_model *self, const can_bus_node *node)
{
    return quiet_since_ns(self, node) + (uint64_t)node->recovery_left * RECOVERY_BITS * self->bit_ns;
}

/* First time at which a node can start to send; UINT64_MAX for none. */
static uint64_t earliest_ns(const can_bus_model *self, const can_bus_node *node)
{
    if (!takes_part(node)) {
        return UINT64_MAX;
    }
    const uint64_t ready_ns = later(self->free_ns, node->ready_ns);
    /* Nearly always the best one is there already. */
    if (self->slots[node->pending[node->pending_count - 1U]].release_ns <= ready_ns) {
        return ready_ns;
    }
    uint64_t first_ns = UINT64_MAX;
    for (uint16_t i = 0; i < node->pending_count; i++) {
        const uint64_t release_ns = self->slots[node->pending[i]].release_ns;
        first_ns = release_ns < first_ns ? release_ns : first_ns;
    }
    return later(first_ns, ready_ns);
}

static bool recovering(const can_bus_node *node)
{
    return node->state == CAN_BUS_OFF && node->ready_ns != UINT64_MAX;
}

/* Next start of a transmission, or of a node that comes back. */
static uint64_t next_start_ns(const can_bus_model *self)
{
    uint64_t next_ns = UINT64_MAX;
    for (uint32_t left = self->waiting; left != 0; left &= left - 1U) {
        const uint64_t time_ns = earliest_ns(self, &self->nodes[lowest(left)]);
        next_ns = time_ns < next_ns ? time_ns : next_ns;
    }
    for (uint32_t left = self->off; left != 0; left &= left - 1U) {
        const can_bus_node *node = &self->nodes[lowest(left)];
        if (recovering(node) && recovered_ns(self, node) < next_ns) {
            next_ns = recovered_ns(self, node);
        }
    }
    return next_ns;
}

uint64_t can_bus_next_ns(const can_bus_model *self)
{
    if (self->bit_ns == 0) {
        return UINT64_MAX;
    }
    if (self->wire_now.active) {
        return self->wire_now.end_ns;
    }
    return next_start_ns(self);
}

static bool same_content(const can_bus_frame *one, const can_bus_frame *other)
{
    if (one->frame.dlc != other->frame.dlc || one->frame.flags != other->frame.flags) {
        return false;
    }
    const uint32_t length = one->frame.dlc < CAN_WIRE_FD_DATA_MAX ? one->frame.dlc : CAN_WIRE_FD_DATA_MAX;
    const uint32_t first = length < CAN_DATA_MAX ? length : CAN_DATA_MAX;
    if (memcmp(one->frame.data, other->frame.data, first) != 0) {
        return false;
    }
    return length <= CAN_DATA_MAX || memcmp(one->more, other->more, length - CAN_DATA_MAX) == 0;
}

/* Two nodes send different frames of one identifier: the bit at which they differ, to the byte and without stuffing. */
static uint32_t collision_bit(const can_bus_frame *one, const can_bus_frame *other)
{
    const uint32_t header = (one->frame.flags & CAN_FLAG_EXTENDED) != 0 ? 39U : 19U;
    uint32_t bytes = 0;
    while (one->frame.dlc == other->frame.dlc && one->frame.flags == other->frame.flags && bytes < CAN_DATA_MAX &&
           one->frame.data[bytes] == other->frame.data[bytes]) {
        bytes++;
    }
    return header + 8U * bytes;
}

/* Plan of a transmission: where it breaks off, if it does. */
typedef struct outcome {
    bool destroyed;
    uint32_t bit;
    uint16_t cause;
    uint8_t first_error;
} outcome;

static double uniform(uint64_t *state) /* xorshift64*, Marsaglia 2003, Vigna 2016; above 0, at most 1 */
{
    uint64_t x = *state;
    x ^= x >> 12;
    x ^= x << 25;
    x ^= x >> 27;
    *state = x;
    return ((double)((x * UINT64_C(2685821657736338717)) >> 11) + 1.0) * 0x1p-53;
}

static uint64_t draw_error_gap(can_bus_model *self)
{
    const double bits = log(uniform(&self->random)) / log1p(-self->bit_error_rate); /* geometric */
    return bits < 1e18 ? (uint64_t)bits : UINT64_C(1000000000000000000);
}

void can_bus_set_bit_error_rate(can_bus_model *self, double rate, uint64_t seed)
{
    self->bit_error_rate = rate > 0.0 && rate < 1.0 ? rate : 0.0;
    self->random = seed * UINT64_C(0x9E3779B97F4A7C15) + 1U;
    if (self->random == 0) {
        self->random = 1;
    }
    self->bits_to_error = self->bit_error_rate > 0.0 ? draw_error_gap(self) : 0U;
}

bool can_bus_disturb(can_bus_model *self, const can_bus_disturbance *disturbance)
{
    if (self->disturbance_count == CAN_BUS_DISTURBANCES_MAX) {
        return false;
    }
    self->disturbances[self->disturbance_count] = *disturbance;
    self->disturbance_count++;
    return true;
}

uint32_t can_bus_calm(can_bus_model *self, uint32_t id, uint8_t sender)
{
    uint32_t left = 0;
    uint32_t kept = 0;
    for (uint32_t i = 0; i < self->disturbance_count; i++) {
        const can_bus_disturbance *one = &self->disturbances[i];
        if (one->id == id && one->sender == sender) {
            left += one->count;
        } else {
            self->disturbances[kept++] = *one;
        }
    }
    self->disturbance_count = kept;
    return left;
}

/* Use up the first planned error that a frame matches. */
static bool planned_error(can_bus_model *self, const can_frame *frame, uint32_t frame_bits, outcome *result)
{
    for (uint32_t i = 0; i < self->disturbance_count; i++) {
        can_bus_disturbance *one = &self->disturbances[i];
        const bool matches = ((frame->id ^ one->id) & one->mask) == 0 &&
                             (one->sender == CAN_BUS_NOBODY || one->sender == frame->sender) && one->count > 0;
        if (!matches) {
            continue;
        }
        const bool local = one->receiver != CAN_BUS_NOBODY && one->receiver != frame->sender &&
                           one->receiver < CAN_BUS_NODES_MAX && takes_part(&self->nodes[one->receiver]);
        *result = (outcome){.destroyed = true, .bit = one->bit, .cause = CAN_BUS_ERROR_PROTOCOL, CAN_BUS_NOBODY};
        if (local) { /* it has the checksum by then, and speaks up behind the acknowledge delimiter */
            result->first_error = one->receiver;
            result->bit = frame_bits - END_OF_FRAME_BITS - 1U;
        }
        one->count--;
        if (one->count == 0) {
            self->disturbance_count--;
            memmove(one, one + 1, (self->disturbance_count - i) * sizeof *one);
        }
        return true;
    }
    return false;
}

static bool random_error(can_bus_model *self, uint32_t frame_bits, outcome *result)
{
    if (self->bit_error_rate <= 0.0) {
        return false;
    }
    if (self->bits_to_error >= frame_bits) {
        self->bits_to_error -= frame_bits;
        return false;
    }
    *result = (outcome){.destroyed = true,
                        .bit = (uint32_t)self->bits_to_error,
                        .cause = CAN_BUS_ERROR_PROTOCOL,
                        .first_error = CAN_BUS_NOBODY};
    self->bits_to_error = draw_error_gap(self);
    return true;
}

/* Whether somebody other than the senders is there. classic: only who does not know FD. */
static bool others(const can_bus_model *self, uint32_t senders, bool classic)
{
    for (uint32_t i = 0; i < self->node_count; i++) {
        const can_bus_node *node = &self->nodes[i];
        if ((senders >> i & 1U) == 0 && takes_part(node) && (!classic || (node->mode & CAN_BUS_CLASSIC) != 0)) {
            return true;
        }
    }
    return false;
}

/* Put the winner's frame onto the wire; nodes that send the same identifier have theirs marked already.
 * collision: bit at which their frames differ, or 0. */
static void start(can_bus_model *self, uint64_t start_ns, uint8_t winner, uint32_t senders, uint32_t collision)
{
    const can_bus_frame *content = &self->slots[self->nodes[winner].sending].content;
    const bool fd = (content->frame.flags & CAN_WIRE_FLAG_FD) != 0;
    can_bus_transmission *now = &self->wire_now;
    *now = (can_bus_transmission){
        .active = true, .winner = winner, .senders = senders, .start_ns = start_ns, .first_error = CAN_BUS_NOBODY};
    can_wire_fd_length length = {0};
    if (fd) {
        length = can_wire_fd_bits(&self->wire, &content->frame, content->more);
        now->stuff_bits = length.stuff;
    } else {
        length.head = can_wire_bits(&self->wire, &content->frame, &now->stuff_bits);
    }
    const uint32_t frame_bits = length.head + length.fast + length.tail;
    const uint32_t fast_bit_ns = (content->frame.flags & CAN_WIRE_FLAG_BRS) != 0 ? self->data_bit_ns : self->bit_ns;
    outcome planned = {.first_error = CAN_BUS_NOBODY};
    if (collision > 0) {
        planned = (outcome){.destroyed = true, .bit = collision, .cause = CAN_BUS_ERROR_PROTOCOL, CAN_BUS_NOBODY};
    } else if ((content->frame.flags & CAN_FLAG_ERROR) != 0) {
        /* a node that signals an error where there is none */
    } else if (fd && others(self, senders, true)) {
        const bool extended = (content->frame.flags & CAN_FLAG_EXTENDED) != 0;
        planned = (outcome){.destroyed = true,
                            .bit = extended ? FD_BIT_EXTENDED : FD_BIT,
                            .cause = CAN_BUS_ERROR_PROTOCOL,
                            .first_error = CAN_BUS_NOBODY};
    } else if (!planned_error(self, &content->frame, frame_bits, &planned) &&
               !random_error(self, frame_bits, &planned) && !others(self, senders, false)) {
        planned = (outcome){.destroyed = true,
                            .bit = frame_bits - END_OF_FRAME_BITS - ACK_BITS,
                            .cause = CAN_BUS_ERROR_NO_ACK,
                            .first_error = CAN_BUS_NOBODY};
    }
    uint64_t duration_ns = (uint64_t)(length.head + length.tail) * self->bit_ns + (uint64_t)length.fast * fast_bit_ns;
    now->bits = frame_bits;
    if (planned.destroyed) {
        const uint32_t bit = planned.bit + 1U < frame_bits ? planned.bit + 1U : frame_bits;
        const uint32_t slow = bit < length.head ? bit : length.head;
        const uint32_t fast = bit - slow < length.fast ? bit - slow : length.fast;
        const uint32_t echo = others(self, senders, false) ? ERROR_ECHO_BITS : 0U;
        const uint32_t error_bits = ERROR_FLAG_BITS + echo + ERROR_DELIMITER_BITS;
        duration_ns = (uint64_t)(bit - fast + error_bits) * self->bit_ns + (uint64_t)fast * fast_bit_ns;
        now->bits = bit + error_bits;
        now->stuff_bits = 0;
        now->destroyed = true;
        now->cause = planned.cause;
        now->first_error = planned.first_error;
    }
    now->bits += CAN_WIRE_INTERFRAME_BITS;
    now->end_ns = start_ns + duration_ns;
    now->free_ns = now->end_ns + (uint64_t)CAN_WIRE_INTERFRAME_BITS * self->bit_ns;
}

/* Arbitration at start_ns: who sends, at least one. */
static void arbitrate(can_bus_model *self, uint64_t start_ns)
{
    uint8_t winner = CAN_BUS_NOBODY;
    uint32_t best = 0;
    uint32_t senders = 0;
    for (uint32_t left = self->waiting; left != 0; left &= left - 1U) {
        const uint8_t i = lowest(left);
        can_bus_node *node = &self->nodes[i];
        node->sending = candidate(self, node, start_ns);
        if (node->sending == CAN_BUS_NO_SLOT) {
            continue;
        }
        const uint32_t arbitration = can_wire_arbitration(&self->slots[node->sending].content.frame);
        if (winner == CAN_BUS_NOBODY || arbitration < best) {
            winner = i;
            best = arbitration;
            senders = 0;
        }
        senders |= arbitration == best ? bit_of(i) : 0U;
    }
    uint32_t collision = 0;
    for (uint32_t left = self->waiting; left != 0; left &= left - 1U) {
        const uint8_t i = lowest(left);
        can_bus_node *node = &self->nodes[i];
        if ((senders & bit_of(i)) == 0) {
            node->sending = CAN_BUS_NO_SLOT;
        } else if (i != winner) {
            const can_bus_frame *one = &self->slots[self->nodes[winner].sending].content;
            const can_bus_frame *other = &self->slots[node->sending].content;
            collision = same_content(one, other) ? collision : collision_bit(one, other);
        }
    }
    if (winner != CAN_BUS_NOBODY) {
        start(self, start_ns, winner, senders, collision);
    }
}

/* The bus goes from idle to busy: those who are off it count the sequences of recessive bits that are over. */
static void count_recessive(can_bus_model *self, uint64_t now_ns)
{
    for (uint32_t left = self->off; left != 0; left &= left - 1U) {
        can_bus_node *node = &self->nodes[lowest(left)];
        if (recovering(node) && now_ns > quiet_since_ns(self, node)) {
            const uint64_t over = (now_ns - quiet_since_ns(self, node)) / ((uint64_t)RECOVERY_BITS * self->bit_ns);
            node->recovery_left = (uint16_t)(over < node->recovery_left ? node->recovery_left - over : 0U);
        }
    }
}

static bool own_state(const can_bus_node *node, uint8_t *controller)
{
    const bool warned = node->transmit_errors >= WARNING_LIMIT || node->receive_errors >= WARNING_LIMIT;
    *controller = 0;
    if (node->transmit_errors >= PASSIVE_LIMIT) {
        *controller |= CAN_BUS_PASSIVE_SEND;
    } else if (node->transmit_errors >= WARNING_LIMIT) {
        *controller |= CAN_BUS_WARNING_SEND;
    }
    if (node->receive_errors >= PASSIVE_LIMIT) {
        *controller |= CAN_BUS_PASSIVE_RECEIVE;
    } else if (node->receive_errors >= WARNING_LIMIT) {
        *controller |= CAN_BUS_WARNING_RECEIVE;
    }
    return warned;
}

void can_bus_report(const can_bus_model *self, uint8_t index, uint32_t id, uint64_t time_ns, can_bus_frame *out)
{
    const can_bus_node *node = &self->nodes[index];
    memset(out, 0, sizeof *out);
    out->frame.time_us = time_ns / 1000U;
    out->frame.id = id | CAN_BUS_ERROR_COUNTERS;
    out->frame.flags = CAN_FLAG_ERROR;
    out->frame.sender = index;
    out->frame.dlc = CAN_DATA_MAX;
    uint8_t controller;
    if (own_state(node, &controller)) {
        out->frame.id |= CAN_BUS_ERROR_CONTROLLER;
        out->frame.data[1] = controller;
    }
    out->frame.data[6] = (uint8_t)(node->transmit_errors < 255U ? node->transmit_errors : 255U);
    out->frame.data[7] = (uint8_t)(node->receive_errors < 255U ? node->receive_errors : 255U);
}

/* State and masks follow from the counters of a node that is on the bus. */
static void settle_state(can_bus_model *self, uint8_t index)
{
    can_bus_node *node = &self->nodes[index];
    if (!takes_part(node)) {
        return;
    }
    const bool passive = node->transmit_errors >= PASSIVE_LIMIT || node->receive_errors >= PASSIVE_LIMIT;
    node->state = passive ? CAN_BUS_ERROR_PASSIVE : CAN_BUS_ERROR_ACTIVE;
    if (node->transmit_errors > 0 || node->receive_errors > 0) {
        self->counting |= bit_of(index);
    } else {
        self->counting &= ~bit_of(index);
    }
}

static void count_transmit_error(can_bus_model *self, uint8_t index, uint16_t cause, uint64_t time_ns)
{
    can_bus_node *node = &self->nodes[index];
    /* A passive sender that nobody acknowledges may be alone: it does not count itself off the bus. */
    if (cause == CAN_BUS_ERROR_NO_ACK && node->state == CAN_BUS_ERROR_PASSIVE) {
        return;
    }
    node->transmit_errors = (uint16_t)(node->transmit_errors + TRANSMIT_ERROR);
    if (node->transmit_errors >= OFF_LIMIT) {
        cancel(self, index);
        node->state = CAN_BUS_OFF;
        self->off |= bit_of(index);
        self->counting &= ~bit_of(index);
        node->recovery_left = RECOVERY_COUNT;
        node->ready_ns = node->restart_ns > 0 ? time_ns + node->restart_ns : UINT64_MAX;
    }
}

static void count_receive_error(can_bus_node *node, uint16_t errors)
{
    node->receive_errors = (uint16_t)(node->receive_errors + errors);
    if (node->receive_errors > 255U) {
        node->receive_errors = 255U;
    }
}

static can_bus_message *message_row(can_bus_model *self, const can_frame *frame)
{
    const bool extended = (frame->flags & CAN_FLAG_EXTENDED) != 0;
    uint32_t place = ((frame->id ^ (extended ? 0x55555555U : 0U)) * UINT32_C(2654435769)) >> 24;
    for (uint32_t i = 0; i < CAN_BUS_MESSAGES_MAX; i++) {
        can_bus_message *row = &self->messages[(place + i) % CAN_BUS_MESSAGES_MAX];
        if (row->frames == 0) {
            row->id = frame->id;
            row->extended = extended;
            return row;
        }
        if (row->id == frame->id && row->extended == extended) {
            return row;
        }
    }
    return NULL; /* more identifiers than are followed */
}

/* A frame has gone through: take it out of the queue of its node. */
static void take_out(can_bus_model *self, uint8_t index)
{
    can_bus_node *node = &self->nodes[index];
    uint16_t place = node->pending_count;
    while (place > 0 && node->pending[place - 1U] != node->sending) {
        place--;
    }
    if (place > 0) {
        memmove(&node->pending[place - 1U], &node->pending[place],
                (size_t)(node->pending_count - place) * sizeof node->pending[0]);
        node->pending_count--;
        release_slot(self, node->sending);
    }
    if (node->pending_count == 0) {
        self->waiting &= ~bit_of(index);
    }
    node->sending = CAN_BUS_NO_SLOT;
}

/* What an end of transmission leaves in a sender: who is passive waits, and who has left has nothing to send. */
static void settle_sender(can_bus_model *self, uint8_t index)
{
    can_bus_node *node = &self->nodes[index];
    settle_state(self, index);
    if (node->state == CAN_BUS_ERROR_PASSIVE) {
        node->ready_ns = self->wire_now.free_ns + (uint64_t)SUSPEND_BITS * self->bit_ns;
    } else if (node->state == CAN_BUS_ABSENT) {
        cancel(self, index);
    }
}

static void finish_sent(can_bus_model *self, can_bus_frame *out)
{
    const can_bus_transmission *now = &self->wire_now;
    const can_bus_slot *slot = &self->slots[self->nodes[now->winner].sending];
    copy(out, &slot->content);
    out->frame.time_us = now->end_ns / 1000U;
    self->statistics.frames++;
    can_bus_message *row = (out->frame.flags & CAN_FLAG_ERROR) != 0 ? NULL : message_row(self, &out->frame);
    if (row != NULL) {
        const uint64_t queueing_ns = now->start_ns - slot->release_ns;
        row->frames++;
        row->total_queueing_ns += queueing_ns;
        row->worst_queueing_ns = later(row->worst_queueing_ns, queueing_ns);
        row->worst_response_ns = later(row->worst_response_ns, now->end_ns - slot->release_ns);
    }
    for (uint32_t left = now->senders; left != 0; left &= left - 1U) {
        const uint8_t i = lowest(left);
        can_bus_node *node = &self->nodes[i];
        take_out(self, i);
        node->transmit_errors = node->transmit_errors > 0 ? (uint16_t)(node->transmit_errors - 1U) : 0U;
        settle_sender(self, i);
    }
    for (uint32_t left = self->counting & ~now->senders; left != 0; left &= left - 1U) {
        const uint8_t i = lowest(left);
        can_bus_node *node = &self->nodes[i];
        if (node->receive_errors >= PASSIVE_LIMIT) {
            node->receive_errors = PASSIVE_LIMIT - 1U;
        } else if (node->receive_errors > 0) {
            node->receive_errors--;
        }
        settle_state(self, i);
    }
}

static void finish_destroyed(can_bus_model *self, can_bus_frame *out)
{
    const can_bus_transmission *now = &self->wire_now;
    self->statistics.errors++;
    for (uint8_t i = 0; i < self->node_count; i++) {
        can_bus_node *node = &self->nodes[i];
        if ((now->senders >> i & 1U) != 0) {
            node->sending = CAN_BUS_NO_SLOT;
            if (node->state != CAN_BUS_ABSENT) {
                count_transmit_error(self, i, now->cause, now->free_ns);
            }
            settle_sender(self, i);
        } else if (takes_part(node)) {
            /* Who saw the error first finds a dominant bit behind its flag: the echo of the others. */
            count_receive_error(node, i == now->first_error ? 1U + TRANSMIT_ERROR : 1U);
            settle_state(self, i);
        }
    }
    const bool off = self->nodes[now->winner].state == CAN_BUS_OFF;
    can_bus_report(self, now->winner, now->cause | CAN_BUS_ERROR_ON_WIRE | (off ? CAN_BUS_ERROR_OFF : 0U), now->end_ns,
                   out);
    if (now->cause == CAN_BUS_ERROR_PROTOCOL) {
        out->frame.data[2] = PROTOCOL_SENDING | (now->first_error != CAN_BUS_NOBODY ? PROTOCOL_FORM : PROTOCOL_BIT);
    }
}

/* Busy time of what was on the wire, as far as it lies in the open slot. */
static void count_busy(can_bus_model *self, uint64_t from_ns, uint64_t to_ns)
{
    const uint64_t begin_ns = later(from_ns, self->slot_start_ns);
    const uint64_t end_ns = to_ns < self->slot_end_ns ? to_ns : self->slot_end_ns;
    self->slot_busy_ns += end_ns > begin_ns ? end_ns - begin_ns : 0U;
}

static void finish(can_bus_model *self, can_bus_frame *out)
{
    can_bus_transmission *now = &self->wire_now;
    if (now->destroyed) {
        finish_destroyed(self, out);
    } else {
        finish_sent(self, out);
    }
    now->active = false;
    count_busy(self, now->start_ns, now->free_ns);
    self->free_ns = now->free_ns;
    self->statistics.bits += now->bits;
    self->statistics.stuff_bits += now->stuff_bits;
    self->statistics.busy_ns += now->free_ns - now->start_ns;
}

/* A node whose recovery is over at a time, or CAN_BUS_NOBODY. */
static uint8_t recovered_at(const can_bus_model *self, uint64_t time_ns)
{
    for (uint32_t left = self->off; left != 0; left &= left - 1U) {
        const uint8_t i = lowest(left);
        if (recovering(&self->nodes[i]) && recovered_ns(self, &self->nodes[i]) <= time_ns) {
            return i;
        }
    }
    return CAN_BUS_NOBODY;
}

uint32_t can_bus_run(can_bus_model *self, uint64_t until_ns, can_bus_frame *out, uint32_t capacity)
{
    uint32_t count = 0;
    while (count < capacity && self->bit_ns > 0) {
        if (self->wire_now.active) {
            if (self->wire_now.end_ns >= until_ns) {
                break;
            }
            finish(self, &out[count]);
            count++;
            continue;
        }
        const uint64_t next_ns = next_start_ns(self);
        if (next_ns >= until_ns) {
            break;
        }
        const uint8_t back = recovered_at(self, next_ns);
        if (back != CAN_BUS_NOBODY) {
            self->nodes[back].state = CAN_BUS_ERROR_ACTIVE;
            self->off &= ~bit_of(back);
            self->nodes[back].transmit_errors = 0;
            self->nodes[back].receive_errors = 0;
            self->nodes[back].ready_ns = next_ns;
            can_bus_report(self, back, CAN_BUS_ERROR_RESTARTED, next_ns, &out[count]);
            count++;
        } else {
            count_recessive(self, next_ns);
            arbitrate(self, next_ns);
        }
    }
    return count;
}

void can_bus_restart(can_bus_model *self, uint8_t node, uint64_t now_ns)
{
    if (node < CAN_BUS_NODES_MAX && self->nodes[node].state == CAN_BUS_OFF && !recovering(&self->nodes[node])) {
        self->nodes[node].ready_ns = later(self->free_ns, now_ns);
    }
}

void can_bus_begin_slot(can_bus_model *self, uint64_t start_ns, uint64_t end_ns)
{
    self->slot_start_ns = start_ns;
    self->slot_end_ns = end_ns;
    self->slot_busy_ns = 0;
}

void can_bus_end_slot(can_bus_model *self)
{
    uint32_t pending = 0;
    for (uint32_t i = 0; i < self->node_count; i++) {
        pending += self->nodes[i].pending_count;
    }
    self->statistics.deferred += pending;
    if (self->wire_now.active) {
        count_busy(self, self->wire_now.start_ns, self->slot_end_ns);
    }
    self->statistics.busiest_slot_ns = later(self->statistics.busiest_slot_ns, self->slot_busy_ns);
}
