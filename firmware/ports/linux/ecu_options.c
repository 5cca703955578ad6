#include "ports/linux/ecu_options.h"

#include <errno.h>
#include <stdio.h>
#include <string.h>

#include "generated/codec_table.h"
#include "generated/codec_values_table.h"

enum {
    NAME_MAX_LENGTH = 16,
    DEFAULT_CYCLES = 60000, /* ten minutes at 100 Hz */
};

static const uint64_t NS_PER_MINUTE = 60000000000U;

static const char *const bus_names[CAN_BUS_COUNT] = {
    [CAN_BUS_1] = "CAN1", [CAN_BUS_3] = "CAN3", [CAN_BUS_A] = "CANA", [CAN_BUS_S] = "CANS", [CAN_BUS_R] = "CANR"};

/* A word with a value. */
typedef struct option_row {
    const char *name;
    int32_t (*take)(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake);
} option_row;

const char *ecu_bus_name(uint32_t bus)
{
    return bus < CAN_BUS_COUNT ? bus_names[bus] : "?";
}

static int32_t refuse(char *mistake, const char *name, const char *value, const char *allowed)
{
    (void)snprintf(mistake, ECU_MISTAKE_MAX, "--%s %s: %s", name, value, allowed);
    return EINVAL;
}

/* A decimal number without sign. Returns false when it is none or does not fit. */
static bool read_number(const char *text, uint64_t *number)
{
    *number = 0U;
    for (const char *digit = text; *digit != '\0'; digit++) {
        const uint64_t value = (uint64_t)(unsigned char)*digit - (uint64_t)'0';
        if (value > 9U || *number > (UINT64_MAX - value) / 10U) {
            return false;
        }
        *number = *number * 10U + value;
    }
    return *text != '\0';
}

static int32_t take_number(const char *name, const char *value, uint64_t minimum, uint64_t maximum, uint64_t *number,
                           char *mistake)
{
    if (read_number(value, number) && *number >= minimum && *number <= maximum) {
        return 0;
    }
    char allowed[64];
    (void)snprintf(allowed, sizeof allowed, "allowed is a whole number, %llu to %llu", (unsigned long long)minimum,
                   (unsigned long long)maximum);
    return refuse(mistake, name, value, allowed);
}

/* --- one function per word --- */

static int32_t take_bus(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    const size_t length = strcspn(value, "=");
    char allowed[64] = "allowed is NAME=ADDRESS, NAME one of";
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        if ((sockets->buses >> bus & 1U) == 0U) {
            continue;
        }
        if (length == strlen(bus_names[bus]) && strncmp(value, bus_names[bus], length) == 0 && value[length] == '=') {
            if (self->addresses[bus] != NULL) {
                return refuse(mistake, "bus", value, "this bus is given twice");
            }
            self->addresses[bus] = &value[length + 1U];
            return 0;
        }
        const size_t end = strlen(allowed);
        (void)snprintf(&allowed[end], sizeof allowed - end, " %s", bus_names[bus]);
    }
    return refuse(mistake, "bus", value, allowed);
}

static int32_t take_epoch(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    const uint64_t now_ns = self->epoch_ns;
    const uint64_t latest_ns = now_ns + NS_PER_MINUTE;
    return take_number("epoch", value, 0U, latest_ns, &self->epoch_ns, mistake);
}

static int32_t take_phase(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    return take_number("phase", value, 0U, 1000000U, &self->phase_us, mistake);
}

static int32_t take_period(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    return take_number("period", value, 1000U, 1000000U, &self->period_us, mistake);
}

static int32_t take_priority(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    uint64_t number = 0U;
    const int32_t error = take_number("priority", value, 1U, 99U, &number, mistake);
    self->priority = (int32_t)number;
    return error;
}

static int32_t take_cpu(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    uint64_t number = 0U;
    const int32_t error = take_number("cpu", value, 0U, 1023U, &number, mistake);
    self->cpu = (int32_t)number;
    return error;
}

static int32_t take_wired(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    if (!sockets->wires) {
        return refuse(mistake, "wired", value, "this ECU has no wires to the plant");
    }
    self->wired = value;
    return 0;
}

static int32_t take_cycle_log(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    (void)mistake;
    self->cycle_log = value;
    return 0;
}

static int32_t take_cycles(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    (void)sockets;
    uint64_t number = 0U;
    const int32_t error = take_number("cycles", value, 1U, 10000000U, &number, mistake);
    self->cycles = (uint32_t)number;
    return error;
}

