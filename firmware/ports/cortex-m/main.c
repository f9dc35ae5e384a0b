// SPDX-License-Identifier: MIT
//
// The amplifier on bare metal.

#include "board.h"
#include "loop.h"
#include "cortex_m.h"

int main(void)
{
    board_open();
    loop_init();
    for (;;) {
        loop_once();
        board_feed_watchdog();
        board_wait();
    }
}
