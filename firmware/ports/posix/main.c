// SPDX-License-Identifier: MIT
//
// The amplifier as a program.

#include "board.h"
#include "loop.h"
#include "modbus_tcp.h"
#include "options.h"

int main(int count, char **arguments)
{
    board_open(count, arguments);
    loop_init();
    for (;;) {
        loop_once();
        tcp_serve(loop_modbus());
        board_wait();
    }
}
