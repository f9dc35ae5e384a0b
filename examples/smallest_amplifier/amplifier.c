/* The smallest amplifier of protocol 4: two channels on a serial line, in one file.
 *
 *     cc -O2 -o amplifier amplifier.c -lm && ./amplifier --pty    (or /dev/ttyUSB0)
 *
 * Written from the pages of the protocol alone. It drives no output: `sample_of` is where the
 * samples of a channel come from. Times are in seconds, amplitudes in full levels.
 */

#define _GNU_SOURCE 1
#include <complex.h>
#include <fcntl.h>
#include <math.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

enum { CHANNELS = 2, LAYERS = 4, VOICES = 8, KNOTS = 32, SET_WORDS = 512, PART_WORDS = 117 };
enum { ADDRESS = 1, BROADCAST = 0, VERSION = 4, REPLY = 0x80, NO_CHANNEL = 255, PAYLOAD = 240 };
enum { HELLO = 1, GET_CAPS, ARM, DISARM, SET, COMMIT, SILENCE, STOP, GET_STATUS, GET_FAULTS, CLEAR,
       PING, GET_ACHIEVED, EVENT = 30, NAK };
enum { UNKNOWN_TYPE = 1, BAD_LENGTH, BAD_VALUE, BAD_CHANNEL, WRONG_STATE, BAD_TOKEN,
       UNSUPPORTED_VERSION = 8, WRONG_SESSION = 10, WRONG_LATCH, INCOMPLETE };
enum { DISABLED = 1, SWITCHED_ON = 3, ENABLED, STOPPED, REACTION, FAULT, WATCHDOG_FAULT = 1 };
enum { FREQUENCY_MIN = 200, FREQUENCY_MAX = 20000, FULL = 10000, RAMP_MAX = 1000 };

/* The clock: 2^32 steps in 20 s, here without going round. */
static double clock_start, clock_from, clock_speed = 4294967296.0 / 20;

static double clock_at(double time) { return clock_start + (time - clock_from) * clock_speed; }
static double moment_of(double clock) { return clock_from + (clock - clock_start) / clock_speed; }
static uint32_t clock_word(double time) { return (uint32_t)(uint64_t)clock_at(time); }
static void set_clock(double time, int shift, int rate) {
    clock_start = clock_at(time) + 65536.0 * shift, clock_from = time;
    clock_speed = 4294967296.0 / 20 * (1 + rate * 1e-7);
}

typedef struct {
    int knots;
    double step;
    double complex knot[KNOTS];
} Envelope;

typedef struct {           /* a tone, from start through its points, a step apart */
    int is_on, is_released, layer, frequency, level, phase, points, has_ending;
    double start, step;
    double complex point[KNOTS + 2];
    Envelope ending;
} Voice;

typedef struct {
    uint16_t token, word[SET_WORDS];
    int words;
} Stream;                  /* without a token there is none */

typedef struct {           /* a moment of 0 is none */
    uint16_t token, ramp, valid_for;
    Stream waiting;
    double ends, waits_until;
} Layer;

static Voice voices[CHANNELS][VOICES + LAYERS];
static Layer layers[LAYERS];
static int limited;        /* the sum of a channel, since the last Status */

#define EACH_OF(channel, voice) \
    for (Voice *voice = voices[channel]; voice < voices[channel] + VOICES + LAYERS; voice++)
#define EACH_VOICE(channel, voice) \
    for (int channel = 0; channel < CHANNELS; channel++) EACH_OF(channel, voice)

static int plays_in(const Voice *voice, int layer) {
    return voice->is_on && voice->layer == layer && !voice->is_released;
}

static int is_over(int layer) {
    EACH_VOICE(channel, voice) if (plays_in(voice, layer)) return 0;
    return 1;
}

static int is_silent(void) {
    EACH_VOICE(channel, voice) if (voice->is_on) return 0;
    return 1;
}

static double end_of(const Voice *voice) { return voice->start + voice->step * (voice->points - 1); }
static double complex last_of(const Voice *voice) { return voice->point[voice->points - 1]; }

static double complex amplitude_of(const Voice *voice, double time) {
    if (time >= end_of(voice)) return last_of(voice);
    double steps = (time - voice->start) / voice->step, way = steps - (int)steps;
    const double complex *from = voice->point + (int)steps;
    if (voice->points == 2) way = (1 - cos(M_PI * way)) / 2;
    return from[0] + (from[1] - from[0]) * way;
}

