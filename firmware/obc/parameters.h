/* Operation parameters: validation of a configuration that arrives over CAN-A, and the set in force (SSM-1, SSM-2).
 *
 * Parameters arrive one by one; a commit ends the configuration. Every write and every rule gets a verdict of its
 * own, and the set in force is replaced only when all of them are good. Until then the table's standard values hold.
 */
#ifndef RACELOOP_OBC_PARAMETERS_H
#define RACELOOP_OBC_PARAMETERS_H

#include <stdbool.h>
#include <stdint.h>

#include "generated/parameter_table.h"

enum {
    /* More than one commit can give rise to; a sender may have that many writes unanswered. */
    PARAMETERS_RESULTS_MAX = 256,
};

/* Verdict on one write or rule; the numbers are those of parameter_result.result_status. */
enum parameter_status {
    PARAMETER_ACCEPTED = 0,
    PARAMETER_UNKNOWN_KEY = 1,
    PARAMETER_WRONG_TYPE = 2,
    PARAMETER_NOT_FINITE = 3,
    PARAMETER_BELOW_MINIMUM = 4,
    PARAMETER_ABOVE_MAXIMUM = 5,
    PARAMETER_WRONG_SIGN = 6,
    PARAMETER_DUPLICATE = 7,
    PARAMETER_MISSING = 8,
    PARAMETER_CROSS_CHECK = 9,      /* value: index of the rule in parameter_cross_checks */
    PARAMETER_LATE = 10,            /* after the commit */
    PARAMETER_COUNT_MISMATCH = 11,  /* key 0; value: writes that arrived */
    PARAMETER_SCHEMA_MISMATCH = 12, /* key 0; value: the firmware's schema hash */
};

/* Verdict on the whole configuration; the numbers are those of parameter_summary.summary_verdict. */
enum parameter_verdict {
    PARAMETER_VERDICT_PENDING = 0,
    PARAMETER_VERDICT_ACCEPTED = 1,
    PARAMETER_VERDICT_REJECTED = 2,
};

/* One verdict to be told to the operator. */
typedef struct parameter_result {
    uint32_t key;   /* as written; 0: the configuration as a whole */
    uint32_t value; /* as written, if the status says nothing else */
    uint8_t status; /* enum parameter_status */
} parameter_result;

/* Validator and the set in force. parameters_init starts it. */
typedef struct parameters {
    parameter_value active[PARAMETER_COUNT]; /* in force */
    parameter_value staged[PARAMETER_COUNT]; /* of the configuration that is arriving */
    bool given[PARAMETER_COUNT];             /* was written, well or badly */
    bool valid[PARAMETER_COUNT];             /* `staged` holds an allowed value */
    uint8_t verdict;                         /* enum parameter_verdict */
    uint16_t writes;                         /* before the commit */
    uint16_t accepted;
    uint16_t rejected; /* writes, rules and whole-configuration checks that failed */
    uint16_t missing;
    uint16_t late; /* writes and commits after the verdict */
    uint16_t results_lost;
    uint16_t result_first;
    uint16_t result_count;
    parameter_result results[PARAMETERS_RESULTS_MAX];
} parameters;

/* Start without a configuration: the table's standard values are in force. */
void parameters_init(parameters *self);

/* Take one parameter_write. key: 24 bits. type: enum parameter_type, anything else is a wrong type.
 * raw: IEEE 754 single, two's complement or 0/1, by type. */
void parameters_write(parameters *self, uint32_t key, uint8_t type, uint32_t raw);

/* Take parameter_commit and decide. count: writes that the sender sent. schema: hash of its schema. */
void parameters_commit(parameters *self, uint16_t count, uint32_t schema);

/* Take the oldest verdict that was not told yet. Returns false when there is none. */
bool parameters_next_result(parameters *self, parameter_result *result);

/* Check one written value against its row (SSM-1: type, sign, range).
 * value: receives the number when the type fits; it is allowed only if PARAMETER_ACCEPTED is returned. */
uint8_t parameters_check(const parameter_row *row, uint8_t type, uint32_t raw, parameter_value *value);

/* The value in force, in the unit of its row. index: enum parameter_index below PARAMETER_COUNT. */
float parameters_real(const parameters *self, uint32_t index);
int32_t parameters_integer(const parameters *self, uint32_t index);

#endif
