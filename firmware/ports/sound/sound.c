// SPDX-License-Identifier: MIT

#define _XOPEN_SOURCE 700

#include "sound.h"

#include <pthread.h>
#include <sched.h>
#include <string.h>

#define UNDERFLOW 0x4 // paOutputUnderflow
#define CONTINUE 0    // paContinue
#define PLAYBACK 1    // JackPlaybackLatency

static struct engine engine;
static struct jack_calls jack;
static uint32_t next_frame; // of JACK's clock
static double next_output;  // s, PortAudio's time of the next sample
static bool has_next;

int sound_start(const struct sound_settings *settings, const struct lines_settings *lines,
                struct counters *counters)
{
    return engine_init(&engine, settings, counters) < 0 ? -1 : lines_start(&engine, lines);
}

int sound_take_over(void)
{
    SET(engine.wants_stream, 1);
    return (int)GET(engine.has_stream);
}

void sound_end(void)
{
    SET(engine.is_ending, 1);
}

void sound_lost(void)
{
    SET(engine.counters->is_lost, 1);
}

static void note_priority(bool is_realtime)
{
    if (!has_next && is_realtime)
        __atomic_fetch_or(&engine.counters->is_realtime, 1, __ATOMIC_RELEASE);
    SET(engine.counters->is_streaming, 1);
}

// JACK.

void sound_use_jack(const struct jack_calls *calls)
{
    jack = *calls;
}

int sound_jack_process(uint32_t frames, void *ignored)
{
    (void)ignored;
    struct output outputs[SOUND_CHANNELS_MAX];
    for (unsigned i = 0; i < engine.settings.channels; i++) {
        outputs[i].samples = jack.buffer(jack.ports[i], frames);
        outputs[i].stride = 1;
    }
    if (!GET(engine.has_stream)) {
        for (unsigned i = 0; i < engine.settings.channels; i++)
            memset(outputs[i].samples, 0, frames * sizeof(float));
        return 0;
    }
    uint32_t frame = next_frame, latency[2] = {0, 0};
    uint64_t at = jack.time(), next;
    float period;
    jack.cycle_times(jack.client, &frame, &at, &next, &period); // filtered by the server
    jack.latency(jack.ports[0], PLAYBACK, latency);
    note_priority(!has_next && jack.is_realtime(jack.client));
    if (has_next && frame != next_frame)
        engine_gap(&engine, frame - next_frame);
    next_frame = frame + frames;
    has_next = true;
    double passed = ((double)jack.time() - (double)at) * engine.settings.rate / 1e6;
    engine_render(&engine, outputs, frames, latency[1] - passed);
    return 0;
}

int sound_jack_xrun(void *ignored)
{
    (void)ignored;
    COUNT(engine.counters->xruns, 1);
    return 0;
}

void sound_jack_shutdown(void *ignored)
{
    (void)ignored;
    sound_lost();
}

void sound_jack_connect(uint32_t a, uint32_t b, int is_connected, void *ignored)
{
    (void)ignored;
    (void)b;
    // The first is the source: one of ours that leads nowhere any more is as good as unplugged.
    if (!is_connected && jack.is_mine(jack.client, jack.port_by_id(jack.client, a)))
        sound_lost();
}

// PortAudio.

static bool is_realtime(void)
{
    int policy;
    struct sched_param parameters;
    return pthread_getschedparam(pthread_self(), &policy, &parameters) == 0 &&
           (policy == SCHED_FIFO || policy == SCHED_RR);
}

int sound_portaudio(const void *input, void *output, unsigned long frames,
                    const struct portaudio_time *time, unsigned long flags, void *ignored)
{
    (void)input;
    (void)ignored;
    struct output outputs[SOUND_CHANNELS_MAX];
    uint32_t channels = engine.settings.channels;
    if (flags & UNDERFLOW)
        COUNT(engine.counters->xruns, 1);
    if (!GET(engine.has_stream)) {
        memset(output, 0, frames * channels * sizeof(float));
        return CONTINUE;
    }
    note_priority(!has_next && is_realtime());
    double block = (double)frames / engine.settings.rate;
    double late = time->output - next_output;
    if (has_next && late > block) {
        engine_gap(&engine, (uint32_t)(late * engine.settings.rate));
        next_output = time->output + block;
    } else { // times of drivers jitter
        next_output = (has_next ? next_output + late / 8 : time->output) + block;
    }
    has_next = true;
    for (unsigned i = 0; i < channels; i++) {
        outputs[i].samples = (float *)output + i;
        outputs[i].stride = channels;
    }
    double ahead = (next_output - block - time->now) * engine.settings.rate;
    engine_render(&engine, outputs, (uint32_t)frames, ahead);
    return CONTINUE;
}
