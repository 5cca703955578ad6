/* The ECUs as stations of the network: take the inbox, tick, submit the outbox, in one call.
 *
 * Frames that do not fit into an outbox are counted by the ECU's station, as they would be lost in a real mailbox.
 */
#ifndef RACELOOP_BENCH_ECUS_H
#define RACELOOP_BENCH_ECUS_H

#include <stdint.h>

#include "network.h"
#include "obc/obc.h"
#include "raptor/raptor.h"
#include "space_drive/space_drive.h"

enum { BENCH_OUTBOX_MAX = 256 };

/* Tick one ECU at now_us with what its station has received; its frames are submitted, not yet transmitted.
 * Returns the number of frames that did not fit into the outbox. */
uint32_t bench_obc_tick(network *net, obc *self, uint64_t now_us);
uint32_t bench_raptor_tick(network *net, raptor *self, uint64_t now_us, const raptor_wired_in *wired,
                           raptor_wired_out *drive);
uint32_t bench_space_drive_tick(network *net, space_drive *self, uint64_t now_us, const space_drive_wired_in *wired,
                                space_drive_wired_out *drive);

#endif
