// SPDX-License-Identifier: MIT
//
// The library that Python loads: it starts the engine and has the callbacks for PortAudio. They use
// plain types in place of PortAudio's, which is not needed to build this.

#ifndef SOUND_H
#define SOUND_H

#include "engine.h"

#define SOUND_CHANNELS_MAX (AMPLIFIERS_MAX * CHANNELS_MAX)

// Start the engine of this process and its lines; 0, or the number of an error.
int sound_start(const struct sound_settings *settings, const struct lines_settings *lines,
                struct counters *counters);

// Fall silent along a ramp, before the stream is stopped.
void sound_end(void);

// End what begins with the first block: on Linux the kernel kills this process if no further block is
// rendered for 100 ms or the time of four blocks, whichever is longer. Call it before the stream stops.
void sound_release(void);

// PortAudio's callback, for interleaved floats.
struct portaudio_time {
    double input, now, output;
};
int sound_portaudio(const void *input, void *output, unsigned long frames,
                    const struct portaudio_time *time, unsigned long flags, void *ignored);

#endif
