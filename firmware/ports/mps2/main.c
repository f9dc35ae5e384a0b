// SPDX-License-Identifier: MIT
//
// The amplifier on the board.

#include "board.h"
#include "loop.h"
#include "open.h"

int main(void)
{
    board_open();
    loop_init();
    for (;;) {
        loop_once();
        board_wait();
    }
}
