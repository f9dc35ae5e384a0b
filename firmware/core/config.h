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

// Memory goes with channels, layers, voices, knots and the words of a set: 1 to 16 channels, 4 to 16
// layers, at least 8 voices of each channel and 512 words.
#ifndef CHANNELS
#define CHANNELS 4
#endif
#define CHANNELS_MAX CHANNELS // a constant, for memory
#ifdef SMALLEST
#define LAYERS 4
#define VOICES 8
#define STREAM_WORDS 512
#else
#define LAYERS 8
#define VOICES 16
#define STREAM_WORDS 1024 // of a set
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
