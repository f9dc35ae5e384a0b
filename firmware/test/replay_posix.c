// SPDX-License-Identifier: MIT

#include "options.h"
#include "replay.h"

int main(int count, char **arguments)
{
    board_open(count, arguments);
    replay();
}
