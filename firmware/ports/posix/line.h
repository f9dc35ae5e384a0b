// SPDX-License-Identifier: MIT
//
// Lines of the POSIX port: pseudo-terminals, and one TCP connection at a time.

#ifndef LINE_H
#define LINE_H

#include <stdint.h>

// File descriptor to read and write without blocking, or exit with a message.
// `path` gets the name that a host opens.
int open_terminal(const char **path);

// File descriptor that listens at 127.0.0.1; port 0: any, told in `port`.
int listen_at(uint16_t *port);

// Microseconds of a clock that never goes back.
uint64_t microseconds(void);

void fail(const char *what);

#endif
