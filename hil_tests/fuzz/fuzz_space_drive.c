/* Frames of CAN3 and wired signals -> Space Drive. */
#include "hil_tests/fuzz/ecu_episode.h"

#include <math.h>

#include "space_drive/space_drive.h"

static space_drive actuator;
static space_drive_wired_in wired;
static space_drive_wired_out drive;
static uint8_t emergency;
static bool shutdown;

static void init(void)
{
    space_drive_init(&actuator, NULL);
}

static void tick(uint64_t now_us, const can_frame *in, uint32_t count, can_outbox *out)
{
    space_drive_tick(&actuator, now_us, &wired, in, count, &drive, out);
}

static void begin(void)
{
    emergency = actuator.emergency;
    shutdown = actuator.shutdown;
}

static void check(const can_outbox *sent)
{
    (void)sent;
    FUZZ_CHECK(drive.brake_pressure_demand >= 0.0f && drive.brake_pressure_demand <= SPACE_DRIVE_BRAKE_STOP_PA);
    FUZZ_CHECK(fabsf(drive.steer_motor_demand) <= 4.37f); /* where the sensors end */
    FUZZ_CHECK((actuator.emergency & emergency) == emergency);
    FUZZ_CHECK(actuator.shutdown || !shutdown);
    begin();
    if (emergency != 0U || shutdown) {
        const unsigned steered = SPACE_DRIVE_EMERGENCY_BRAKE_REQUESTS | SPACE_DRIVE_EMERGENCY_BRAKE_SENSORS;
        FUZZ_CHECK(drive.brake_pressure_demand == (emergency != 0U && (emergency & ~steered) == 0U
                                                       ? SPACE_DRIVE_STEERED_BRAKE_PA
                                                       : SPACE_DRIVE_FULL_BRAKE_PA));
    }
}

static bool ready(void)
{
    return actuator.emergency == 0U && drive.brake_pressure_demand < SPACE_DRIVE_BRAKE_STOP_PA;
}

const ecu_episode ecu_under_test = {
    .recording = FUZZ_RECORDINGS "/space_drive.bin",
    .station = CAN_STATION_SPACE_DRIVE,
    .state = &actuator,
    .state_size = sizeof actuator,
    .wired = &wired,
    .wired_size = sizeof wired,
    .wired_floats = sizeof wired / sizeof(float),
    .init = init,
    .tick = tick,
    .begin = begin,
    .check = check,
    .ready = ready,
};
