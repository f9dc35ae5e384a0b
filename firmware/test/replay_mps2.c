// SPDX-License-Identifier: MIT

#include "open.h"
#include "replay.h"

int main(void)
{
    board_open();
    replay();
}
