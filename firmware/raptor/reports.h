/* Reports on CAN1, each at the cycle time of raptor.dbc.
 *
 * Of the messages that raptor.dbc gives to the Raptor four are never sent, because this car has no source for them:
 * rest_of_field (1209), marelli_report_2 (1251), mylaps_report_1 and _2 (228, 226): no other cars' data and no
 * position receivers of race control are wired to the Raptor.
 */
#ifndef RACELOOP_RAPTOR_REPORTS_H
#define RACELOOP_RAPTOR_REPORTS_H

#include <stdint.h>

#include "common/can_frame.h"
#include "raptor/raptor.h"

/* Send what is due in minor frame number `frame`. Values are saturated to what their signal declares; NaN becomes
 * the signal's minimum. */
void raptor_reports_send(raptor *self, const raptor_wired_in *wired, uint64_t frame, uint64_t now_us, can_outbox *out);

#endif
