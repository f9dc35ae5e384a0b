// SPDX-License-Identifier: MIT

#define _XOPEN_SOURCE 700

#include "sound.h"

#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <sched.h>
#include <signal.h>
#include <time.h>

#define UNDERFLOW 0x4    // paOutputUnderflow
#define CONTINUE 0       // paContinue
#define STALL 100        // ms
#define STALLED_BLOCKS 4 // that a stall lasts at least

static struct engine engine;
static double next_output; // s, PortAudio's time of the next sample
static bool has_next;
static uint32_t is_released;

// The timer of the kernel that kills a process whose sound thread stalls. A process that was stopped
// by a signal or a debugger cannot end itself, and sound servers may repeat its last block for ever.

#ifdef __linux__
static timer_t stall_timer;

static int stall_timer_init(void)
{
    struct sigevent event = {.sigev_notify = SIGEV_SIGNAL, .sigev_signo = SIGKILL};
    return timer_create(CLOCK_MONOTONIC, &event, &stall_timer) < 0 ? errno : 0;
}

static void stall_timer_set(uint64_t milliseconds)
{
    struct itimerspec when = {.it_value = {.tv_sec = (time_t)(milliseconds / 1000),
                                           .tv_nsec = (long)(milliseconds % 1000 * 1000000)}};
    timer_settime(stall_timer, 0, &when, NULL);
}
#else
static int stall_timer_init(void)
{
    return 0;
}

static void stall_timer_set(uint64_t milliseconds)
{
    (void)milliseconds;
}
#endif

static void renew_stall_timer(unsigned long frames)
{
    uint64_t blocks = STALLED_BLOCKS * UINT64_C(1000) * frames / engine.settings.rate;
    if (GET(is_released))
        return;
    stall_timer_set(blocks > STALL ? blocks : STALL);
    if (GET(is_released)) // meanwhile
        stall_timer_set(0);
}

void sound_release(void)
{
    SET(is_released, 1);
    stall_timer_set(0);
}

int sound_start(const struct sound_settings *settings, const struct lines_settings *lines,
                struct counters *counters)
{
    if (engine_init(&engine, settings, counters) < 0)
        return errno;
    int problem = stall_timer_init();
    return problem ? problem : lines_start(&engine, lines);
}

void sound_end(void)
{
    SET(engine.is_ending, 1);
}

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
    if (!has_next && is_realtime())
        SET(engine.counters->is_realtime, 1);
    double block = (double)frames / engine.settings.rate;
    double late = time->output - next_output;
    if (has_next && late > block) {
        engine_gap(&engine, (uint32_t)lround(late * engine.settings.rate));
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
    renew_stall_timer(frames);
    return CONTINUE;
}
