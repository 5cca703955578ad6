#include "network.h"

#include <string.h>

#define STATION(name) (1U << CAN_STATION_##name)

/* The recorder sits on every bus and acknowledges, like a logger in the car: who is alone with it is heard. */
enum { RECORDER_NODE = CAN_STATION_COUNT };

/* Stations that have gone off a bus come back by themselves, as automotive CAN drivers are usually set up. */
static const uint64_t RESTART_NS = 100000000;

static const uint8_t MEMBERS[CAN_BUS_COUNT] = {
    [CAN_BUS_1] = STATION(OBC) | STATION(RAPTOR),
    [CAN_BUS_3] = STATION(RAPTOR) | STATION(SPACE_DRIVE),
    [CAN_BUS_A] = STATION(AUTONOMY) | STATION(OPERATOR) | STATION(OBC),
    [CAN_BUS_S] = STATION(SENSORS) | STATION(AUTONOMY) | STATION(OBC),
    [CAN_BUS_R] = STATION(SENSORS) | STATION(AUTONOMY),
};

void network_init(network *self, const uint32_t bit_rates[CAN_BUS_COUNT])
{
    memset(self, 0, sizeof *self);
    memcpy(self->members, MEMBERS, sizeof MEMBERS);
    for (uint32_t bus = 0; bus < CAN_BUS_COUNT; bus++) {
        can_bus_init(&self->buses[bus], bit_rates[bus], bit_rates[bus]);
        for (uint8_t node = 0; node <= RECORDER_NODE; node++) {
            (void)can_bus_join(&self->buses[bus], node, 0);
            self->buses[bus].nodes[node].restart_ns = RESTART_NS;
        }
    }
}

void network_begin_slot(network *self, uint64_t start_us, uint64_t end_us)
{
    self->slot_start_ns = start_us * 1000U;
    self->slot_end_ns = end_us * 1000U;
    for (uint32_t bus = 0; bus < CAN_BUS_COUNT; bus++) {
        can_bus_begin_slot(&self->buses[bus], self->slot_start_ns, self->slot_end_ns);
    }
}

void network_end_slot(network *self)
{
    for (uint32_t bus = 0; bus < CAN_BUS_COUNT; bus++) {
        can_bus_end_slot(&self->buses[bus]);
    }
    self->slot_start_ns = self->slot_end_ns; /* what is submitted between slots has time to start at the next one */
}

static void queue(network *self, uint8_t station, const can_frame *frame)
{
    if (frame->bus >= CAN_BUS_COUNT) {
        self->misaddressed++;
        return;
    }
    can_bus_model *bus = &self->buses[frame->bus];
    /* A station that ticks later in the slot does so when what it has heard is through. */
    const uint64_t now_ns = bus->free_ns > self->slot_start_ns ? bus->free_ns : self->slot_start_ns;
    self->scratch[0].frame = *frame;
    (void)can_bus_submit(bus, station, &self->scratch[0], now_ns); /* the bus counts what it refuses */
}

void network_submit(network *self, uint8_t station, const can_frame *frames, uint32_t count)
{
    if (!self->diverting) {
        for (uint32_t i = 0; i < count; i++) {
            queue(self, station, &frames[i]);
        }
        return;
    }
    for (uint32_t i = 0; i < count; i++) {
        if (self->diverted_count == NETWORK_DIVERTED_MAX) {
            self->diverted_lost++;
            continue;
        }
        can_frame *held = &self->diverted[self->diverted_count++];
        *held = frames[i];
        held->sender = station;
    }
}

void network_forward(network *self, const can_frame *frames, uint32_t count)
{
    for (uint32_t i = 0; i < count; i++) {
        queue(self, frames[i].sender, &frames[i]);
    }
}

static void deliver(network *self, const can_frame *frame)
{
    for (uint32_t station = 0; station < CAN_STATION_COUNT; station++) {
        if ((self->members[frame->bus] >> station & 1U) == 0 || station == frame->sender) {
            continue;
        }
        network_inbox *inbox = &self->inboxes[station];
        if (inbox->count < NETWORK_INBOX_MAX) {
            inbox->frames[inbox->count++] = *frame;
        } else {
            inbox->lost++;
        }
    }
    for (uint32_t i = 0; i < self->watch_count; i++) {
        network_watch *watch = &self->watches[i];
        if (watch->frame.id == frame->id && watch->frame.bus == frame->bus && frame->flags == 0) {
            watch->frame = *frame;
            watch->updates++;
        }
    }
    if (self->log_count < NETWORK_LOG_MAX) {
        self->log[self->log_count++] = *frame;
    } else {
        self->log_lost++;
    }
}

void network_transmit(network *self, uint8_t bus)
{
    if (bus >= CAN_BUS_COUNT) {
        return;
    }
    uint32_t count;
    do {
        count = can_bus_run(&self->buses[bus], self->slot_end_ns, self->scratch, NETWORK_SCRATCH_MAX);
        for (uint32_t i = 0; i < count; i++) {
            self->scratch[i].frame.bus = bus;
            deliver(self, &self->scratch[i].frame);
        }
    } while (count == NETWORK_SCRATCH_MAX);
}

void network_clear_inbox(network *self, uint8_t station)
{
    if (station < CAN_STATION_COUNT) {
        self->inboxes[station].count = 0;
    }
}

uint32_t network_add_watch(network *self, uint8_t bus, uint32_t id)
{
    if (self->watch_count == NETWORK_WATCH_MAX) {
        return NETWORK_WATCH_MAX;
    }
    network_watch *watch = &self->watches[self->watch_count];
    watch->frame.bus = bus;
    watch->frame.id = id;
    return self->watch_count++;
}
