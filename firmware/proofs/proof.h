/* What the proofs say to CBMC. Locals without a value, and the results of functions named nondet, are any value of
 * their type. Booleans so made may be neither 0 nor 1, so those that matter are drawn one by one. */
#ifndef RACELOOP_PROOF_H
#define RACELOOP_PROOF_H

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#define ASSUME(condition)          __CPROVER_assume(condition)
#define PROVE(condition, property) __CPROVER_assert(condition, property)

uint8_t nondet_uint8(void);
uint16_t nondet_uint16(void);
uint32_t nondet_uint32(void);
uint64_t nondet_uint64(void);
int32_t nondet_int32(void);
float nondet_float(void);

static inline bool nondet_bool(void)
{
    return (nondet_uint8() & 1U) != 0U;
}

#endif
