/* simcan. Input: bit rates, then operations with their fields. */
#include "hil_tests/fuzz/fuzz_bytes.h"

#include "bridge/native/can_bus.h"

enum {
    ROOM = 8,
    EVENTS_MAX = 20000, /* of one input: an error at every bit would take for ever */
};

typedef struct run {
    can_bus_model bus;
    uint64_t now_ns;
    uint64_t last_us;
    uint32_t events;
} run;

static void work(run *self, uint64_t until_ns)
{
    can_bus_frame out[ROOM];
    uint32_t count = ROOM;
    while (count == ROOM && self->events < EVENTS_MAX) {
        count = can_bus_run(&self->bus, until_ns, out, ROOM);
        FUZZ_CHECK(count <= ROOM);
        self->events += count;
        for (uint32_t i = 0; i < count; i++) {
            FUZZ_CHECK(out[i].frame.time_us >= self->last_us);
            self->last_us = out[i].frame.time_us;
        }
    }
    self->now_ns = until_ns;
}

static void submit(run *self, uint8_t node, fuzz_bytes *in)
{
    can_bus_frame content = {0};
    const uint8_t shape = fuzz_u8(in);
    content.frame.flags = shape & 0x3FU;
    content.frame.id = fuzz_u32(in);
    content.frame.dlc = (shape & 0x80U) != 0U ? fuzz_u8(in) : 8U;
    fuzz_take(in, content.frame.data, sizeof content.frame.data);
    (void)can_bus_submit(&self->bus, node, &content, self->now_ns);
}

static void step(run *self, fuzz_bytes *in)
{
    const uint8_t kind = fuzz_u8(in);
    const uint8_t node = fuzz_u8(in);
    switch (kind % 9U) {
    case 0U:
        (void)can_bus_join(&self->bus, node, (kind / 9U) & 7U);
        break;
    case 1U:
        can_bus_leave(&self->bus, node);
        break;
    case 2U:
        can_bus_flush(&self->bus, node);
        break;
    case 3U:
    case 4U:
        submit(self, node, in);
        break;
    case 5U:
        work(self, self->now_ns + fuzz_u32(in) % 50000000U);
        break;
    case 6U:
        can_bus_restart(&self->bus, node, self->now_ns);
        break;
    case 7U: {
        can_bus_disturbance disturbance = {.sender = CAN_BUS_NOBODY, .receiver = node};
        disturbance.id = fuzz_u32(in);
        disturbance.mask = fuzz_u32(in);
        disturbance.count = fuzz_u8(in);
        disturbance.bit = fuzz_u16(in);
        (void)can_bus_disturb(&self->bus, &disturbance);
        break;
    }
    default:
        can_bus_begin_slot(&self->bus, self->now_ns, self->now_ns + 10000000U);
        work(self, self->now_ns + 10000000U);
        can_bus_end_slot(&self->bus);
        break;
    }
}

static void check(const run *self)
{
    uint32_t pending = 0U;
    for (uint32_t i = 0; i < CAN_BUS_NODES_MAX; i++) {
        const can_bus_node *node = &self->bus.nodes[i];
        FUZZ_CHECK(node->state <= CAN_BUS_OFF && node->pending_count <= CAN_BUS_PENDING_MAX);
        FUZZ_CHECK(node->state != CAN_BUS_ERROR_ACTIVE ||
                   (node->transmit_errors < 128U && node->receive_errors < 128U));
        pending += node->pending_count;
    }
    FUZZ_CHECK(pending <= CAN_BUS_PENDING_MAX && self->bus.free_count <= CAN_BUS_PENDING_MAX);
    FUZZ_CHECK(pending + self->bus.free_count <= CAN_BUS_PENDING_MAX);
    FUZZ_CHECK(self->bus.statistics.stuff_bits <= self->bus.statistics.bits);
    FUZZ_CHECK(can_bus_next_ns(&self->bus) > 0U || pending == 0U || self->now_ns == 0U);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const uint32_t rates[] = {500000U, 1000000U, 125000U, 2000000U, 8000000U, 0U, 333333U, 1000U};
    static run self;
    fuzz_bytes in = {data, size};
    const uint8_t rate = fuzz_u8(&in);
    memset(&self, 0, sizeof self);
    can_bus_init(&self.bus, rates[rate & 7U], rates[rate >> 3U & 7U]);
    if ((rate & 0x80U) != 0U) {
        can_bus_set_bit_error_rate(&self.bus, 1.0 / (1.0 + fuzz_u16(&in)), fuzz_u16(&in));
    }
    while (in.left > 0U && self.events < EVENTS_MAX) {
        step(&self, &in);
        check(&self);
    }
    return 0;
}
