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
        bool is_idle = loop_once();
        board_feed_watchdog();
        if (is_idle)
            board_wait();
    }
}
