#include "hil_tests/fuzz/ecu_episode.h"

#include <math.h>

#include "common/codec.h"

enum {
    FRAMES_MAX = 512,
    TICK_US = 10000,
};

/* The recording: for each tick the number of frames, the wired signals, the frames. */
static struct {
    uint8_t *bytes;
    size_t size;
    uint32_t ticks;
    size_t *offsets; /* of each tick */
    uint8_t *starts; /* copies of the state, ECU_EPISODE_STARTS of them */
} recording;

static can_frame out_frames[ECU_EPISODE_OUTBOX];

static uint32_t frames_of(const ecu_episode *ecu, uint32_t tick, can_frame *frames)
{
    const uint8_t *at = &recording.bytes[recording.offsets[tick]];
    uint32_t count;
    memcpy(&count, at, sizeof count);
    if (ecu->wired_size > 0U) {
        memcpy(ecu->wired, at + sizeof count, ecu->wired_size);
    }
    memcpy(frames, at + sizeof count + ecu->wired_size, count * sizeof *frames);
    return count;
}

/* Whatever comes in, an ECU sends whole messages of its own, and no more than fit. */
static void check_sent(const ecu_episode *ecu, const can_outbox *sent)
{
    FUZZ_CHECK(sent->dropped == 0U);
    for (uint32_t i = 0; i < sent->count; i++) {
        const can_frame *frame = &sent->frames[i];
        const codec_message *row = codec_find(frame->bus, frame->id, false);
        FUZZ_CHECK(row != NULL && row->sender == ecu->station && row->dlc == frame->dlc);
    }
}

static void read_file(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0) {
        (void)fprintf(stderr, "%s: no recording; make it with hil_tests/fuzz/run.py\n", path);
        exit(2);
    }
    recording.size = (size_t)ftell(file);
    recording.bytes = malloc(recording.size);
    rewind(file);
    FUZZ_CHECK(fread(recording.bytes, 1, recording.size, file) == recording.size);
    (void)fclose(file);
}

static void index_ticks(const ecu_episode *ecu)
{
    recording.offsets = malloc(recording.size); /* more than there can be */
    FUZZ_CHECK(recording.offsets != NULL);
    for (size_t at = 0; at < recording.size;) {
        uint32_t count;
        memcpy(&count, &recording.bytes[at], sizeof count);
        FUZZ_CHECK(count < FRAMES_MAX / 2);
        FUZZ_CHECK((recording.ticks + 1U) * sizeof at <= recording.size);
        recording.offsets[recording.ticks++] = at;
        at += sizeof count + ecu->wired_size + count * sizeof(can_frame);
    }
}

static void load(const ecu_episode *ecu)
{
    static can_frame frames[FRAMES_MAX];
    read_file(ecu->recording);
    index_ticks(ecu);
    recording.starts = malloc(ECU_EPISODE_STARTS * ecu->state_size);
    FUZZ_CHECK(recording.starts != NULL);
    ecu->init();
    ecu->begin();
    for (uint32_t tick = 0; tick < recording.ticks; tick++) {
        if (tick % (recording.ticks / ECU_EPISODE_STARTS) == 0U &&
            tick / (recording.ticks / ECU_EPISODE_STARTS) < ECU_EPISODE_STARTS) {
            memcpy(&recording.starts[tick / (recording.ticks / ECU_EPISODE_STARTS) * ecu->state_size], ecu->state,
                   ecu->state_size);
        }
        const uint32_t count = frames_of(ecu, tick, frames);
        can_outbox out = {.frames = out_frames, .capacity = ECU_EPISODE_OUTBOX};
        ecu->tick((uint64_t)tick * TICK_US, frames, count, &out);
        check_sent(ecu, &out);
        ecu->check(&out);
    }
}

static void change_recorded(fuzz_bytes *in, can_frame *frames, uint32_t *count)
{
    const uint8_t place = fuzz_u8(in);
    const uint8_t kind = fuzz_u8(in);
    const uint8_t where = fuzz_u8(in);
    const uint8_t what = fuzz_u8(in);
    if (*count == 0U) {
        return;
    }
    can_frame *frame = &frames[place % *count];
    switch (kind % 6U) {
    case 0U:
        *frame = frames[--*count];
        break;
    case 1U:
        frame->data[where % CAN_DATA_MAX] ^= what;
        break;
    case 2U:
        frames[(*count)++] = *frame;
        break;
    case 3U:
        frame->id ^= (uint32_t)what << (where % 24U);
        break;
    case 4U:
        frame->dlc = what;
        break;
    default:
        frame->flags = what;
        break;
    }
}

