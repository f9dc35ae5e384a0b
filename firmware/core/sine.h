// SPDX-License-Identifier: MIT
//
// Fixed-point arithmetic of the synthesis: no floating point, so that every processor computes the
// same samples, bit for bit.

#ifndef SINE_H
#define SINE_H

#include <stdint.h>

// A gain or an amplitude: an integer in units of 2^-30, so that ONE is 1.0.
#define ONE (INT32_C(1) << 30)

// An angle is a fraction of a turn in units of 2^-32; it wraps by itself.
#define HALF_TURN UINT32_C(0x80000000)
#define QUARTER_TURN UINT32_C(0x40000000)

// Product of two numbers in units of 2^-30, rounded down. Like every compiler for small processors,
// those that we know shift negative numbers arithmetically.
static inline int32_t times(int32_t a, int32_t b)
{
#if defined __ARM_ARCH_6M__ // products have 32 bits: the same result by four products of halves
    int32_t a_high = a >> 16, b_high = b >> 16, a_low = a & 0xFFFF, b_low = b & 0xFFFF;
    int32_t left = a_high * b_low + (int32_t)((uint32_t)a_low * (uint32_t)b_low >> 16);
    int32_t right = a_low * b_high;
    int32_t carry = ((left & 0x3FFF) + (right & 0x3FFF)) >> 14; // of the lowest bits that count
    uint32_t high = (uint32_t)(a_high * b_high) << 2;
    return (int32_t)(high + (uint32_t)((left >> 14) + (right >> 14) + carry));
#else
    return (int32_t)(((int64_t)a * b) >> 30);
#endif
}

// Sine of an angle; the error is at most 7e-7 (-123 dB).
int32_t sine(uint32_t angle);

static inline int32_t cosine(uint32_t angle)
{
    return sine(angle + QUARTER_TURN);
}

// Raised cosine from 0 to ONE while `along` goes from 0 to a whole turn.
static inline int32_t raised_cosine(uint32_t along)
{
    return (ONE - cosine(along >> 1)) >> 1;
}

// Largest integer whose square is not above x.
uint32_t square_root(uint32_t x);

#endif
