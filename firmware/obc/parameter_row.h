/* Rows of the generated parameter table (generated/parameter_table.h, from firmware/schema/parameters.yaml). */
#ifndef RACELOOP_OBC_PARAMETER_ROW_H
#define RACELOOP_OBC_PARAMETER_ROW_H

#include <stdint.h>

/* Types on the wire; the numbers are those of parameter_write.write_type. */
enum parameter_type {
    PARAMETER_FLOAT = 0,
    PARAMETER_INT = 1,
    PARAMETER_BOOL = 2,
    PARAMETER_TEXT = 3, /* not carried: the sender says that the user gave text */
    PARAMETER_NULL = 4, /* not carried: the user gave nothing */
};

/* A parameter's value. Both members are always filled in. */
typedef struct parameter_value {
    float real;      /* the number, in the unit of its row */
    int32_t integer; /* the number of an INT or BOOL (0, 1); 0 for a FLOAT */
} parameter_value;

/* What is allowed for one parameter. */
typedef struct parameter_row {
    uint32_t key; /* low 24 bits of the FNV-1a hash of the name; never 0 */
    uint8_t type; /* PARAMETER_FLOAT, PARAMETER_INT or PARAMETER_BOOL */
    int8_t sign;  /* 1: not below zero, -1: not above zero, 0: any */
    float minimum;
    float maximum;            /* below 2^24, so that every allowed integer is an exact float */
    parameter_value standard; /* in force until a configuration was accepted */
} parameter_row;

/* Rules between two parameters. */
enum parameter_rule {
    PARAMETER_RULE_LESS = 0,    /* left < right */
    PARAMETER_RULE_PRODUCT = 1, /* left * right >= bound */
};

/* One rule between two parameters. */
typedef struct parameter_cross_check {
    uint8_t rule;  /* enum parameter_rule */
    uint8_t left;  /* enum parameter_index */
    uint8_t right; /* enum parameter_index */
    float bound;
} parameter_cross_check;

#endif
