/* Actuation test: sweeps the steering and pulses the brake through the Space Drive, and checks that every sensor
 * shows what was asked for. */
#ifndef RACELOOP_RAPTOR_ACTUATION_TEST_H
#define RACELOOP_RAPTOR_ACTUATION_TEST_H

#include <stdbool.h>
#include <stdint.h>

#include "common/debounce.h"
#include "raptor/config.h"
#include "raptor/gateway.h"

/* What one step reads. */
typedef struct raptor_test_input {
    const raptor_gateway *gateway; /* positions as the Space Drive reports them */
    float steer_request;           /* rad, in force: what the sensors should show */
    float brake_request;           /* Pa, in force; the onboard computer may hold it above what the test wants */
    float brake_lines[2];          /* Pa, front and rear */
} raptor_test_input;

/* State: raptor_test_start to start. */
typedef struct raptor_test {
    uint8_t step;   /* index of the running step */
    uint8_t result; /* enum raptor_test_result */
    debounce fits;
    uint64_t entered_us; /* when the step began */
    float steer;         /* rad, wanted */
    float brake;         /* Pa, wanted */
} raptor_test;

/* Begin with the first step. */
void raptor_test_start(raptor_test *self, const raptor_config *config, uint64_t now_us);

/* One tick: judge the running step, go on to the next. Afterwards self->steer and self->brake are what to request
 * and self->result tells how the test stands. A step that does not fit within its time fails the test. */
void raptor_test_step(raptor_test *self, const raptor_config *config, const raptor_test_input *input, uint64_t now_us);

#endif
