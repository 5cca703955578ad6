/* Lines of a process for people, on standard error. */
#ifndef RACELOOP_PORT_PROCESS_LOG_H
#define RACELOOP_PORT_PROCESS_LOG_H

/* Write one line with the program's name before it; printf's formats. Never blocks: when standard error is a pipe that
 * nobody empties, the line is lost. Longer than 383 characters: cut. */
void process_log(const char *format, ...) __attribute__((format(printf, 1, 2)));

#endif
