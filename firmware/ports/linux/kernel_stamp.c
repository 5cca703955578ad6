#define _POSIX_C_SOURCE 200809L

#include "ports/linux/kernel_stamp.h"

#include <stdbool.h>
#include <time.h>

#include "ports/linux/deadline_timer.h"

enum {
    NS_PER_S = 1000000000,
    LOOKS = 4,
    TIGHT_NS = 2000, /* a look that took longer was interrupted */
};

clock_look look_at_clocks(void)
{
    clock_look best = {0};
    uint64_t best_ns = UINT64_MAX;
    for (uint32_t look = 0; look < LOOKS && best_ns > TIGHT_NS; look++) {
        struct timespec wall;
        const uint64_t before_ns = monotonic_ns();
        (void)clock_gettime(CLOCK_REALTIME, &wall);
        const uint64_t after_ns = monotonic_ns();
        if (after_ns - before_ns < best_ns) {
            best_ns = after_ns - before_ns;
            best.monotonic_ns = after_ns;
            best.offset_ns =
                (int64_t)wall.tv_sec * NS_PER_S + (int64_t)wall.tv_nsec - (int64_t)(before_ns + best_ns / 2U);
        }
    }
    return best;
}

uint64_t kernel_stamp_to_monotonic(uint64_t stamp_ns, int64_t offset_ns, int64_t earlier_offset_ns,
                                   uint64_t earliest_ns, uint64_t latest_ns)
{
    const int64_t earliest = (int64_t)earliest_ns;
    const int64_t latest = (int64_t)latest_ns;
    const int64_t result = (int64_t)stamp_ns - offset_ns;
    const int64_t other = (int64_t)stamp_ns - earlier_offset_ns;
    if (earliest <= result && result <= latest) {
        return (uint64_t)result;
    }
    if (earliest <= other && other <= latest) {
        return (uint64_t)other;
    }
    return result < earliest ? earliest_ns : latest_ns;
}
