// SPDX-License-Identifier: MIT

#include "sine.h"

// sin(pi/2 x) for x from -1 to 1 as x (C1 + C3 x^2 + C5 x^4 + C7 x^6): the polynomial with the
// smallest error among those that are 1 at x = 1, so that a full sine reaches full stroke.
#define C1 INT32_C(1686623270)
#define C3 INT32_C(-693514909)
#define C5 INT32_C(85274806)
#define C7 INT32_C(-4641343)

int32_t sine(uint32_t angle)
{
    // The second and third quarter of a turn are those of the first and fourth, mirrored.
    if (angle - QUARTER_TURN < HALF_TURN)
        angle = HALF_TURN - angle;
    // What is left lies within a quarter of a turn on either side of zero; a quarter is ONE.
    int32_t x = angle < HALF_TURN ? (int32_t)angle : -(int32_t)(0u - angle);
    int32_t square = times(x, x);
    int32_t sum = times(square, C7) + C5;
    sum = times(square, sum) + C3;
    sum = times(square, sum) + C1;
    return times(x, sum);
}

uint32_t square_root(uint32_t x)
{
    uint32_t root = 0;
    for (uint32_t bit = UINT32_C(1) << 30; bit != 0; bit >>= 2) {
        if (x >= root + bit) {
            x -= root + bit;
            root = (root >> 1) + bit;
        } else {
            root >>= 1;
        }
    }
    return root;
}
