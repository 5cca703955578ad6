#include "obc/node_monitor.h"

#include "common/codec.h"
#include "generated/autonomy.h"

/* A code that means that the node does not work; one that nobody defined means nothing better. */
static bool is_failure(uint8_t status_code)
{
    return status_code != NODE_OK && status_code != NODE_INITIALIZED && status_code != NODE_INACTIVE &&
           status_code != NODE_NOT_INITIALIZED;
}

void node_monitor_push(node_monitor *self, const can_frame *frame, uint64_t now_us)
{
    const codec_message *message = NULL;
    struct autonomy_node_status_t report = {0}; /* perception_status is laid out alike */
    (void)autonomy_node_status_unpack(&report, frame->data, CAN_DATA_MAX);
    const bool of_perception = frame->id == AUTONOMY_PERCEPTION_STATUS_FRAME_ID;
    if (codec_accept(frame, &message) != CODEC_OK || report.node_id >= NODE_COUNT ||
        (report.node_id >= NODE_PERCEPTION) != of_perception) {
        self->rejected++;
        return;
    }
    node_state *node = &self->nodes[report.node_id];
    if (!node->seen || report.node_heartbeat != node->heartbeat) {
        node->progress_us = now_us;
    }
    node->heartbeat = report.node_heartbeat;
    node->status_code = report.node_status_code;
    node->reliability = (float)autonomy_node_status_node_reliability_decode(report.node_reliability);
    node->status_us = now_us;
    node->seen = true;
}

node_health node_monitor_check(const node_monitor *self, uint32_t node, const node_limits *limits, uint64_t now_us)
{
    const node_state *state = &self->nodes[node];
    const bool silent = !state->seen || now_us - state->status_us > (uint64_t)limits->timeout_ms * 1000U;
    const uint8_t code = silent ? (uint8_t)NODE_DEAD : state->status_code;
    return (node_health){
        .status_code = code,
        .reliability = state->reliability,
        .heartbeat = state->heartbeat,
        .ok = code == NODE_OK,
        .failed = is_failure(code),
        .stalled = !state->seen || now_us - state->progress_us > (uint64_t)limits->heartbeat_timeout_ms * 1000U,
        .unreliable = !(state->reliability >= limits->min_reliability),
    };
}
