/* Receive stamps of the kernel, which are wall-clock time, on CLOCK_MONOTONIC. */
#ifndef RACELOOP_PORT_KERNEL_STAMP_H
#define RACELOOP_PORT_KERNEL_STAMP_H

#include <stdint.h>

/* A look at both clocks. */
typedef struct clock_look {
    uint64_t monotonic_ns;
    int64_t offset_ns; /* CLOCK_REALTIME - CLOCK_MONOTONIC, to within the time that the look took */
} clock_look;

/* Look now. */
clock_look look_at_clocks(void);

/* A stamp on CLOCK_MONOTONIC, ns.
 *
 * stamp_ns: CLOCK_REALTIME. offset_ns: of a look after the stamp was read; earlier_offset_ns: of the look before it.
 * They differ when the wall clock was set in between; then the one that explains the stamp is taken.
 * earliest_ns..latest_ns: where the result must lie; what no offset explains goes to the nearer end. */
uint64_t kernel_stamp_to_monotonic(uint64_t stamp_ns, int64_t offset_ns, int64_t earlier_offset_ns,
                                   uint64_t earliest_ns, uint64_t latest_ns);

#endif
