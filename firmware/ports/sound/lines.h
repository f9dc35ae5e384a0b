// SPDX-License-Identifier: MIT
//
// The lines of a software amplifier: a thread that carries bytes between hosts and the engine.

#ifndef LINES_H
#define LINES_H

#include "engine.h"

struct lines_settings {
    int terminal;  // descriptor of a pseudo-terminal, or -1
    int listening; // descriptor of a socket that listens, or -1
    int parent;    // end of a pipe that closes when the process that watches ends: so does this one
};

// Start the thread; return 0, or the number of an error.
int lines_start(struct engine *engine, const struct lines_settings *settings);

#endif
