// SPDX-License-Identifier: MIT
//
// The library that Python loads: it starts the engine, and hands the addresses of the callbacks to
// PortAudio or JACK. The callbacks have the types of those libraries in plain ones, so that neither
// is needed to build this.

#ifndef SOUND_H
#define SOUND_H

#include "engine.h"

#define SOUND_CHANNELS_MAX (AMPLIFIERS_MAX * CHANNELS_MAX)

// Start the engine of this process and its lines; 0, or the number of an error.
int sound_start(const struct sound_settings *settings, const struct lines_settings *lines,
                struct counters *counters);

// Hand the amplifiers over to the sound thread: 1 once that is done; call again until then.
int sound_take_over(void);

// Fall silent along a ramp, before the stream is stopped.
void sound_end(void);

// The device has gone.
void sound_lost(void);

// What libjack gives, called from its thread.
struct jack_calls {
    void *client;
    void *ports[SOUND_CHANNELS_MAX];
    void *(*buffer)(void *port, uint32_t frames);
    int (*cycle_times)(const void *client, uint32_t *frame, uint64_t *at, uint64_t *next,
                       float *period);
    uint64_t (*time)(void); // us
    void (*latency)(void *port, int mode, uint32_t range[2]);
    int (*is_realtime)(void *client);
    void *(*port_by_id)(void *client, uint32_t id);
    int (*is_mine)(const void *client, const void *port);
};
void sound_use_jack(const struct jack_calls *calls);
int sound_jack_process(uint32_t frames, void *ignored);
int sound_jack_xrun(void *ignored);
void sound_jack_shutdown(void *ignored);
void sound_jack_connect(uint32_t a, uint32_t b, int is_connected, void *ignored);

// PortAudio's callback, for interleaved floats.
struct portaudio_time {
    double input, now, output;
};
int sound_portaudio(const void *input, void *output, unsigned long frames,
                    const struct portaudio_time *time, unsigned long flags, void *ignored);

#endif
