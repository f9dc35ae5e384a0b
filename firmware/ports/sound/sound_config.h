// SPDX-License-Identifier: MIT
//
// The amplifier made of software: what core/config.h is for a board, with channels, sample rate and
// highest level as they are when it starts.

#ifndef SOUND_CONFIG_H
#define SOUND_CONFIG_H

struct sound_format {
    uint32_t rate;      // samples per second, a multiple of 1000
    uint8_t channels;   // of each amplifier
    bool is_shared;     // two amplifiers are on the line
    uint16_t level_max; // 0.0001 of full level
};
extern struct sound_format sound_format;

#define VENDOR "ERA haptics"
#define PRODUCT "Software amplifier"
#define FIRMWARE_VERSION "2.0"

#define CHANNELS (sound_format.channels)
#define CHANNELS_MAX 16
#define LAYERS 8
#define VOICES 16
#define STREAM_WORDS 4096
#define ENVELOPE_KNOTS 32

#define SAMPLE_RATE (sound_format.rate)
#define SAMPLES_PER_MS (SAMPLE_RATE / 1000)

#define SERIAL_IS_SHARED (sound_format.is_shared)
#define FEATURES (FEATURE_OUTPUT | FEATURE_EVENTS)

#define FREQUENCY_MIN (20 * FREQUENCY_PER_UNIT)
#define FREQUENCY_MAX (2000 * FREQUENCY_PER_UNIT)
#define LEVEL_MAX (sound_format.level_max)
#define SQUARE_LAW 0 // the law is applied to what amplifier_forces makes
#define RAMP_MAX WIRE_RAMP_MAX
#define WATCHDOG_MIN WIRE_WATCHDOG_MIN
#define WATCHDOG_MAX WIRE_WATCHDOG_MAX
#define ENVELOPE_STEP_MIN 10
#define ENVELOPE_STEP_MAX WIRE_ENVELOPE_STEP_MAX

#define LATE_MAX 4 // of the main loop on boards, which is not used here
#define CLOCK_ERROR 65535 // not known: times of servers and drivers were not measured on a card

#define FAULTS_KEPT 16

#endif