static void invent(fuzz_bytes *in, can_frame *frame)
{
    const uint8_t row = fuzz_u8(in);
    if (row == UINT8_MAX) {
        fuzz_take(in, frame, sizeof *frame);
        return;
    }
    const codec_message *message = &codec_table[row % codec_table_count];
    memset(frame, 0, sizeof *frame);
    frame->id = message->id;
    frame->bus = message->bus;
    frame->dlc = message->dlc;
    frame->flags = message->extended != 0U ? (uint8_t)CAN_FLAG_EXTENDED : 0U;
    fuzz_take(in, frame->data, sizeof frame->data);
    static uint8_t counter;
    codec_finish(frame, message, &counter);
}

static void bend_wire(const ecu_episode *ecu, fuzz_bytes *in)
{
    static const float odd[] = {NAN, INFINITY, -INFINITY, -0.0f, 1e-45f, 3.4e38f, -3.4e38f, 1e9f};
    const uint8_t place = fuzz_u8(in);
    uint8_t raw[4];
    fuzz_take(in, raw, sizeof raw);
    if (ecu->wired_floats == 0U) {
        return;
    }
    float value;
    memcpy(&value, raw, sizeof value);
    if (raw[0] == UINT8_MAX) {
        value = odd[raw[1] % (sizeof odd / sizeof odd[0])];
    }
    memcpy((uint8_t *)ecu->wired + place % ecu->wired_floats * sizeof value, &value, sizeof value);
}

static uint64_t bend_clock(uint64_t now_us, uint8_t kind)
{
    switch (kind % 5U) {
    case 0U:
        return now_us;
    case 1U:
        return now_us + 25000U;
    case 2U:
        return now_us + 3600000000U;
    case 3U:
        return now_us > 7200000000U ? now_us - 7200000000U : 0U;
    default:
        return UINT64_MAX - kind;
    }
}

static void run(const ecu_episode *ecu, const uint8_t *data, size_t size)
{
    static can_frame frames[FRAMES_MAX];
    fuzz_bytes in = {data, size};
    const uint32_t start = fuzz_u8(&in) % ECU_EPISODE_STARTS;
    uint32_t tick = start * (recording.ticks / ECU_EPISODE_STARTS);
    uint64_t now_us = (uint64_t)tick * TICK_US;
    uint32_t calm = 0U;
    memcpy(ecu->state, &recording.starts[start * ecu->state_size], ecu->state_size);
    ecu->begin();
    for (uint32_t n = 0; n < ECU_EPISODE_TICKS_MAX && (in.left > 0U || calm > 0U); n++) {
        uint32_t count = frames_of(ecu, tick, frames);
        tick = tick + 1U < recording.ticks ? tick + 1U : tick;
        if (calm > 0U) {
            calm--;
        } else {
            const uint8_t head = fuzz_u8(&in);
            count = (head & 0x10U) != 0U ? 0U : count;
            for (uint32_t i = 0; i < (head & 3U); i++) {
                change_recorded(&in, frames, &count);
            }
            for (uint32_t i = 0; i < (head >> 2U & 3U); i++) {
                invent(&in, &frames[count++]);
            }
            if ((head & 0x20U) != 0U) {
                bend_wire(ecu, &in);
            }
            if ((head & 0x40U) != 0U) {
                now_us = bend_clock(now_us, fuzz_u8(&in));
            }
            calm = (head & 0x80U) != 0U ? fuzz_u8(&in) : 0U;
        }
        can_outbox out = {.frames = out_frames, .capacity = ECU_EPISODE_OUTBOX};
        ecu->tick(now_us, frames, count, &out);
        check_sent(ecu, &out);
        ecu->check(&out);
        now_us += TICK_US;
    }
}

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    (void)argc;
    (void)argv;
    load(&ecu_under_test);
    FUZZ_CHECK(ecu_under_test.ready());
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    run(&ecu_under_test, data, size);
    return 0;
}
