/* Debounce: any state before, any time. */
#include "common/debounce.h"
#include "proofs/proof.h"

void proof_debounce(void)
{
    const debounce before = {.active = nondet_bool(), .since_us = nondet_uint64()};
    debounce self = before;
    const bool condition = nondet_bool();
    const uint32_t hold_us = nondet_uint32();
    const uint64_t now_us = nondet_uint64();
    ASSUME(!before.active || before.since_us <= now_us);
    const bool held = debounce_step(&self, condition, hold_us, now_us);
    PROVE(self.active == condition, "active while the condition holds");
    PROVE(!held || condition, "nothing holds without its condition");
    const uint64_t began_us = before.active ? before.since_us : now_us;
    PROVE(!condition || self.since_us == began_us, "the beginning stays");
    PROVE(!condition || held == (now_us - began_us >= hold_us), "held exactly as long as asked");
}
