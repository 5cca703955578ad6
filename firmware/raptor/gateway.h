/* Gateway to the Space Drive on CAN3: what its channels report, and the requests it gets. */
#ifndef RACELOOP_RAPTOR_GATEWAY_H
#define RACELOOP_RAPTOR_GATEWAY_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"
#include "common/debounce.h"
#include "raptor/config.h"

enum {
    RAPTOR_GATEWAY_CHANNELS = 3,
    RAPTOR_GATEWAY_TRUSTED = 2, /* channels that an axis needs */
};

/* One channel of one axis as the Raptor sees it. */
typedef struct raptor_gateway_channel {
    codec_rx position_rx;
    codec_rx status_rx;
    codec_rx error_rx;
    float position;       /* rad or Pa, of the last plausible frame */
    bool plausible;       /* the last position frame said so */
    bool valid;           /* plausible and fresh */
    bool faulty;          /* said to be implausible, or one of its frames is overdue: not just not heard of yet */
    bool emergency_brake; /* fresh status frame with emr_brk */
    bool error;           /* last error frame had a bit set */
    bool critical;        /* last error frame had crtcl_err_recognzd set */
} raptor_gateway_channel;

/* One axis. */
typedef struct raptor_gateway_axis {
    raptor_gateway_channel channels[RAPTOR_GATEWAY_CHANNELS];
    float position;      /* voted over the valid channels; holds its last value without them */
    uint8_t valid_count; /* valid channels, 0..3 */
    bool known;          /* `position` has had a value */
} raptor_gateway_axis;

/* State: zero it to start. */
typedef struct raptor_gateway {
    raptor_gateway_axis steer; /* rad, left positive */
    raptor_gateway_axis brake; /* Pa */
    debounce lost_timer;
    bool lost;            /* an axis has been without two valid channels for too long: est4 */
    bool emergency_brake; /* two channels or more report the emergency brake: est6 */
    bool started;
    uint64_t since_us;     /* start of supervision */
    uint8_t steer_counter; /* of the requests */
    uint8_t brake_counter;
} raptor_gateway;

/* Take one CAN3 frame; ids of no interest are ignored. now_us: monotonic. */
void raptor_gateway_receive(raptor_gateway *self, const can_frame *frame, uint64_t now_us);

/* Once per tick after reception: validity of channels and axes, loss, emergency brake. */
void raptor_gateway_step(raptor_gateway *self, const raptor_config *config, uint64_t now_us);

/* All six positions valid. */
bool raptor_gateway_ready(const raptor_gateway *self);

/* Send the requests. steer_motor_angle: rad, limited to the stops. brake_pressure: Pa, 0..full brake. speed: m/s.
 * NaN asks for full brake, and for straight wheels. The steering request starts when a position is known: before
 * that nobody can say where to hold the wheels, and the Space Drive keeps them still by itself. */
void raptor_gateway_send_requests(raptor_gateway *self, float steer_motor_angle, float brake_pressure, float speed,
                                  can_outbox *out);

/* Tell the Space Drive that the car is switched off: it keeps the brake and takes silence for granted. */
void raptor_gateway_send_shutdown(can_outbox *out);

#endif
