/* Frames that the Space Drive sends on CAN3: calibrated positions, status and active errors. */
#ifndef RACELOOP_SPACE_DRIVE_REPORTS_H
#define RACELOOP_SPACE_DRIVE_REPORTS_H

#include "common/can_frame.h"
#include "space_drive/space_drive.h"

/* Six calibrated positions (0x120..0x125) with plausibility, counter and CRC. */
void space_drive_send_positions(space_drive *self, can_outbox *out);

/* Status of the three steering channels (0x80, 0x82, 0x84), of the three brake channels (0x81, 0x83, 0x85). */
void space_drive_send_steer_status(const space_drive *self, can_outbox *out);
void space_drive_send_brake_status(const space_drive *self, can_outbox *out);

/* Active errors of the three steering channels (0x60, 0x62, 0x64), of the three brake channels (0x61, 0x63, 0x65). */
void space_drive_send_steer_errors(const space_drive *self, can_outbox *out);
void space_drive_send_brake_errors(const space_drive *self, can_outbox *out);

#endif
