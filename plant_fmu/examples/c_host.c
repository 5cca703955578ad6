/* A minimal C host: load the FMI 3.0 library, drive at full throttle, print the result and the cost.
 *
 *   cc -std=c11 -I FMI_HEADERS c_host.c -ldl -o c_host
 *   ./c_host LIBRARY TOKEN STEPS GEAR_VR IGNITION_VR RUNNING_VR GEAR0_VR V0_VR THROTTLE_VR VX_VR
 *
 * It is not linked with libm on purpose: the FMU brings what it needs. */
#define _POSIX_C_SOURCE 200809L
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "fmi3FunctionTypes.h"

enum argument { PROGRAM, LIBRARY, TOKEN, STEPS, GEAR, IGNITION, RUNNING, GEAR0, V0, THROTTLE, VX, COUNT };

static void *find(void *library, const char *name)
{
    void *symbol = dlsym(library, name);
    if (symbol == NULL) {
        (void)fprintf(stderr, "c_host: %s is missing\n", name);
        exit(1);
    }
    return symbol;
}

/* POSIX lets an object pointer from dlsym become a function pointer; ISO C wants it by copy. */
#define FIND(function)                                                                                                 \
    function##TYPE *function = NULL;                                                                                   \
    do {                                                                                                               \
        void *symbol = find(library, #function);                                                                       \
        memcpy(&function, &symbol, sizeof symbol);                                                                     \
    } while (0)

static void check(fmi3Status status, const char *what)
{
    if (status != fmi3OK) {
        (void)fprintf(stderr, "c_host: %s failed\n", what);
        exit(1);
    }
}

static void log_message(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category, fmi3String message)
{
    (void)environment;
    (void)status;
    (void)fprintf(stderr, "c_host: %s: %s\n", category, message);
}

static double now_us(void)
{
    struct timespec t;
    (void)clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec * 1e6 + (double)t.tv_nsec * 1e-3;
}

int main(int argc, char **argv)
{
    if (argc != COUNT) {
        (void)fprintf(stderr, "c_host: wrong number of arguments, see the head of c_host.c\n");
        return 2;
    }
    fmi3ValueReference vr[COUNT] = {0};
    for (int i = GEAR; i < COUNT; ++i) {
        vr[i] = (fmi3ValueReference)strtoul(argv[i], NULL, 10);
    }
    void *library = dlopen(argv[LIBRARY], RTLD_NOW | RTLD_LOCAL);
    if (library == NULL) {
        (void)fprintf(stderr, "c_host: %s\n", dlerror());
        return 1;
    }
    FIND(fmi3InstantiateCoSimulation);
    FIND(fmi3EnterInitializationMode);
    FIND(fmi3ExitInitializationMode);
    FIND(fmi3SetFloat64);
    FIND(fmi3SetInt32);
    FIND(fmi3SetBoolean);
    FIND(fmi3GetFloat64);
    FIND(fmi3DoStep);
    FIND(fmi3FreeInstance);

    fmi3Instance car = fmi3InstantiateCoSimulation("car", argv[TOKEN], "", false, false, false, false, NULL, 0, NULL,
                                                   log_message, NULL);
    if (car == NULL) {
        return 1;
    }
    const bool on = true;
    const int32_t gear = 5;
    const double start_speed = 50.0;
    const double throttle = 1.0;
    check(fmi3SetBoolean(car, &vr[IGNITION], 1, &on, 1), "ignition");
    check(fmi3SetBoolean(car, &vr[RUNNING], 1, &on, 1), "engine_running0");
    check(fmi3SetInt32(car, &vr[GEAR0], 1, &gear, 1), "gear0");
    check(fmi3SetInt32(car, &vr[GEAR], 1, &gear, 1), "gear_demand");
    check(fmi3SetFloat64(car, &vr[V0], 1, &start_speed, 1), "v0");
    check(fmi3EnterInitializationMode(car, false, 0.0, 0.0, false, 0.0), "enter initialization");
    check(fmi3ExitInitializationMode(car), "exit initialization");
    check(fmi3SetFloat64(car, &vr[THROTTLE], 1, &throttle, 1), "throttle_demand");

    const long steps = strtol(argv[STEPS], NULL, 10);
    bool event = false;
    bool stop = false;
    bool early = false;
    double last = 0.0;
    const double begin = now_us();
    for (long i = 0; i < steps; ++i) {
        check(fmi3DoStep(car, (double)i * 0.01, 0.01, true, &event, &stop, &early, &last), "step");
    }
    const double spent = now_us() - begin;
    double speed = 0.0;
    check(fmi3GetFloat64(car, &vr[VX], 1, &speed, 1), "vx");
    (void)printf("vx_m_s=%.17g us_per_step=%.3f\n", speed, spent / (double)(steps > 0 ? steps : 1));
    fmi3FreeInstance(car);
    return 0;
}
