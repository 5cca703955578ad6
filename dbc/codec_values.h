/* Host side of the codec: one generic pair of functions for all messages, for the Python binding.
 *
 * A message is named by its profile and its row in that profile's table. Its values are physical, double, in the order
 * of the signals in its row there (by start bit). Packing is cantools' C; what that leaves open, the range of the raw
 * values, is checked here. Not part of the firmware images.
 */
#ifndef RACELOOP_CODEC_VALUES_H
#define RACELOOP_CODEC_VALUES_H

#include <stdint.h>

#include "common/can_frame.h"

/* One signal: value = raw * scale + offset. */
typedef struct codec_values_signal {
    const char *name;
    double scale;
    double offset;
    double raw_min; /* what the bits hold, not what the DBC file declares */
    double raw_max;
} codec_values_signal;

/* One message, in step with the table of its profile. */
typedef struct codec_values_message {
    const char *database; /* stem of the DBC file */
    const char *name;
    uint32_t signal_count;
    const codec_values_signal *signals;
    void (*encode)(const double *values, uint8_t *data); /* values in range; all 8 bytes are written */
    void (*decode)(const uint8_t *data, double *values); /* 8 bytes are readable */
} codec_values_message;

/* One profile. */
typedef struct codec_values_profile {
    const char *name;
    const codec_values_message *messages; /* as many as in codec_profiles */
} codec_values_profile;

/* Encode into 8 data bytes; bytes behind the message's length are 0.
 * Returns 0; the number (1 for the first) of the first value that is not finite or does not fit its bits; or a
 * negative codec_status for an unknown profile or message_index. */
int codec_values_encode(uint32_t profile, uint32_t message_index, const double *values, uint8_t *data);

/* Decode `length` data bytes, of which those behind the message's length are ignored.
 * Returns 0, or CODEC_UNKNOWN_ID or CODEC_SHORT_FRAME with values untouched. */
int codec_values_decode(uint32_t profile, uint32_t message_index, const uint8_t *data, uint32_t length, double *values);

/* Encode into a whole frame: address, length, time and sender filled in. Returns as codec_values_encode. */
int codec_values_frame(uint32_t profile, uint32_t message_index, uint64_t time_us, uint8_t sender, const double *values,
                       can_frame *frame);

/* Encode `count` rows of values into frames. time_us: one per row, or null for 0.
 * Returns 0; the number (1 for the first) of the first value in the whole array that was refused, with the frames
 * before it written; or a negative codec_status. */
int64_t codec_values_frames(uint32_t profile, uint32_t message_index, const uint64_t *time_us, uint8_t sender,
                            const double *values, uint32_t count, can_frame *frames);

/* For each frame its row in the profile's table, or the negative codec_status for which codec_accept_in refuses it.
 * profile: below CODEC_PROFILE_COUNT. */
void codec_values_identify(uint32_t profile, const can_frame *frames, uint32_t count, int32_t *message_index);

/* Decode the frames picked by `rows` (indices into frames), which codec_values_identify found to be this message,
 * into one column of `count` values per signal: value of signal s, pick i at values[s * count + i].
 * Returns 0 or CODEC_UNKNOWN_ID. */
int codec_values_decode_columns(uint32_t profile, uint32_t message_index, const can_frame *frames, const uint32_t *rows,
                                uint32_t count, double *values);

#endif
