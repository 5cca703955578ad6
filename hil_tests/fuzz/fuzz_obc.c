/* Frames of all buses -> onboard computer. */
#include "hil_tests/fuzz/ecu_episode.h"

#include <math.h>

#include "common/codec.h"
#include "generated/raptor.h"
#include "obc/obc.h"

enum { FULL_BRAKE_KPA = 4500, STEERED_BRAKE_KPA = 3500 };

static obc computer;
static bool full_brake;

static void init(void)
{
    obc_init(&computer);
}

static void tick(uint64_t now_us, const can_frame *in, uint32_t count, can_outbox *out)
{
    obc_tick(&computer, now_us, in, count, out);
}

static void begin(void)
{
    full_brake = computer.ssm.state == SSM_FULL_BRAKE;
}

static void check(const can_outbox *sent)
{
    struct raptor_brake_pressure_cmd_t brake = {0};
    struct raptor_accelerator_cmd_t throttle = {0};
    uint32_t commands = 0U;
    for (uint32_t i = 0; i < sent->count; i++) {
        const can_frame *frame = &sent->frames[i];
        if (frame->bus == CAN_BUS_1 && frame->id == RAPTOR_BRAKE_PRESSURE_CMD_FRAME_ID) {
            FUZZ_CHECK(raptor_brake_pressure_cmd_unpack(&brake, frame->data, frame->dlc) == 0);
            commands++;
        } else if (frame->bus == CAN_BUS_1 && frame->id == RAPTOR_ACCELERATOR_CMD_FRAME_ID) {
            FUZZ_CHECK(raptor_accelerator_cmd_unpack(&throttle, frame->data, frame->dlc) == 0);
            commands++;
        }
    }
    const uint8_t state = computer.ssm.state;
    FUZZ_CHECK(commands == 2U);
    FUZZ_CHECK(brake.brake_pressure_cmd <= FULL_BRAKE_KPA);
    FUZZ_CHECK(brake.brake_pressure_cmd == 0U || throttle.acc_pedal_cmd == 0U);
    FUZZ_CHECK(!full_brake || state == SSM_FULL_BRAKE);
    full_brake = state == SSM_FULL_BRAKE;
    if (state < SSM_NOMINAL || full_brake) {
        const bool steered = full_brake && computer.ssm_output.controller != CONTROL_NONE;
        FUZZ_CHECK(brake.brake_pressure_cmd == FULL_BRAKE_KPA ||
                   (steered && brake.brake_pressure_cmd == STEERED_BRAKE_KPA));
        FUZZ_CHECK(throttle.acc_pedal_cmd == 0U);
    } else {
        FUZZ_CHECK(computer.parameters.verdict == PARAMETER_VERDICT_ACCEPTED);
    }
    FUZZ_CHECK(throttle.acc_pedal_cmd == 0U || state == SSM_NOMINAL || state == SSM_DEGRADED);
    const control_output *control = &computer.control_output;
    FUZZ_CHECK(isfinite(control->road_wheel_command) && isfinite(control->throttle) &&
               isfinite(control->brake_pressure));
}

static bool ready(void)
{
    return computer.ssm.state == SSM_NOMINAL;
}

const ecu_episode ecu_under_test = {
    .recording = FUZZ_RECORDINGS "/obc.bin",
    .station = CAN_STATION_OBC,
    .state = &computer,
    .state_size = sizeof computer,
    .init = init,
    .tick = tick,
    .begin = begin,
    .check = check,
    .ready = ready,
};
