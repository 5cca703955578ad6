/* Readers of candump, ASC, TRC and BLF logs. Input: a byte that picks the reader (and the columns of a TRC log), then
 * the log. What is read at once and what is read a frame at a time must be the same. */
#include "hil_tests/fuzz/fuzz_bytes.h"

#include "bridge/native/asc.h"
#include "bridge/native/blf.h"
#include "bridge/native/candump.h"
#include "bridge/native/trc.h"

enum { CAPACITY = 64 };

static const candump_channel CHANNELS[] = {{"can0", 0U}, {"vcan1", 1U}, {"abcdefghijklmno", 2U}};
static const char *const COLUMNS[] = {"NOTIdlD", "NOTBIdRLD", "OID", "NOIlD", "D", ""};

static uint32_t read_log(uint8_t kind, const uint8_t *data, uint32_t length, can_frame *frames, uint32_t capacity,
                         uint32_t *used)
{
    uint16_t channels[CAPACITY];
    const char *text = (const char *)data;
    switch (kind % 4U) {
    case 0U:
        return candump_read(text, length, CHANNELS, 3U, frames, capacity, used);
    case 1U:
        return asc_read(text, length, frames, channels, capacity, used);
    case 2U:
        return trc_read(text, length, COLUMNS[kind / 4U % 6U], frames, channels, capacity, used);
    default: {
        const blf_progress progress = blf_read(data, length, 1700000000000000U, frames, channels, capacity);
        *used = progress.used;
        return progress.count;
    }
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    can_frame frames[CAPACITY];
    if (size < 1U) {
        return 0;
    }
    const uint8_t kind = data[0];
    const uint32_t length = (uint32_t)size - 1U;
    uint32_t used;
    const uint32_t count = read_log(kind, data + 1, length, frames, CAPACITY, &used);
    FUZZ_CHECK(used <= length && count <= CAPACITY);
    uint32_t at = 0U;
    for (uint32_t i = 0; i < count; i++) {
        can_frame one;
        FUZZ_CHECK(frames[i].dlc <= 8U || kind % 4U == 3U);
        FUZZ_CHECK(read_log(kind, data + 1 + at, length - at, &one, 1U, &used) == 1U);
        FUZZ_CHECK(memcmp(&one, &frames[i], sizeof one) == 0);
        FUZZ_CHECK(used > 0U);
        at += used;
    }
    return 0;
}
