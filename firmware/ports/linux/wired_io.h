/* Wires between the plant and the two actuator ECUs when each is a process: a file in shared memory.
 *
 * Like wires, it holds the newest values and nothing else. Each direction of each ECU is a cell with one writer; a
 * reader never waits for it: a cell that is being written keeps its last value for the reader.
 */
#ifndef RACELOOP_PORT_WIRED_IO_H
#define RACELOOP_PORT_WIRED_IO_H

#include <stdbool.h>
#include <stdint.h>

#include "raptor/raptor.h"
#include "space_drive/space_drive.h"

enum {
    WIRED_IO_MAGIC = 0x45524957, /* "WIRE" */
    WIRED_IO_VERSION = 1,
};

/* The cells. */
enum wired_cell {
    WIRED_RAPTOR_IN = 0,       /* raptor_wired_in, written by the plant */
    WIRED_RAPTOR_OUT = 1,      /* raptor_wired_out, written by the Raptor */
    WIRED_SPACE_DRIVE_IN = 2,  /* space_drive_wired_in, written by the plant */
    WIRED_SPACE_DRIVE_OUT = 3, /* space_drive_wired_out, written by the Space Drive */
    WIRED_CELLS = 4,
};

/* An attachment: zero it before opening. */
typedef struct wired_io {
    void *memory; /* null: closed */
} wired_io;

/* Create the file at `path` (all cells unwritten), or attach to an existing one. Returns 0 or an errno; EPROTO for a
 * file that is none of ours. */
int32_t wired_io_create(wired_io *self, const char *path);
int32_t wired_io_open(wired_io *self, const char *path);

/* Write the struct of a cell; now_ns: CLOCK_MONOTONIC. One writer per cell. cell: enum wired_cell. */
void wired_io_write(wired_io *self, uint32_t cell, const void *value, uint64_t now_ns);

/* Read the struct of a cell. Returns the time of writing in ns, or 0 when it was never written or is being
 * written at every attempt; then `value` is left as it was. */
uint64_t wired_io_read(const wired_io *self, uint32_t cell, void *value);

/* Detach; the file stays. */
void wired_io_close(wired_io *self);

#endif
