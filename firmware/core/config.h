// SPDX-License-Identifier: MIT
//
// What this amplifier is and can do: edit this file for another product. It is all that GetCaps
// reports.

#ifndef CONFIG_H
#define CONFIG_H

#include "protocol.h"

// A product may bring a file of its own instead: -DCONFIG_FILE='"its_config.h"'.
#ifdef CONFIG_FILE
#include CONFIG_FILE
#else

#define VENDOR "ERA haptics"
#define PRODUCT "Example firmware"
#define FIRMWARE_VERSION "2.0"

// Channels, layers, voices and set words determine memory and load: 1 to 16 channels, 4 to 16 layers,
// at least 8 voices of each channel and 512 words. The values below fit an RP2350 and an STM32G4 with
// all voices on their ramps (`make cost`). For an RP2040: 1 channel at 8 kHz.
//
// NOT_REAL_TIME: a program on a computer, in tests or in QEMU. It carries more, but can be paused.
#ifdef NOT_REAL_TIME
#define CHANNELS_DEFAULT 4
#define LATE_MAX 3000 // beyond any watchdog and ramp
#else
#define CHANNELS_DEFAULT 2
#endif
#ifndef CHANNELS
#define CHANNELS CHANNELS_DEFAULT
#endif
#define CHANNELS_MAX CHANNELS // a constant, for memory
#if defined NOT_REAL_TIME && !defined SMALLEST
#define LAYERS 8
#define VOICES 16
#define STREAM_WORDS 1024 // of a set
#endif
#ifndef LAYERS
#define LAYERS 4
#endif
#ifndef VOICES
#define VOICES 8
#endif
#ifndef STREAM_WORDS
#define STREAM_WORDS 512
#endif
#define ENVELOPE_KNOTS 32

#ifndef SAMPLE_RATE
#define SAMPLE_RATE 16000 // per second and channel; a multiple of 1000, at least 4000
#endif
#define SAMPLES_PER_MS (SAMPLE_RATE / 1000)

// 1: the serial line is shared with other amplifiers (RS-485), so that events are not sent there.
#define SERIAL_IS_SHARED 0
#define FEATURES (FEATURE_EVENTS | FEATURE_INTERLOCK | FEATURE_ADDRESS | FEATURE_MARK)

#define FREQUENCY_MIN (20 * FREQUENCY_PER_UNIT)
#define FREQUENCY_MAX (2000 * FREQUENCY_PER_UNIT) // at most a quarter of the sample rate
#define LEVEL_MAX WIRE_LEVEL_MAX
// 1: samples are voltages of an electrostatic actuator, whose force goes with their square: the
// root of a bias plus the summed force of the voices. 0: samples are forces.
#ifndef SQUARE_LAW
#define SQUARE_LAW 0
#endif
#define RAMP_MAX WIRE_RAMP_MAX
#define WATCHDOG_MIN WIRE_WATCHDOG_MIN
#define WATCHDOG_MAX WIRE_WATCHDOG_MAX
#define ENVELOPE_STEP_MIN 10
#define ENVELOPE_STEP_MAX WIRE_ENVELOPE_STEP_MAX

// ms by which samples can be late: beyond that the converter has run dry, which is a fault. Bytes are
// read at least every quarter of this time.
#ifndef LATE_MAX
#define LATE_MAX 4
#endif

#define CLOCK_ERROR 10 // 0.1 us; board_samples_due knows microseconds

#define FAULTS_KEPT 16

#endif

#endif
