/* The profile of CAN1 that an ECU speaks: its public layout on the wire, whatever the firmware inside is written in.
 *
 * The firmware is written in V14. This stands between an ECU and its bus, translates received frames into V14 and sent
 * ones out of it, and decides nothing else: one frame in gives at most one frame out, nothing comes by itself, and
 * message counters pass as they are. So a sender that stops, or whose counter stands, is found on V26 as on V14. What
 * is not in the profile, or too short for it, is refused and counted. Messages that both layouts have in the same
 * bits keep them; a contract test says which those are.
 *
 * V26 against V14:
 * - brake_pressure_cmd has a pressure per axle. The one of V14 is the front's, and the rear gets its share of it
 *   (DBW_PROFILE_*_PERCENT). The other way the car brakes at least as hard as either axle is asked to.
 * - steering_report has lost the angle, and steering_report_extd has it as an average, without a counter. The V14
 *   report is made of one frame of each: no angle without a new counter, no counter without a new angle.
 * - misc_report, pt_report_3, steering_cmd and dash_switches_cmd have grown. There is no push-to-pass here, no target
 *   speed of a multi-car race and no gain for the steering servo: those fields are sent as 0, the brake balance as
 *   independent, and all are ignored when received.
 * - Reports on the steering and brake actuators, on charging and from the satellite receiver (1313 to 1316, 1344, 1350)
 *   are not sent, because nothing here knows what they hold, and are ignored when received.
 */
#ifndef RACELOOP_DBW_PROFILE_H
#define RACELOOP_DBW_PROFILE_H

#include <stdbool.h>
#include <stdint.h>

#include "common/can_frame.h"
#include "common/codec.h"

/* Brake balance of the car. */
enum {
    DBW_PROFILE_FRONT_PERCENT = 54,
    DBW_PROFILE_REAR_PERCENT = 46,
};

/* What became of a received frame. */
typedef enum dbw_profile_verdict {
    DBW_PROFILE_FRAME = 0,   /* it is there in V14 */
    DBW_PROFILE_NOTHING = 1, /* it has no like in V14, or waits for another frame */
    DBW_PROFILE_REFUSED = 2, /* no frame of this profile */
} dbw_profile_verdict;

/* What V26 alone reports of the steering, from the ECU that reports it. */
typedef struct dbw_steering_rates {
    float primary;   /* rad/s, first sensor; left positive */
    float commanded; /* rad/s */
} dbw_steering_rates;

/* State of one ECU's translation. Zeroed, it speaks V14, which passes untouched. */
typedef struct dbw_profile {
    uint8_t index;                        /* enum codec_profile_index */
    dbw_steering_rates rates;             /* to be kept up to date before frames are sent */
    int16_t average_angle;                /* of the last steering_report to be sent, 0.5 deg */
    bool average_pending;                 /* it has not left yet */
    uint8_t report_counter;               /* of the last steering_report received */
    bool counter_pending;                 /* no angle has come since */
    uint32_t refused[CODEC_STATUS_COUNT]; /* received frames by negated codec_status */
} dbw_profile;

/* Speak a profile from now on. index: enum codec_profile_index. Returns false, with nothing changed, when there is no
 * such profile. */
bool dbw_profile_select(dbw_profile *self, uint8_t index);

/* Translate a received frame, of any bus. v14: receives the frame when the verdict is DBW_PROFILE_FRAME, else
 * undefined. Frames of other buses than CAN1 pass untouched. */
dbw_profile_verdict dbw_profile_receive(dbw_profile *self, const can_frame *frame, can_frame *v14);

/* Translate the frames of an outbox from place `first` on, at most out->count. One that the profile has no like of, or
 * that it cannot make yet, is taken out; the others keep their order. */
void dbw_profile_send(dbw_profile *self, can_outbox *out, uint32_t first);

#endif
