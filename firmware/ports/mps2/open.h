// SPDX-License-Identifier: MIT

#ifndef OPEN_H
#define OPEN_H

// Start clock and lines.
void board_open(void);

// Interrupt of the lines.
void board_received(void);

#endif