static double level_of(int channel, double time) { /* the most it may be: angles fall together */
    double level = 0;
    EACH_OF(channel, voice) {
        double complex sum = 0;
        Voice *first = NULL;
        EACH_OF(channel, other)
            if (other->is_on && other->frequency == voice->frequency) {
                if (!first) first = other;
                sum += amplitude_of(other, time);
            }
        if (first == voice) level += cabs(sum);
    }
    if (level > 1 + 1.001 / FULL) limited = 1;
    return fmin(level, 1);
}

double sample_of(int channel, double time);
double sample_of(int channel, double time) { /* of the output, from -1 to 1 */
    double sum = 0;
    EACH_OF(channel, voice) {
        if (!voice->is_on) continue;
        uint32_t angle = (uint32_t)voice->frequency * clock_word(time);
        sum += cimag(amplitude_of(voice, time) * cexp(I * 2 * M_PI * (angle / 4294967296.0)));
    }
    return fmax(-1, fmin(1, sum));
}

static void lead(Voice *voice, double time, const Envelope *shape, double ramp,
                 double complex last) {
    voice->point[0] = amplitude_of(voice, time);
    int knots = shape ? shape->knots : 0;
    if (knots) memcpy(&voice->point[1], shape->knot, knots * sizeof shape->knot[0]);
    voice->point[knots + 1] = last;
    voice->points = knots + 2;
    voice->start = time;
    voice->step = shape ? shape->step : ramp;
}

static void fade(Voice *voice, double time, double ramp) {
    if (last_of(voice) || end_of(voice) > time + ramp) lead(voice, time, NULL, ramp, 0);
    voice->is_released = 1;
}

static int lasts(const Voice *voice, double until) {
    return voice->is_on && (last_of(voice) || end_of(voice) > until);
}

static Voice *first_released(int channel, double until) { /* of those that last longer */
    Voice *first = NULL;
    EACH_OF(channel, voice)
        if (lasts(voice, until) && voice->is_released && (!first || voice->start < first->start))
            first = voice;
    return first;
}

static Voice *free_voice(int channel) {
    EACH_OF(channel, voice) if (!voice->is_on) return voice;
    return first_released(channel, 0);
}

static void shorten_fades(int channel, double time) {
    int count = 0;
    EACH_OF(channel, voice) count += lasts(voice, time + 0.002);
    for (; count > VOICES; count--) fade(first_released(channel, time + 0.002), time, 0.002);
}

static double complex polar(const uint16_t *word) {
    return word[0] / (double)FULL * cexp(I * M_PI * (int16_t)word[1] / 18000);
}

static int is_polar(const uint16_t *word) {
    return word[0] <= FULL && (int16_t)word[1] >= -18000 && (int16_t)word[1] < 18000;
}

/* Count the words of the first layer of a stream; 0 if the stream ends amid it. */
static int words_of(const uint16_t *word, int count) {
    int at = 3;
    if (count < at) return 0;
    for (int commands = word[0] & 31; commands; commands--) {
        if (at + 4 > count) return 0;
        int flags = word[at], envelopes = (flags >> 1 & 1) + (flags & 1);
        for (at += 4; envelopes; envelopes--) {
            if (at + 2 > count) return 0;
            at += 2 + 2 * word[at];
        }
    }
    return at <= count ? at : 0;
}

