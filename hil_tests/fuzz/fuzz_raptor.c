/* Frames of CAN1 and CAN3 and wired signals -> Raptor. */
#include "hil_tests/fuzz/ecu_episode.h"

#include <math.h>

#include "raptor/raptor.h"
#include "space_drive/space_drive.h"

static raptor controller;
static raptor_wired_in wired;
static raptor_wired_out drive;
static uint8_t latched;

static void init(void)
{
    raptor_init(&controller, NULL);
}

static void tick(uint64_t now_us, const can_frame *in, uint32_t count, can_outbox *out)
{
    raptor_tick(&controller, now_us, &wired, in, count, &drive, out);
}

static uint8_t terminal_state(void)
{
    const uint8_t state = controller.sys.state;
    return state == RAPTOR_SYS_PWR_OFF || state == RAPTOR_SYS_EMERGENCY_SHUTDOWN ? state : 0U;
}

static void begin(void)
{
    latched = terminal_state();
}

static void check(const can_outbox *sent)
{
    const raptor_demand *demand = &controller.demand;
    (void)sent;
    FUZZ_CHECK(demand->brake >= 0.0f && demand->brake <= SPACE_DRIVE_BRAKE_STOP_PA);
    FUZZ_CHECK(fabsf(demand->steer) <= 4.1892f);
    FUZZ_CHECK(drive.throttle_demand >= 0.0f && drive.throttle_demand <= 1.0f);
    FUZZ_CHECK(drive.gear_demand <= 6U);
    FUZZ_CHECK(isfinite(controller.speed));
    FUZZ_CHECK(latched == 0U || controller.sys.state == latched);
    latched = terminal_state();
    if (controller.commands.faults != 0U || latched != 0U) {
        const raptor_command_monitor *commands = &controller.commands;
        const bool steered = commands->steering_known && (commands->faults & RAPTOR_COMMAND_STEERING_TIMEOUT) == 0U &&
                             commands->steering_implausible < controller.config.implausible_limit;
        FUZZ_CHECK(demand->brake >= (steered ? SPACE_DRIVE_STEERED_BRAKE_PA : SPACE_DRIVE_FULL_BRAKE_PA));
        FUZZ_CHECK(drive.throttle_demand == 0.0f);
    }
    FUZZ_CHECK(drive.throttle_demand == 0.0f || controller.sys.state == RAPTOR_SYS_DRIVING);
    FUZZ_CHECK(drive.throttle_demand == 0.0f || demand->brake <= controller.config.pedal_conflict_brake);
}

static bool ready(void)
{
    return controller.sys.state == RAPTOR_SYS_DRIVING;
}

const ecu_episode ecu_under_test = {
    .recording = FUZZ_RECORDINGS "/raptor.bin",
    .station = CAN_STATION_RAPTOR,
    .state = &controller,
    .state_size = sizeof controller,
    .wired = &wired,
    .wired_size = sizeof wired,
    .wired_floats = offsetof(raptor_wired_in, gear) / sizeof(float),
    .init = init,
    .tick = tick,
    .begin = begin,
    .check = check,
    .ready = ready,
};
