// SPDX-License-Identifier: MIT

#ifndef REPLAY_H
#define REPLAY_H

// Carry out a script for ever; see replay.c.
void replay(void);

#endif