/* Return the code for what is wrong with a stream, or 0, and the channel at fault. */
static int check_stream(const uint16_t *word, int count, int *channel) {
    int named = 0;
    if (count > SET_WORDS) return BAD_LENGTH;
    for (const uint16_t *end = word + count; word < end;) {
        if (!words_of(word, (int)(end - word))) return BAD_LENGTH;
        int head = word[0], layer = head >> 7, commands = head & 31, channels = 0;
        if (layer >= LAYERS || named >> layer & 1 || head >> (commands ? 5 : 6) & 1) return BAD_VALUE;
        if (word[1] > RAMP_MAX || word[2] > 60000) return BAD_VALUE;
        named |= 1 << layer;
        for (word += 3; commands; commands--) {
            int flags = word[0], is_driven = word[2] || flags & 2;
            *channel = flags >> 4 & 15;
            if (*channel >= CHANNELS || channels >> *channel & 1) return BAD_CHANNEL;
            channels |= 1 << *channel;
            int is_within = word[1] >= FREQUENCY_MIN && word[1] <= FREQUENCY_MAX;
            if (flags >> 8 || !is_polar(word + 2) || (is_driven && !is_within)) return BAD_VALUE;
            word += 4;
            for (int envelopes = (flags >> 1 & 1) + (flags & 1); envelopes; envelopes--) {
                int knots = word[0];
                if (knots > KNOTS || word[1] < 1 || word[1] > 1000) return BAD_VALUE;
                for (word += 2; knots; knots--, word += 2) if (!is_polar(word)) return BAD_VALUE;
            }
        }
        *channel = NO_CHANNEL;
    }
    return 0;
}

typedef struct {
    int flags, frequency, level, phase;
    double complex last;
    Envelope onset, ending;
} Command;

static const uint16_t *read_envelope(const uint16_t *word, Envelope *envelope) {
    envelope->knots = word[0], envelope->step = word[1] / 10000.0;
    word += 2;
    for (int i = 0; i < envelope->knots; i++, word += 2) envelope->knot[i] = polar(word);
    return word;
}

/* Begin the commands of a layer, given by its words; without any it falls silent. */
static void play(const uint16_t *word, uint16_t token, double time) {
    int layer = word[0] >> 7, count = word[0] & 31;
    double ramp = word[1] / 1000.0, ends = word[2] ? time + word[2] / 1000.0 : 0;
    Command commands[CHANNELS] = {0};
    const uint16_t *next = word + 3;
    for (int i = 0; i < count; i++) {
        Command *one = &commands[next[0] >> 4 & 15];
        one->flags = next[0], one->frequency = next[1];
        one->level = next[2], one->phase = next[3], one->last = polar(next + 2);
        next += 4;
        if (one->flags & 2) next = read_envelope(next, &one->onset);
        if (one->flags & 1) next = read_envelope(next, &one->ending);
    }
    layers[layer].waiting.token = 0, layers[layer].ends = count ? ends : 0;
    for (int channel = 0; channel < CHANNELS; channel++) {
        Command *one = &commands[channel];
        int has_onset = one->flags & 2, is_driven = one->level || has_onset;
        int keeps_phase = one->flags & 8, skips_ending = one->flags & 4;
        Voice *voice = NULL;
        EACH_OF(channel, other) if (plays_in(other, layer)) voice = other;
        if (voice && !(is_driven && keeps_phase && voice->frequency == one->frequency)) {
            if (is_driven || skips_ending || !voice->has_ending) fade(voice, time, ramp);
            else lead(voice, time, &voice->ending, 0, 0);
            voice->is_released = 1;
            voice = NULL;
        }
        if (!is_driven) continue;
        if (!voice) {
            voice = free_voice(channel);
            *voice = (Voice){.is_on = 1, .layer = layer, .points = 1, .start = time};
        }
        lead(voice, time, has_onset ? &one->onset : NULL, ramp, one->last);
        voice->frequency = one->frequency, voice->level = one->level, voice->phase = one->phase;
        voice->has_ending = one->flags & 1, voice->ending = one->ending;
        shorten_fades(channel, time);
    }
    if (!count) return;
    layers[layer].token = token, layers[layer].ramp = word[1], layers[layer].valid_for = word[2];
}

static void start(const Stream *stream, double time) {
    for (int at = 0, words; at < stream->words; at += words) {
        const uint16_t *word = stream->word + at;
        words = words_of(word, stream->words - at);
        int layer = word[0] >> 7, is_after = word[0] >> 6 & 1, renews = word[0] >> 5 & 1;
        Layer *one = &layers[layer];
        double waits_until = time;
        EACH_VOICE(channel, voice)
            if (plays_in(voice, layer) && voice->points > 2)
                waits_until = fmax(waits_until, end_of(voice));
        if (renews) {
            if (!is_over(layer)) one->ends = word[2] ? time + word[2] / 1000.0 : 0;
        } else if (is_after && waits_until > time) {
            one->waits_until = waits_until;
            one->waiting.token = stream->token, one->waiting.words = words;
            memcpy(one->waiting.word, word, words * sizeof *word);
        } else play(word, stream->token, time);
    }
}

