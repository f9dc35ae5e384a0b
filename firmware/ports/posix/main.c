// SPDX-License-Identifier: MIT
//
// The amplifier as a program for this machine (board.c lists its options).

#include "board.h"
#include "loop.h"
#include "modbus_tcp.h"
#include "posix.h"

int main(int count, char **arguments)
{
    board_open(count, arguments);
    loop_init();
    for (;;) {
        bool is_idle = loop_once();
        tcp_serve(loop_modbus(), loop_samples);
        if (is_idle)
            board_wait();
    }
}
