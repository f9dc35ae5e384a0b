// SPDX-License-Identifier: MIT

#include "voice.h"
#include "sine.h"

#define PHASE_TURN (360 * PHASE_PER_UNIT)
#define WHOLE (UINT64_C(1) << 32)

// In 32 bits, because small processors divide 64 bits in a loop: x * whole / n is rounded down as
// x * (whole / n) + x * (whole % n) / n.
static struct complex amplitude_of(uint16_t level, int16_t phase)
{
    uint32_t turn = (uint32_t)(phase < 0 ? phase + PHASE_TURN : phase);
    uint32_t angle = turn * (uint32_t)(WHOLE / PHASE_TURN) +
                     turn * (uint32_t)(WHOLE % PHASE_TURN) / PHASE_TURN;
    int32_t size = level * (ONE / LEVEL_PER_UNIT) + level * (ONE % LEVEL_PER_UNIT) / LEVEL_PER_UNIT;
    struct complex amplitude = {.re = times(size, cosine(angle)), .im = times(size, sine(angle))};
    return amplitude;
}

// Whole turns, divided and rounded up; at most UINT32_MAX. Nearly always in 32 bits.
static uint32_t parts_of(uint32_t turns, uint32_t divisor)
{
    if (divisor % turns == 0 && divisor > turns)
        return UINT32_MAX / (divisor / turns) + 1;
    uint64_t parts = (turns * WHOLE + divisor - 1) / divisor;
    return parts > UINT32_MAX ? UINT32_MAX : (uint32_t)parts;
}

// Progress per sample of what takes so many tenths of a millisecond, rounded up, so that the end
// comes with the last sample and not one later.
static uint32_t stride_of(uint32_t tenths)
{
    uint32_t tenth_samples = tenths * SAMPLES_PER_MS;
    if (tenth_samples == 0)
        return 0;
    return parts_of(10, tenth_samples);
}

// Samples of a way of some lines, at a stride.
static uint32_t samples_of(uint32_t lines, uint32_t stride)
{
    return stride > 0 ? parts_of(lines, stride) : 0;
}

static int32_t between(int32_t from, int32_t to, int32_t way)
{
    return (int32_t)(from + ((((int64_t)to - from) * way) >> 30));
}

// Amplitude at a position on the present line.
static struct complex amplitude_at(const struct voice *voice, uint32_t along)
{
    int32_t way = voice->path.knots > 0 ? (int32_t)(along >> 2) : raised_cosine(along);
    struct complex amplitude = {.re = between(voice->from.re, voice->to.re, way),
                                .im = between(voice->from.im, voice->to.im, way)};
    return amplitude;
}

static struct complex present(const struct voice *voice)
{
    return voice->stride > 0 ? amplitude_at(voice, voice->along) : voice->to;
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
    voice->last_stride = 0;
    voice->still_at = (uint32_t)sample + samples_of(voice->path.knots + 1u, voice->stride);
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
    voice->stride = voice->last_stride = 0;
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

void voice_fade(struct voice *voice, uint16_t ramp, uint64_t sample)
{
    voice->has_ended = true;
    if (voice_outlasts(voice, ramp, sample))
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

static void move_on(struct voice *voice)
{
    uint32_t before = voice->along;
    if (voice->stride == 0)
        return;
    voice->along += voice->stride;
    if (voice->along >= before)
        return;
    if (voice->next > voice->path.knots) { // the end of the last line
        voice->last_stride = voice->stride;
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

struct complex voice_amplitude(const struct voice *voice, uint64_t sample, uint32_t before)
{
    uint32_t stride = voice->stride, samples = before;
    uint64_t along = voice->along;
    if (stride == 0) {
        uint32_t still = (uint32_t)sample - voice->still_at; // samples for which it has stood
        if (still >= before)
            return voice->to;
        if (voice->last_stride == 0)
            return voice->from;
        stride = voice->last_stride;
        samples = before - still;
        along = WHOLE;
    }
    uint64_t way = (uint64_t)stride * samples;
    return way <= along ? amplitude_at(voice, (uint32_t)(along - way)) : voice->from;
}

struct complex voice_pointer(const struct voice *voice, uint32_t clock, struct complex amplitude)
{
    uint32_t angle = voice->frequency * clock;
    int32_t re = cosine(angle), im = sine(angle);
    struct complex turned = {.re = times(amplitude.re, re) - times(amplitude.im, im),
                             .im = times(amplitude.re, im) + times(amplitude.im, re)};
    return turned;
}