static int state = DISABLED, fault;
static uint16_t session, latch, committed;
static double watchdog, last_fed, faults_at[2] = {-1, -1};
static Stream staged, waiting;
static double waits_for;   /* the clock at which what waits starts */
static struct {            /* what is staged, too, keeps its token, parts and time */
    uint16_t token, word[127][PART_WORDS];
    int parts, length[127];  /* one more than its words, 0 for none */
    double began;
} collected;

static uint16_t number_after(uint16_t number) { return number == 65535 ? 1 : number + 1; }
static int is_newer(uint16_t token, uint16_t than) {
    return !than || (token != than && (uint16_t)(token - than) < 32768);
}

static void drop_set(void) { memset(&collected, 0, sizeof collected), staged.token = 0; }

static void silence(double time, double ramp) {
    for (int layer = 0; layer < LAYERS; layer++)
        layers[layer].ends = layers[layer].waiting.token = 0;
    EACH_VOICE(channel, voice) if (voice->is_on) fade(voice, time, ramp);
    drop_set();
    waiting.token = 0;
}

static void start_waiting(double time) {
    Stream stream = waiting;
    waiting.token = 0;
    if (stream.token) start(&stream, time);
}

/* Let happen what is due at a moment, and nothing is due before. */
static void happen(double time) {
    EACH_VOICE(channel, voice)
        if (voice->is_on && !last_of(voice) && end_of(voice) < time) voice->is_on = 0;
    if (state == ENABLED && time >= last_fed + watchdog) {
        faults_at[1] = faults_at[0], faults_at[0] = time;
        silence(time, 0.005), set_clock(time, 0, 0);
        state = REACTION, fault = WATCHDOG_FAULT, latch = number_after(latch);
    }
    if (collected.token && time >= collected.began + 1) drop_set();
    if (waiting.token && time >= moment_of(waits_for)) start_waiting(time);
    for (int layer = 0; layer < LAYERS; layer++) {
        Layer *one = &layers[layer];
        uint16_t silent[] = {(uint16_t)(layer << 7), one->ramp, 0};
        Stream stream = one->waiting;
        if (stream.token && time >= one->waits_until) play(stream.word, stream.token, time);
        else if (one->ends && time >= one->ends) play(silent, 0, time);
    }
    EACH_VOICE(channel, voice)
        if (voice->is_on && !last_of(voice) && end_of(voice) <= time) voice->is_on = 0;
    for (int channel = 0; channel < CHANNELS; channel++) level_of(channel, time);
    if (is_silent() && state == REACTION) state = FAULT;
    if (is_silent() && state == SWITCHED_ON) state = DISABLED;
}

static void tick(double now) {
    for (double due = -1; due < now;) {
        due = now;
        if (state == ENABLED) due = fmin(due, last_fed + watchdog);
        if (waiting.token) due = fmin(due, moment_of(waits_for));
        for (Layer *one = layers; one < layers + LAYERS; one++) {
            if (one->waiting.token) due = fmin(due, one->waits_until);
            if (one->ends) due = fmin(due, one->ends);
        }
        happen(due);
    }
}

/* Requests: words in, words out; the code of a refusal, or 0, or one of the following. */
enum { IGNORED = -2, KEPT };
static uint16_t out[120];
static int out_count;
static void put(int word) { out[out_count++] = (uint16_t)word; }

static void put_status(double now) {
    int is_high = state == ENABLED || !is_silent();
    uint32_t clock = clock_word(now);
    put(state), put(fault), put(is_high | limited << 2), put(latch), limited = 0;
    put(state == ENABLED ? (int)lround(1000 * (last_fed + watchdog - now)) : 0);
    put(250), put(is_high ? 1800 : 0), put(clock >> 16), put(clock & 0xFFFF);
    put(committed), put(CHANNELS << 8 | LAYERS);
    for (int channel = 0; channel < CHANNELS; channel++)
        put((int)lround(FULL * level_of(channel, now)));
    for (int layer = 0; layer < LAYERS; layer++) put(is_over(layer) ? 0 : layers[layer].token);
}

static int put_taken(uint16_t token, int flags, int missing) {
    return put(token), put(flags), put(missing), 0;
}

