/* raceloop-obc: the onboard computer as a process. */
#include "obc/obc.h"
#include "ports/linux/ecu_process.h"

static obc computer;

static const char *const task_names[OBC_TASK_COUNT] = {
    [OBC_TASK_RECEIVE] = "receive", [OBC_TASK_CONTROL] = "control",
    [OBC_TASK_MONITOR] = "monitor", [OBC_TASK_SSM] = "ssm",
    [OBC_TASK_DBW] = "dbw",         [OBC_TASK_CT_REPORT] = "ct_report",
    [OBC_TASK_STATUS] = "status",   [OBC_TASK_STATISTICS] = "statistics",
};

static void tick(uint64_t now_us, const can_frame *in, uint32_t in_count, can_outbox *out)
{
    obc_tick(&computer, now_us, in, in_count, out);
}

static void stop(void)
{
    obc_stop(&computer);
}

static bool select_profile(uint8_t profile)
{
    return obc_select_profile(&computer, profile);
}

int main(int argument_count, char **arguments)
{
    static const ecu_image image = {
        .name = "obc",
        .station = CAN_STATION_OBC,
        .sockets = {.buses = 1U << CAN_BUS_1 | 1U << CAN_BUS_A | 1U << CAN_BUS_S},
        .executive = &computer.executive,
        .task_names = task_names,
        .task_count = OBC_TASK_COUNT,
        .tick = tick,
        .stop = stop,
        .select_profile = select_profile,
    };
    obc_init(&computer);
    return ecu_process_run(&image, argument_count, arguments);
}
