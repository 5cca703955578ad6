#include "common/debounce.h"

bool debounce_step(debounce *self, bool condition, uint32_t hold_us, uint64_t now_us)
{
    if (!condition) {
        self->active = false;
        return false;
    }
    if (!self->active) {
        self->active = true;
        self->since_us = now_us;
    }
    return now_us - self->since_us >= hold_us;
}