/* Start what is staged: at once, or when the clock has come to a word that is near. */
static void commit(double now, uint16_t at) {
    uint32_t high = clock_word(now) >> 16;
    uint16_t steps = (uint16_t)(at - high);
    start_waiting(now);
    committed = staged.token;
    if (steps >= 1 && steps <= 1638) {
        waiting = staged;
        waits_for = (floor(clock_at(now) / 65536) + steps) * 65536;
    } else start(&staged, now);
    drop_set();
}

static int take_part(const uint16_t *in, int count, double now, int *channel) {
    static uint16_t word[127 * PART_WORDS];
    uint16_t token = in[1];
    int index = in[2] >> 8, parts = in[2] >> 1 & 127, plays = in[2] & 1;
    int is_same = token == collected.token, is_staged = token == staged.token, words = 0;
    int is_old = !is_newer(token, committed) || !(is_same || is_newer(token, collected.token));
    if (index < parts - 1) {
        if (is_old || is_staged || (is_same && parts != collected.parts)) return IGNORED;
        if (!is_same) drop_set(), collected.began = now;
        collected.token = token, collected.parts = parts, collected.length[index] = count - 3 + 1;
        memcpy(collected.word[index], in + 3, (count - 3) * sizeof *in);
        return KEPT;
    }
    if (token == committed) return put_taken(token, 5, 0);
    if (is_staged) {
        if (plays) commit(now, (uint16_t)(clock_word(now) >> 16));
        return put_taken(token, plays ? 5 : 6, 0);
    }
    if (is_old) return BAD_TOKEN;
    if (index >= parts || (is_same && parts != collected.parts)) return BAD_VALUE;
    for (int i = 0; i < index; i++) {
        if (!is_same || !collected.length[i]) return put_taken(token, 0, i);
        memcpy(word + words, collected.word[i], (collected.length[i] - 1) * sizeof *in);
        words += collected.length[i] - 1;
    }
    memcpy(word + words, in + 3, (count - 3) * sizeof *in);
    words += count - 3;
    int code = check_stream(word, words, channel);
    if (code && is_same) drop_set();
    if (code) return code;
    double began = is_same ? collected.began : now;
    drop_set();
    collected.token = staged.token = token, collected.parts = parts, collected.began = began;
    memcpy(staged.word, word, words * sizeof *word), staged.words = words;
    if (plays) commit(now, (uint16_t)(clock_word(now) >> 16));
    return put_taken(token, plays ? 5 : 6, 0);
}

static int put_achieved(int layer) {
    if (layer >= LAYERS) return BAD_VALUE;
    const Layer *one = &layers[layer];
    int count = 0, is_none = is_over(layer), head = out_count + 1;
    put(is_none ? 0 : one->token), put(0);
    put(is_none ? 0 : one->ramp), put(is_none ? 0 : one->valid_for);
    EACH_VOICE(channel, voice) {
        if (!plays_in(voice, layer)) continue;
        put(channel << 4), put(voice->frequency), put(voice->level), put(voice->phase);
        count++;
    }
    out[head] = (uint16_t)(layer << 7 | count);
    return 0;
}

static void put_capabilities(void) {
    int caps[] = {CHANNELS, LAYERS, VOICES, SET_WORDS, KNOTS, 0, FREQUENCY_MIN, FREQUENCY_MAX, 1,
                  FULL, 1, 1, RAMP_MAX, 0, 100, 2000, 1, 1000, 10};
    for (unsigned i = 0; i < sizeof caps / sizeof *caps; i++) put(caps[i]);
    for (int i = 0; i < CHANNELS; i++) put(FREQUENCY_MIN), put(FREQUENCY_MAX), put(FULL);
}

static void put_faults(double now) {
    put((faults_at[0] >= 0) + (faults_at[1] >= 0));
    for (int i = 0; i < 2 && faults_at[i] >= 0; i++) {
        uint32_t age = (uint32_t)(1000 * (now - faults_at[i]));
        put(WATCHDOG_FAULT), put(NO_CHANNEL), put(age >> 16), put(age & 0xFFFF);
    }
}

