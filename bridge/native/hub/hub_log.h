/* Lines for people on standard error. */
#ifndef RACELOOP_HUB_LOG_H
#define RACELOOP_HUB_LOG_H

/* Write one line, "raceloop-hub: " before it; printf's formats. Never blocks: when standard error is a pipe that nobody
 * empties, the line is lost. Longer than 255 characters: cut. */
void hub_log(const char *format, ...) __attribute__((format(printf, 1, 2)));

#endif
