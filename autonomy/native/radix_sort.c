#include "autonomy/native/radix_sort.h"

#include <string.h>

enum {
    DIGIT_BITS = 11,
    DIGITS = 3,
    DIGIT_VALUES = 1 << DIGIT_BITS,
    SIGN_BIT = 31,
};

uint32_t radix_key(float number)
{
    const float without_negative_zero = number + 0.0f;
    uint32_t bits;
    memcpy(&bits, &without_negative_zero, sizeof bits);
    const uint32_t negative = bits >> SIGN_BIT;
    return negative != 0U ? ~bits : bits | (1U << SIGN_BIT);
}

static uint32_t digit_of(uint32_t key, uint32_t digit)
{
    return (key >> (digit * (uint32_t)DIGIT_BITS)) & ((uint32_t)DIGIT_VALUES - 1U);
}

void radix_sort(const uint32_t *keys, uint32_t *places, uint32_t *scratch, uint32_t count)
{
    for (uint32_t digit = 0U; digit < (uint32_t)DIGITS; digit++) {
        uint32_t starts[DIGIT_VALUES] = {0};
        for (uint32_t i = 0U; i < count; i++) {
            starts[digit_of(keys[places[i]], digit)]++;
        }
        if (count == 0U || starts[digit_of(keys[places[0]], digit)] == count) {
            continue; /* all the same */
        }
        uint32_t total = 0U;
        for (uint32_t value = 0U; value < (uint32_t)DIGIT_VALUES; value++) {
            const uint32_t here = starts[value];
            starts[value] = total;
            total += here;
        }
        for (uint32_t i = 0U; i < count; i++) {
            scratch[starts[digit_of(keys[places[i]], digit)]++] = places[i];
        }
        memcpy(places, scratch, count * sizeof places[0]);
    }
}