/* Check the words: session, token, watchdog, ramp, layer or any other. */
static int check_words(int type, const uint16_t *in, int bytes) {
    static const char *const words[] = {
        [GET_CAPS] = "", [ARM] = "sw*", [DISARM] = "*", [SET] = "st*", [COMMIT] = "st*",
        [SILENCE] = "sr", [STOP] = "*", [GET_STATUS] = "", [GET_FAULTS] = "", [CLEAR] = "*",
        [PING] = "s*", [GET_ACHIEVED] = "l"};
    int i = 0;
    for (const char *kind = words[type]; *kind; kind++, i++) {
        if (bytes < 2 * i + 2) return BAD_LENGTH;
        if (*kind == 't' && !in[i]) return BAD_TOKEN;
        if (*kind == 's' && !in[i]) return BAD_VALUE;
        if (*kind == 'w' && (in[i] < 100 || in[i] > 2000)) return BAD_VALUE;
        if ((*kind == 'r' && in[i] > RAMP_MAX) || (*kind == 'l' && in[i] > 15)) return BAD_VALUE;
    }
    return bytes % 2 || (type != SET && bytes > 2 * i) ? BAD_LENGTH : 0;
}

static int handle(int type, const uint16_t *in, int bytes, double now, int *channel) {
    if (type < GET_CAPS || type > GET_ACHIEVED) return UNKNOWN_TYPE;
    int code = check_words(type, in, bytes), is_armed = state == ENABLED;
    if (code) return code;
    int plays = type == SET || type == COMMIT || type == SILENCE;
    int feeds = plays || type == ARM || type == PING;
    if ((plays && !is_armed) || (type == ARM && state > ENABLED)) return WRONG_STATE;
    if (feeds && is_armed && in[0] != session) return WRONG_SESSION;
    if (type == ARM && !is_armed && in[0] == session) return WRONG_SESSION;
    if (type == ARM) {
        watchdog = in[1] / 1000.0;
        if (!is_armed) silence(now, 0.005), set_clock(now, in[2], 0), committed = 0;
        session = in[0], state = ENABLED;
    } else if (type == DISARM || type == STOP) {
        silence(now, fmin(in[0], RAMP_MAX) / 1000), set_clock(now, 0, 0);
        if (type == STOP) latch = number_after(latch);
        if (type == DISARM && is_armed) state = SWITCHED_ON;
        if (type == STOP && state < STOPPED) state = STOPPED;
    } else if (type == SILENCE) {
        silence(now, in[1] / 1000.0);
    } else if (type == CLEAR && (state == STOPPED || state == FAULT)) {
        if (in[0] != latch) return WRONG_LATCH;
        if (is_silent()) state = DISABLED, fault = 0;
    } else if (type == PING && is_armed) {
        set_clock(now, 0, (int16_t)in[1]);
    } else if (type == SET) {
        code = take_part(in, bytes / 2, now, channel);
    } else if (type == COMMIT && in[1] != committed) {
        if (in[1] != collected.token) return BAD_TOKEN;
        if (in[1] != staged.token) return INCOMPLETE;
        commit(now, in[2]);
    }
    if (code && code != KEPT) return code;
    if (feeds && state == ENABLED) last_fed = now;
    tick(now);
    if (type == GET_CAPS) put_capabilities();
    else if (type == GET_FAULTS) put_faults(now);
    else if (type == GET_ACHIEVED) return put_achieved(in[0]);
    else if (type != SET) put_status(now);
    return code;
}

