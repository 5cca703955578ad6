#include "space_drive/axis.h"

#include <math.h>

static float clamp(float value, float minimum, float maximum)
{
    return fminf(fmaxf(value, minimum), maximum);
}

static float position_of(const space_drive_axis_config *config, uint16_t counts)
{
    const float share = (float)counts / (float)config->counts_max;
    return config->position_at_zero + share * (config->position_at_max - config->position_at_zero);
}

uint16_t space_drive_axis_counts(const space_drive_axis_config *config, float position)
{
    const float share = (position - config->position_at_zero) / (config->position_at_max - config->position_at_zero);
    return (uint16_t)lroundf(clamp(share, 0.0f, 1.0f) * (float)config->counts_max);
}

void space_drive_axis_receive(space_drive_axis *self, const space_drive_axis_config *config, const can_frame *frame,
                              uint64_t now_us)
{
    if (config->counts_max == 0U) {
        return; /* an axis without a configuration never becomes ready */
    }
    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        space_drive_request_receive(&self->channels[i].request, frame, config->counts_max, config->bad_limit, now_us);
    }
}

/* A channel that can vote now: trusted, and its sensor reads. */
static bool can_vote(const space_drive_channel *channel)
{
    return channel->sensor_valid && !channel->excluded;
}

/* Read the sensors, vote on them and exclude the channels that have been wrong for too long. */
static void judge_sensors(space_drive_axis *self, const space_drive_axis_config *config,
                          const float sensors[SPACE_DRIVE_CHANNELS], uint64_t now_us)
{
    float positions[SPACE_DRIVE_CHANNELS];
    bool usable[SPACE_DRIVE_CHANNELS] = {false};

    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        space_drive_channel *channel = &self->channels[i];
        /* NaN fails both comparisons. */
        channel->sensor_valid = sensors[i] >= config->sensor_minimum && sensors[i] <= config->sensor_maximum;
        if (channel->sensor_valid) {
            channel->position = sensors[i];
        }
        positions[i] = channel->position;
        usable[i] = can_vote(channel);
    }

    const voter_ballot ballot = voter_vote(positions, usable, config->deviation);
    if (ballot.valid) {
        self->position = ballot.value;
    }

    uint32_t trusted = 0;
    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        space_drive_channel *channel = &self->channels[i];
        if (debounce_step(&channel->sensor_fault, !channel->sensor_valid, config->deviation_us, now_us)) {
            channel->sensor_failed = true;
        }
        if (debounce_step(&channel->disagreement, ballot.deviates[i], config->deviation_us, now_us)) {
            channel->implausible = true;
        }
        channel->excluded = channel->sensor_failed || channel->implausible;
        trusted += channel->excluded ? 0U : 1U;
    }
    self->failed = trusted < 2U;
}

/* What this channel alone would do. */
static float channel_demand(const space_drive_channel *channel, const space_drive_axis_config *config)
{
    if (channel->request.state == SPACE_DRIVE_REQUEST_WAITING) {
        return config->safe_demand_valid ? config->safe_demand : channel->position;
    }
    /* Lost requests leave the last good target standing; the emergency brake is the caller's reaction. */
    return clamp(position_of(config, channel->request.counts), channel->position - config->lead,
                 channel->position + config->lead);
}

static void vote_demand(space_drive_axis *self, const space_drive_axis_config *config)
{
    float demands[SPACE_DRIVE_CHANNELS];
    bool usable[SPACE_DRIVE_CHANNELS] = {false};
    uint32_t voters = 0;

    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        space_drive_channel *channel = &self->channels[i];
        usable[i] = can_vote(channel);
        if (usable[i]) {
            channel->demand = channel_demand(channel, config);
            voters++;
        }
        demands[i] = channel->demand;
    }
    const voter_ballot ballot = voter_vote(demands, usable, config->deviation);
    /* Of two demands that differ nobody knows the right one: the last agreed one stands. Both then deviate, so that it
     * takes two channels to see it of any pair. A median needs no such care. */
    const bool split = voters == 2U && (ballot.deviates[0] || ballot.deviates[1]);
    if (ballot.valid && !split) {
        self->demand = ballot.value;
        self->demand_valid = true;
    }
}

void space_drive_axis_step(space_drive_axis *self, const space_drive_axis_config *config,
                           const float sensors[SPACE_DRIVE_CHANNELS], uint64_t now_us)
{
    uint32_t known = 0;
    uint32_t fresh = 0;

    judge_sensors(self, config, sensors, now_us);
    for (uint32_t i = 0; i < SPACE_DRIVE_CHANNELS; i++) {
        space_drive_channel *channel = &self->channels[i];
        space_drive_request_age(&channel->request, config->timeout_us, now_us);
        known += channel->request.state == SPACE_DRIVE_REQUEST_WAITING ? 0U : 1U;
        fresh += channel->request.state == SPACE_DRIVE_REQUEST_FRESH && !channel->excluded ? 1U : 0U;
    }
    self->ready = known >= 2U;
    self->requests_lost = self->ready && !self->failed && fresh < 2U;
    vote_demand(self, config);
}
