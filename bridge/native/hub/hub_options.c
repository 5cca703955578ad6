#include "hub_options.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { WORD_MAX = 16 }; /* longer than any; a longer one is cut and matches none */

const char *hub_options_help(void)
{
    return "  --local PATH   socket for raceloop's stations\n"
           "  --port N       port on 127.0.0.1 for socketcand clients; 0: any free one\n"
           "  --priority N   SCHED_FIFO priority, 1 to 99 (default: none)\n"
           "  --cpu N        processor to run on (default: any)\n"
           "  --with-parent  stop when the parent process ends\n";
}

static int32_t take_number(const char *word, const char *value, long minimum, long maximum, int32_t *number,
                           char *mistake)
{
    char *end;
    errno = 0;
    const long parsed = strtol(value, &end, 10);
    if (errno != 0 || end == value || *end != '\0' || parsed < minimum || parsed > maximum) {
        (void)snprintf(mistake, HUB_MISTAKE_MAX, "%s %s: allowed is a whole number, %ld to %ld", word, value, minimum,
                       maximum);
        return EINVAL;
    }
    *number = (int32_t)parsed;
    return 0;
}

static bool takes_value(const char *word)
{
    static const char *const WORDS[] = {"--local", "--port", "--priority", "--cpu"};
    for (size_t i = 0; i < sizeof WORDS / sizeof WORDS[0]; i++) {
        if (strcmp(word, WORDS[i]) == 0) {
            return true;
        }
    }
    return false;
}

static int32_t take(hub_options *self, const char *word, const char *value, char *mistake)
{
    if (strcmp(word, "--local") == 0) {
        self->local = value;
        return 0;
    }
    if (strcmp(word, "--port") == 0) {
        return take_number(word, value, 0, 65535, &self->port, mistake);
    }
    if (strcmp(word, "--priority") == 0) {
        return take_number(word, value, 1, 99, &self->priority, mistake);
    }
    return take_number(word, value, 0, 1023, &self->cpu, mistake);
}

int32_t hub_options_parse(hub_options *self, int32_t argument_count, char *const *arguments, char *mistake)
{
    *self = (hub_options){.port = -1, .cpu = -1};
    mistake[0] = '\0';
    for (int32_t i = 1; i < argument_count; i++) {
        char word[WORD_MAX];
        const char *argument = arguments[i];
        const size_t length = strcspn(argument, "=");
        (void)snprintf(word, sizeof word, "%.*s", (int)length, argument);
        if (strcmp(argument, "--help") == 0) {
            self->help = true;
            return 0;
        }
        if (strcmp(argument, "--with-parent") == 0) {
            self->with_parent = true;
            continue;
        }
        if (!takes_value(word)) {
            (void)snprintf(mistake, HUB_MISTAKE_MAX, "unknown argument %s; --help lists what is allowed", argument);
            return EINVAL;
        }
        const bool apart = argument[length] == '\0'; /* --port N rather than --port=N */
        if (apart && i + 1 == argument_count) {
            (void)snprintf(mistake, HUB_MISTAKE_MAX, "%s needs a value; --help tells of what kind", argument);
            return EINVAL;
        }
        const int32_t error = take(self, word, apart ? arguments[++i] : &argument[length + 1U], mistake);
        if (error != 0) {
            return error;
        }
    }
    if (self->local == NULL && self->port < 0) {
        (void)snprintf(mistake, HUB_MISTAKE_MAX, "nothing to listen on: give --local PATH, --port N or both");
        return EINVAL;
    }
    return 0;
}