/* The serial line: 00, COBS of (type, version, address, sequence, payload, CRC-32), 00. */
static uint32_t crc_of(const uint8_t *data, int length) {
    uint32_t crc = 0xFFFFFFFF;
    for (int i = 0; i < length; i++) {
        crc ^= data[i];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    return ~crc;
}

static void send_frame(int line, uint8_t *frame, int length) {
    uint32_t crc = crc_of(frame, length);
    for (int i = 0; i < 4; i++) frame[length++] = (uint8_t)(crc >> 8 * i);
    uint8_t stuffed[PAYLOAD + 16] = {0};
    int code = 1, at = 2;
    for (int i = 0; i < length; i++) {
        if (frame[i]) { stuffed[at++] = frame[i]; continue; }
        stuffed[code] = (uint8_t)(at - code);
        code = at++;
    }
    stuffed[code] = (uint8_t)(at - code);
    stuffed[at++] = 0;
    if (write(line, stuffed, at) != at) perror("write");
}

static void received(int line, const uint8_t *stuffed, int length, double now) {
    uint8_t frame[PAYLOAD + 16];
    int size = 0;
    for (int at = 0; at < length;) {
        int code = stuffed[at++];
        for (int i = 1; i < code; i++) {
            if (at >= length) return;
            frame[size++] = stuffed[at++];
        }
        if (code < 255 && at < length) frame[size++] = 0;
    }
    if (size < 9) return;
    uint32_t crc = 0;
    for (int i = 0; i < 4; i++) crc |= (uint32_t)frame[size - 4 + i] << 8 * i;
    int type = frame[0], address = frame[2], bytes = size - 9;
    if (crc != crc_of(frame, size - 4) || type & REPLY || type == EVENT) return;
    int is_for_all = type == COMMIT || type == STOP, version = VERSION;
    if (address == BROADCAST ? !is_for_all || frame[1] != VERSION : address != ADDRESS) return;
    uint16_t in[PAYLOAD / 2] = {0};
    for (int i = 0; i < bytes; i++) in[i / 2] |= (uint16_t)(frame[5 + i] << 8 * (i % 2));
    if (type == HELLO) {
        static const char *const texts[] = {"you", "smallest amplifier", "SMALLEST-1", "1"};
        frame[0] = HELLO | REPLY, frame[1] = 0, frame[5] = 1 << VERSION, frame[6] = 0;
        int at = 7;
        for (int i = 0; i < 4; at += 1 + frame[at], i++) {
            frame[at] = (uint8_t)strlen(texts[i]);
            memcpy(frame + at + 1, texts[i], frame[at]);
        }
        send_frame(line, frame, at);
        return;
    }
    int was_limited = limited, channel = NO_CHANNEL, code = UNSUPPORTED_VERSION;
    out_count = 0;
    tick(now);
    if (frame[1] != VERSION) version = 0;
    else code = handle(type, in, bytes, now, &channel);
    if (address == BROADCAST) limited |= was_limited;
    int is_part = version && type == SET && bytes >= 6 && in[2] >> 8 < (in[2] >> 1 & 127) - 1;
    if (address == BROADCAST || is_part) return;
    if (code) out_count = 0, put(type), put(code), put(channel);
    frame[0] = (uint8_t)((code ? NAK : type) | REPLY), frame[1] = (uint8_t)version;
    for (int i = 0; i < 2 * out_count; i++) frame[5 + i] = (uint8_t)(out[i / 2] >> 8 * (i % 2));
    send_frame(line, frame, 5 + 2 * out_count);
}

static void take(int line, const uint8_t *data, ssize_t count, double now) {
    static uint8_t frame[PAYLOAD + 11]; /* one byte more than the longest */
    static int length;
    for (ssize_t i = 0; i < count; i++) {
        if (data[i] && length < (int)sizeof frame) frame[length++] = data[i];
        if (data[i]) continue;
        if (length && length < (int)sizeof frame) received(line, frame, length, now);
        length = 0;
    }
}

static double time_now(void) {
    struct timespec clock;
    clock_gettime(CLOCK_MONOTONIC, &clock);
    return (double)clock.tv_sec + clock.tv_nsec / 1e9;
}

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: amplifier TTY | --pty\n"), 2;
    int is_pty = !strcmp(argv[1], "--pty"), flags = O_RDWR | O_NOCTTY;
    int line = is_pty ? posix_openpt(flags) : open(argv[1], flags), far = line;
    if (is_pty) far = grantpt(line) || unlockpt(line) ? -1 : open(ptsname(line), flags);
    struct termios raw;
    if (far < 0 || tcgetattr(far, &raw)) return perror(argv[1]), 2;
    cfmakeraw(&raw);
    cfsetspeed(&raw, B921600);
    tcsetattr(far, TCSANOW, &raw);
    if (is_pty) printf("serial://%s\n", ptsname(line)), fflush(stdout);
    uint8_t data[256];
    struct pollfd ready = {.fd = line, .events = POLLIN};
    for (;;) {
        poll(&ready, 1, 1);
        if (ready.revents & (POLLHUP | POLLERR)) return 0;
        ssize_t count = ready.revents & POLLIN ? read(line, data, sizeof data) : 0;
        double now = time_now();
        tick(now);
        take(line, data, count, now);
    }
}
