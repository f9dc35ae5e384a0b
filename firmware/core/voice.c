// SPDX-License-Identifier: MIT

#include "voice.h"
#include "sine.h"

#define PHASE_TURN (360 * PHASE_PER_UNIT)
#define WHOLE (UINT64_C(1) << 32)

static struct complex amplitude_of(uint16_t level, int16_t phase)
{
    uint32_t turn = (uint32_t)(phase < 0 ? phase + PHASE_TURN : phase);
    uint32_t angle = (uint32_t)(((uint64_t)turn << 32) / PHASE_TURN);
    int32_t size = (int32_t)(((int64_t)level * ONE) / LEVEL_PER_UNIT);
    struct complex amplitude = {.re = times(size, cosine(angle)), .im = times(size, sine(angle))};
    return amplitude;
}

// Progress per sample of what takes so many tenths of a millisecond, rounded up, so that the end
// comes with the last sample and not one later.
static uint32_t stride_of(uint32_t tenths)
{
    uint64_t tenth_samples = (uint64_t)tenths * SAMPLES_PER_MS;
    uint64_t stride = tenth_samples > 0 ? (10 * WHOLE + tenth_samples - 1) / tenth_samples : 0;
    return stride > UINT32_MAX ? UINT32_MAX : (uint32_t)stride;
}

static int32_t between(int32_t from, int32_t to, int32_t way)
{
    return (int32_t)(from + ((((int64_t)to - from) * way) >> 30));
}

static struct complex present(const struct voice *voice)
{
    if (voice->stride == 0)
        return voice->to;
    int32_t way = voice->path.knots > 0 ? (int32_t)(voice->along >> 2) : raised_cosine(voice->along);
    struct complex amplitude = {.re = between(voice->from.re, voice->to.re, way),
                                .im = between(voice->from.im, voice->to.im, way)};
    return amplitude;
}

static struct complex target(const struct voice *voice, uint8_t knot)
{
    if (knot == voice->path.knots)
        return amplitude_of(voice->level, voice->phase);
    return amplitude_of(voice->path.knot[knot].level, voice->path.knot[knot].phase);
}

static void stop_if_silent(struct voice *voice)
{
    if (voice->stride == 0 && voice->level == 0)
        voice->is_playing = false;
}

// shape: null for a ramp.
static void send(struct voice *voice, const struct envelope *shape, uint16_t ramp, uint16_t level,
                 int16_t phase, uint64_t sample)
{
    voice->from = present(voice);
    voice->level = level;
    voice->phase = level > 0 ? phase : 0;
    voice->since = sample;
    voice->path.knots = 0;
    if (shape != NULL)
        voice->path = *shape;
    voice->along = 0;
    voice->stride = stride_of(shape != NULL ? shape->step : 10u * ramp);
    voice->to = target(voice, 0);
    voice->next = 1;
    stop_if_silent(voice);
}

void voice_begin(struct voice *voice, uint8_t layer, uint16_t frequency, uint32_t number)
{
    static const struct complex silence = {.re = 0, .im = 0};
    voice->is_playing = true;
    voice->layer = layer;
    voice->has_ended = false;
    voice->frequency = frequency;
    voice->to = silence;
    voice->stride = 0;
    voice->number = number;
}

void voice_lead(struct voice *voice, const struct command *command, uint16_t ramp, uint64_t sample)
{
    send(voice, command->has_onset ? &command->onset : NULL, ramp, command->level, command->phase,
         sample);
    voice->has_ending = command->has_ending;
    if (command->has_ending)
        voice->ending = command->ending;
}

bool voice_outlasts(const struct voice *voice, uint16_t milliseconds)
{
    return voice->level > 0 || voice_samples_left(voice) > (uint32_t)milliseconds * SAMPLES_PER_MS;
}

void voice_fade(struct voice *voice, uint16_t ramp, uint64_t sample)
{
    voice->has_ended = true;
    if (voice_outlasts(voice, ramp))
        send(voice, NULL, ramp, 0, 0, sample);
}

void voice_end(struct voice *voice, uint16_t ramp, uint64_t sample)
{
    if (voice->has_ended || !voice->has_ending) {
        voice_fade(voice, ramp, sample);
        return;
    }
    voice->has_ended = true;
    send(voice, &voice->ending, ramp, 0, 0, sample);
}

uint32_t voice_samples_left(const struct voice *voice)
{
    if (voice->stride == 0)
        return 0;
    uint64_t left = (uint64_t)(voice->path.knots + 1 - voice->next) * WHOLE + WHOLE - voice->along;
    return (uint32_t)((left + voice->stride - 1) / voice->stride);
}

static void move_on(struct voice *voice)
{
    uint32_t before = voice->along;
    if (voice->stride == 0)
        return;
    voice->along += voice->stride;
    if (voice->along >= before)
        return;
    if (voice->next > voice->path.knots) { // the end of the last line
        voice->stride = 0;
        stop_if_silent(voice);
        return;
    }
    voice->from = voice->to;
    voice->to = target(voice, voice->next);
    voice->next++;
}

int32_t voice_sample(struct voice *voice, uint32_t clock)
{
    uint32_t angle = voice->frequency * clock; // a turn of the clock is 20 s, a whole number of periods
    struct complex amplitude = present(voice);
    int32_t value = times(amplitude.re, sine(angle)) + times(amplitude.im, cosine(angle));
    move_on(voice);
    return value;
}

struct complex voice_pointer(const struct voice *voice, uint32_t clock)
{
    struct complex amplitude = present(voice);
    uint32_t angle = voice->frequency * clock;
    int32_t re = cosine(angle), im = sine(angle);
    struct complex turned = {.re = times(amplitude.re, re) - times(amplitude.im, im),
                             .im = times(amplitude.re, im) + times(amplitude.im, re)};
    return turned;
}
