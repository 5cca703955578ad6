/* Outbox: any fill. */
#include "common/can_frame.h"
#include "proofs/proof.h"

enum { CAPACITY = 3 };

void proof_outbox(void)
{
    can_frame frames[CAPACITY];
    can_outbox out = {.frames = frames, .capacity = CAPACITY};
    out.count = nondet_uint32();
    out.dropped = nondet_uint32();
    const uint32_t count = out.count;
    const uint32_t dropped = out.dropped;
    ASSUME(count <= CAPACITY);
    can_frame *frame = can_outbox_add(&out, nondet_uint8(), nondet_uint32(), nondet_uint8(), nondet_uint8());
    PROVE((frame == 0) == (count == CAPACITY), "refused only when full");
    PROVE(out.count == count + (frame != 0 ? 1U : 0U) && out.count <= CAPACITY, "never more than fit");
    PROVE(out.dropped == dropped + (frame == 0 ? 1U : 0U), "what is lost is counted");
    PROVE(frame == 0 || frame == &frames[count], "in order");
}
