#define _GNU_SOURCE /* program_invocation_short_name */

#include "ports/linux/process_log.h"

#include <errno.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

enum { LINE_MAX_CHARACTERS = 384 };

void process_log(const char *format, ...)
{
    char line[LINE_MAX_CHARACTERS + 1];
    (void)snprintf(line, LINE_MAX_CHARACTERS, "%s: ", program_invocation_short_name);
    const size_t prefix = strlen(line);
    va_list arguments;
    va_start(arguments, format);
    (void)vsnprintf(&line[prefix], LINE_MAX_CHARACTERS - prefix, format, arguments);
    va_end(arguments);
    const size_t length = strlen(line);
    line[length] = '\n';
    struct pollfd ready = {.fd = STDERR_FILENO, .events = POLLOUT};
    /* A pipe is ready when PIPE_BUF bytes fit, more than a line. */
    if (poll(&ready, 1, 0) == 1 && (ready.revents & POLLOUT) != 0) {
        (void)!write(STDERR_FILENO, line, length + 1U);
    }
}
