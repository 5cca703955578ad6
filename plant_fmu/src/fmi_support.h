/* What both FMI wrappers share: the instance, the saved state and the checks of arguments.
 * Functions that find a fault write one line into the instance's `message` and return false. */
#ifndef RACELOOP_PLANT_FMI_SUPPORT_H
#define RACELOOP_PLANT_FMI_SUPPORT_H

#include "model.h"

/** Modes of an instance, one bit each, so that a call states its allowed modes as a mask. */
enum fmi_mode { MODE_INSTANTIATED = 1, MODE_INITIALIZATION = 2, MODE_STEP = 4, MODE_TERMINATED = 8, MODE_ANY = 15 };

#define FMI_MESSAGE_SIZE 256
#define FMI_NAME_SIZE    64

struct fmi_instance {
    struct plant plant;
    int32_t mode;  /**< enum fmi_mode */
    int32_t dirty; /**< start values changed, outputs not yet computed again */
    double start_time;
    int32_t logging;
    char name[FMI_NAME_SIZE];
    char message[FMI_MESSAGE_SIZE];
    const void *callbacks; /**< of the wrapper */
    void *environment;
};

/** A saved state: what a step changes, nothing of the environment. */
struct fmi_saved_state {
    uint64_t magic;
    uint64_t size;
    char token[40];
    double start_time;
    int32_t mode;
    int32_t dirty;
    struct plant plant;
};

/** Standstill, start values, mode INSTANTIATED. */
void fmi_instance_reset(struct fmi_instance *instance);

/** True when the instance is in one of the modes of `mask`. */
bool fmi_allowed(struct fmi_instance *instance, const char *function, int mask);

/** Check an argument that must not be null. */
bool fmi_not_null(struct fmi_instance *instance, const char *function, const char *argument, const void *pointer);

/** Check that `vr` is a variable of type `type`. */
bool fmi_readable(struct fmi_instance *instance, const char *function, uint32_t vr, enum plant_type type);

/** Check that `vr` is a variable of type `type` that may be set in the present mode. */
bool fmi_writable(struct fmi_instance *instance, const char *function, uint32_t vr, enum plant_type type);

/** Write a checked variable; false when the value is refused, which leaves the old one. */
bool fmi_write_real(struct fmi_instance *instance, uint32_t vr, double value);
bool fmi_write_int(struct fmi_instance *instance, uint32_t vr, int32_t value);

/** Bring the outputs up to date after start values changed. Call before reading. */
void fmi_refresh(struct fmi_instance *instance);

/** Leave initialization: the start state is final. */
void fmi_finish_initialization(struct fmi_instance *instance);

/** Advance from `time` by `step` seconds, which must be a positive multiple of the inner step. */
bool fmi_step(struct fmi_instance *instance, const char *function, double time, double step);

/** Fill `saved` from the instance, or the instance from `saved` after checking its header. */
void fmi_save(const struct fmi_instance *instance, struct fmi_saved_state *saved);
bool fmi_restore(struct fmi_instance *instance, const char *function, const struct fmi_saved_state *saved);

/** Write a printf-style message into the instance. */
void fmi_message(struct fmi_instance *instance, const char *format, ...)
#if defined(__GNUC__)
    __attribute__((format(printf, 2, 3)))
#endif
    ;

#endif
