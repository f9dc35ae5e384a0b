// SPDX-License-Identifier: MIT
//
// What this board has beside the functions of every board.

#ifndef POSIX_H
#define POSIX_H

// Open the lines that the options of the program name, and print their URLs; ends it where that fails.
void board_open(int count, char **arguments);

#endif
