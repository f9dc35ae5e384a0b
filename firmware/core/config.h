// SPDX-License-Identifier: MIT
//
// What this amplifier is and can do: edit this file for another product. It is all that GetCaps,
// the capability registers and the capability objects report.

#ifndef CONFIG_H
#define CONFIG_H

#include "protocol.h"

// A product may bring a file of its own instead: -DCONFIG_FILE='"its_config.h"'.
#ifdef CONFIG_FILE
#include CONFIG_FILE
#else

#define VENDOR "ERA haptics"
#define PRODUCT "Example firmware"
#define FIRMWARE_VERSION "1.0"

#define CHANNELS 4
#define CHANNELS_MAX CHANNELS // a constant, for memory
#define SAMPLE_RATE 16000 // per second and channel; a multiple of 1000
#define SAMPLES_PER_MS (SAMPLE_RATE / 1000)

// Watchdog, staging, valid_for, phase, broadcast, interlock, address; it sends no events.
#define FEATURES 0x093E

#define FREQUENCY_MIN (20 * FREQUENCY_PER_HZ)
#define FREQUENCY_MAX (2000 * FREQUENCY_PER_HZ) // at most a quarter of the sample rate
#define LEVEL_MAX FULL_STROKE
#define VOICES 2 // oscillators of a channel, 2 to 255
// 1: samples are voltages of an electrostatic actuator, whose force goes with their square: the
// root of a bias plus the summed force of the voices. 0: samples are forces.
#ifndef SQUARE_LAW
#define SQUARE_LAW 0
#endif
#define WATCHDOG_MIN 100
#define WATCHDOG_MAX 2000

#define ENVELOPE_SLOTS 16
#define ENVELOPE_KNOTS 32
#define ENVELOPE_STEP_MIN 10
#define ENVELOPE_STEP_MAX 1000

#define FAULTS_KEPT 8

#endif

#endif
