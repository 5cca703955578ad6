/* Text of clients of the hub -> requests. */
#include "hil_tests/fuzz/fuzz_bytes.h"

#include "bridge/native/hub/socketcand_text.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const char *text = (const char *)data;
    uint32_t length = (uint32_t)size;
    socketcand_request request = {0};
    while (length > 0U) {
        const uint32_t taken = socketcand_read(text, length, &request);
        FUZZ_CHECK(taken <= length && request.kind <= SOCKETCAND_GARBAGE);
        if (request.kind == SOCKETCAND_INCOMPLETE) {
            break;
        }
        FUZZ_CHECK(taken > 0U);
        if (request.kind == SOCKETCAND_SEND) {
            char written[SOCKETCAND_FRAME_MAX];
            FUZZ_CHECK(request.frame.dlc <= CAN_DATA_MAX);
            const uint32_t count = socketcand_write(written, &request.frame, 1700000000123456U);
            FUZZ_CHECK(count < SOCKETCAND_FRAME_MAX && strlen(written) == count);
        }
        FUZZ_CHECK(request.kind != SOCKETCAND_OPEN || request.bus < CAN_BUS_COUNT);
        text += taken;
        length -= taken;
    }
    return 0;
}
