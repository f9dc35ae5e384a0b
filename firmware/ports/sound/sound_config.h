// SPDX-License-Identifier: MIT
//
// The amplifier made of software: what core/config.h is for a board, with channels, sample rate and
// highest level as they are when it starts.

#ifndef SOUND_CONFIG_H
#define SOUND_CONFIG_H

struct sound_format {
    uint32_t rate;      // samples per second, a multiple of 1000
    uint8_t channels;   // of each amplifier
    uint16_t level_max; // 0.0001 of full stroke
};
extern struct sound_format sound_format;

#define VENDOR "ERA haptics"
#define PRODUCT "Software amplifier"
#define FIRMWARE_VERSION "1.0"

#define CHANNELS (sound_format.channels)
#define CHANNELS_MAX 16
#define SAMPLE_RATE (sound_format.rate)
#define SAMPLES_PER_MS (SAMPLE_RATE / 1000)

#define FEATURES 0x019E // watchdog, staging, valid_for, phase, voltage, broadcast

#define FREQUENCY_MIN (20 * FREQUENCY_PER_HZ)
#define FREQUENCY_MAX (2000 * FREQUENCY_PER_HZ)
#define LEVEL_MAX (sound_format.level_max)
#define VOICES 8
#define SQUARE_LAW 0 // the law is applied to what amplifier_forces makes
#define WATCHDOG_MIN 100
#define WATCHDOG_MAX 2000

#define ENVELOPE_SLOTS 16
#define ENVELOPE_KNOTS 32
#define ENVELOPE_STEP_MIN 10
#define ENVELOPE_STEP_MAX 1000

#define FAULTS_KEPT 8

#endif