static int32_t take_profile(ecu_options *self, const ecu_sockets *sockets, const char *value, char *mistake)
{
    if ((sockets->buses >> CAN_BUS_1 & 1U) == 0U) {
        return refuse(mistake, "profile", value, "this ECU is not on CAN1");
    }
    char allowed[64] = "allowed is one of";
    for (uint8_t i = 0U; i < CODEC_PROFILE_COUNT; i++) {
        const char *name = codec_values_profiles[i].name;
        if (strcmp(value, name) == 0) {
            self->profile = i;
            return 0;
        }
        const size_t end = strlen(allowed);
        (void)snprintf(&allowed[end], sizeof allowed - end, " %s", name);
    }
    return refuse(mistake, "profile", value, allowed);
}

static const option_row rows[] = {
    {"bus", take_bus},           {"epoch", take_epoch},     {"phase", take_phase}, {"period", take_period},
    {"priority", take_priority}, {"cpu", take_cpu},         {"wired", take_wired}, {"cycle-log", take_cycle_log},
    {"cycles", take_cycles},     {"profile", take_profile},
};

const char *ecu_options_help(void)
{
    return "  --bus NAME=ADDRESS  attach to a bus; ADDRESS is socketcan:INTERFACE or hub:PATH; once per bus\n"
           "  --epoch NS          start of the run on CLOCK_MONOTONIC (default: now)\n"
           "  --phase US          when a cycle begins after the epoch (default: 0)\n"
           "  --period US         time between cycles (default: 10000); each is one frame of 10 ms to the firmware\n"
           "  --priority N        SCHED_FIFO priority, 1 to 99 (default: none)\n"
           "  --cpu N             processor to run on (default: any)\n"
           "  --wired FILE        wires to the plant (Raptor and Space Drive)\n"
           "  --cycle-log FILE    write what each cycle took\n"
           "  --cycles N          cycles that the log keeps (default: 60000)\n"
           "  --profile NAME      layout of CAN1: V14 or V26 (default: V14)\n"
           "  --with-parent       stop when the parent process ends\n";
}

/* --- the command line --- */

/* Row of an argument `--name` or `--name=value`, or null. value: receives what follows the sign, or null. */
static const option_row *find_row(const char *argument, const char **value)
{
    const size_t length = strcspn(argument, "=");
    *value = argument[length] == '=' ? &argument[length + 1U] : NULL;
    for (size_t i = 0U; i < sizeof rows / sizeof rows[0] && length > 2U && length < NAME_MAX_LENGTH; i++) {
        const size_t name = strlen(rows[i].name);
        if (strncmp(argument, "--", 2U) == 0 && name == length - 2U && strncmp(&argument[2], rows[i].name, name) == 0) {
            return &rows[i];
        }
    }
    return NULL;
}

static bool any_bus(const ecu_options *self)
{
    for (uint32_t bus = 0U; bus < CAN_BUS_COUNT; bus++) {
        if (self->addresses[bus] != NULL) {
            return true;
        }
    }
    return false;
}

int32_t ecu_options_parse(ecu_options *self, const ecu_sockets *sockets, uint64_t now_ns, uint32_t argument_count,
                          char *const *arguments, char *mistake)
{
    *self = (ecu_options){.epoch_ns = now_ns, .period_us = 10000U, .cycles = DEFAULT_CYCLES, .cpu = -1};
    mistake[0] = '\0';
    for (uint32_t i = 0U; i < argument_count; i++) {
        const char *argument = arguments[i];
        const char *value = NULL;
        if (strcmp(argument, "--help") == 0) {
            self->help = true;
            return 0;
        }
        if (strcmp(argument, "--with-parent") == 0) {
            self->with_parent = true;
            continue;
        }
        const option_row *row = find_row(argument, &value);
        if (row == NULL) {
            (void)snprintf(mistake, ECU_MISTAKE_MAX, "unknown argument %s; --help lists what is allowed", argument);
            return EINVAL;
        }
        if (value == NULL && i + 1U == argument_count) {
            (void)snprintf(mistake, ECU_MISTAKE_MAX, "%s needs a value; --help tells of what kind", argument);
            return EINVAL;
        }
        const int32_t error = row->take(self, sockets, value != NULL ? value : arguments[++i], mistake);
        if (error != 0) {
            return error;
        }
    }
    if (!any_bus(self)) {
        (void)snprintf(mistake, ECU_MISTAKE_MAX, "no bus: give --bus NAME=ADDRESS; --help says more");
        return EINVAL;
    }
    return 0;
}
