/* Sorting in a time that depends on nothing but the count. */
#ifndef AUTONOMY_RADIX_SORT_H
#define AUTONOMY_RADIX_SORT_H

#include <stdint.h>

/* A key that sorts as the number does; -0 and 0 are equal. Not for NaN. */
uint32_t radix_key(float number);

/* Sort places by their keys, ascending; equal ones stay in order.
 *
 * places: count of them, each an index into keys.
 * scratch: room for as many. */
void radix_sort(const uint32_t *keys, uint32_t *places, uint32_t *scratch, uint32_t count);

#endif
