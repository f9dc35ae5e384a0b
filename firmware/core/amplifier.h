// SPDX-License-Identifier: MIT
//
// The amplifier, whatever its wire: states, session, watchdog, layers, faults, and its samples.
//
// Requests take effect with the next sample (wire/messages.c reads them), a commit also with that at
// a moment of the clock, on which the phases of all voices count. `amplifier_sample` makes
// that sample; `amplifier_time` says what real time it is, which ends watchdog, vibrations and sets
// that wait for a commit even where no samples are made. Nothing here knows the board; its main loop
// (loop.c) hands over what is measured and takes samples and `high_voltage`.

#ifndef AMPLIFIER_H
#define AMPLIFIER_H

#include "channel.h"
#include "records.h"

struct layer {
    uint16_t token, ramp, valid_for; // of the set that plays
    uint16_t former_token;           // that Status shows until the samples since `began` come out
    uint64_t began;                  // sample of a start at a moment or after onsets; 0: at a request
    struct timer ends;
    uint32_t waits; // samples until the set that waits starts; 0: none waits
    bool starts, is_over; // with the sample just made
    uint16_t waiting_token, waiting_count;
    uint16_t waiting[STREAM_WORDS];
};

// A set that was committed for a moment ahead.
struct waiting_set {
    uint16_t token; // 0: none waits
    uint32_t at;    // of the clock
    uint16_t count, words[STREAM_WORDS];
};

struct fault_record {
    uint8_t fault, channel;
    uint64_t at; // us
};

// Outcome of a request: refused or not, and the channel at fault.
struct verdict {
    enum nak nak;
    uint8_t channel;
};

// What the board measures, and the cause of a fault while there is one.
struct measured {
    struct readings readings;
    bool is_interlock_open;
    enum fault cause;
    uint8_t channel; // of the cause
};

struct amplifier;
// Called at every change of state.
typedef void amplifier_notify(const struct amplifier *amplifier, const struct wire_event *event);

struct amplifier {
    const char *serial_number; // at most 32 bytes
    amplifier_notify *notify;  // or null
    struct measured measured;  // of the board
    // For the board: whether the high voltage is on.
    bool high_voltage;
    uint32_t slack; // us by which samples may come late
    int32_t ahead;  // 2^-16 of a sample, by which the next sample comes out later than now
    uint32_t heard; // us since the last byte of the request arrived

    enum state state;
    enum fault fault;
    uint16_t latch;
    uint16_t session;  // held while armed, or the one that ended last; 0: none
    uint64_t sample;   // samples since power-up
    uint64_t changed;  // first sample of the state, or of what a request plays or silences
    uint64_t clock;    // of the next sample, 20 s a turn of 2^64
    uint64_t step;     // of the clock per sample, by the host's rate
    uint32_t mark;     // the clock that the next status shows instead, if it
    bool has_mark;
    uint64_t now;      // us
    uint64_t now_at;   // sample before which it was that time
    uint16_t watchdog; // ms
    struct timer fed;
    uint16_t committed; // token of the set committed last; 0: none
    bool is_limited;    // the sum of a channel was, since the last status
    struct intake intake;
    struct waiting_set waiting;
    struct layer layers[LAYERS];
    struct channel channels[CHANNELS_MAX];
    struct fault_record faults[FAULTS_KEPT]; // newest first
    uint8_t fault_count;
};

void amplifier_init(struct amplifier *amplifier, const char *serial_number,
                    amplifier_notify *notify);

// As without supply: immediately silent and disarmed, latch 0; the list of faults is kept.
void amplifier_restart(struct amplifier *amplifier);

// Make the next sample of every channel, and let one sample's time pass.
void amplifier_sample(struct amplifier *amplifier, int16_t samples[CHANNELS_MAX]);

// The same in units of 2^-30 of full level, whatever SQUARE_LAW.
void amplifier_forces(struct amplifier *amplifier, int32_t forces[CHANNELS_MAX]);

// Let the clock go on by the time of samples that were lost.
void amplifier_skip(struct amplifier *amplifier, uint64_t samples);

// Hand over real time [us], which never goes back: what was due by then has ended.
void amplifier_time(struct amplifier *amplifier, uint64_t now);

// Enter the fault reaction, whether the high voltage is on or not.
void amplifier_fail(struct amplifier *amplifier, enum fault fault, uint8_t channel);

// Enter a fault and fall silent with the next sample, without a ramp: samples come too late for one.
void amplifier_overload(struct amplifier *amplifier);

// Hand over what the board measures; an open interlock or another cause of a fault acts at once.
void amplifier_measured(struct amplifier *amplifier, struct measured measured);

// Requests that are allowed in this state, and of this session. Times are in milliseconds.
void amplifier_arm(struct amplifier *amplifier, uint16_t session, uint16_t watchdog,
                   uint16_t shift);
// Let the clock run faster by so many tenths of a millionth.
void amplifier_steer(struct amplifier *amplifier, int16_t rate);
void amplifier_disarm(struct amplifier *amplifier, uint16_t ramp);
void amplifier_stop(struct amplifier *amplifier, uint16_t ramp);
void amplifier_silence(struct amplifier *amplifier, uint16_t ramp);
enum nak amplifier_clear(struct amplifier *amplifier, uint16_t latch);
void amplifier_feed(struct amplifier *amplifier);
// Commit the staged set: it plays when the high word of the clock becomes `at`, if that is within
// half a second ahead, else at once.
void amplifier_commit(struct amplifier *amplifier, uint16_t at);

// Time of the next sample [us].
static inline uint64_t amplifier_now(const struct amplifier *amplifier)
{
    return amplifier->now + (amplifier->sample - amplifier->now_at) * 1000000 / SAMPLE_RATE;
}

// The clock at the output by now: that of the next sample, less the time until that comes out.
static inline uint32_t amplifier_clock(const struct amplifier *amplifier)
{
    int64_t ahead = (int64_t)(amplifier->step >> 16) * amplifier->ahead;
    return (uint32_t)((amplifier->clock - (uint64_t)ahead) >> 32);
}

// Layers that play, a bit each: their tokens are valid.
uint16_t amplifier_layers(const struct amplifier *amplifier);
// Milliseconds that the watchdog has left, rounded.
uint16_t amplifier_watchdog_left(const struct amplifier *amplifier);

// Between the files of the core: what is due in the layers after a sample, and in real time.
void layers_sample(struct amplifier *amplifier);
void layers_time(struct amplifier *amplifier);
void layers_silence(struct amplifier *amplifier, uint16_t ramp);

#endif
