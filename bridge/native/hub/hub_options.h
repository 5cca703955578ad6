/* The hub's command line. */
#ifndef RACELOOP_HUB_OPTIONS_H
#define RACELOOP_HUB_OPTIONS_H

#include <stdbool.h>
#include <stdint.h>

enum { HUB_MISTAKE_MAX = 256 };

/* Choices of the user. Strings belong to the caller of the parser. */
typedef struct hub_options {
    const char *local; /* null: no local socket */
    int32_t port;      /* 0..65535, 0 for any free one; -1: no TCP */
    int32_t priority;  /* SCHED_FIFO 1..99; 0: none */
    int32_t cpu;       /* 0..1023; -1: any */
    bool with_parent;  /* stop when the parent ends */
    bool help;         /* nothing else counts */
} hub_options;

/* Parse. arguments: argument_count of them and a null, the program's name first. Returns 0, or EINVAL with one line in
 * mistake, of HUB_MISTAKE_MAX bytes, that says what is wrong and what is allowed. */
int32_t hub_options_parse(hub_options *self, int32_t argument_count, char *const *arguments, char *mistake);

/* The words, one a line with its meaning. Static storage. */
const char *hub_options_help(void);

#endif
