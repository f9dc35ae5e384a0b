/* The smallest amplifier of protocol 4: two channels on a serial line, in one file.
 *
 *     cc -O2 -o amplifier amplifier.c -lm && ./amplifier --pty    (or /dev/ttyUSB0)
 *
 * Written from the pages of the protocol alone. `sample_of` is what the output of a channel would
 * play. Times are in seconds, amplitudes in full levels. */

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

enum { CHANNELS = 2, LAYERS = 4, VOICES = 8, SLOTS = VOICES + LAYERS, KNOTS = 32, SET_WORDS = 512 };
enum { ADDRESS = 1, BROADCAST = 0, VERSION = 4, REPLY = 0x80, NO_CHANNEL = 255, PAYLOAD = 240 };
enum { HELLO = 1, GET_CAPS, ARM, DISARM, SET, COMMIT, SILENCE, STOP, GET_STATUS, GET_FAULTS, CLEAR,
       PING, GET_ACHIEVED, EVENT = 30, NAK };
enum { UNKNOWN_TYPE = 1, BAD_LENGTH, BAD_VALUE, BAD_CHANNEL, WRONG_STATE, BAD_TOKEN,
       UNSUPPORTED_VERSION = 8, WRONG_SESSION = 10, WRONG_LATCH, INCOMPLETE };
enum { DISABLED = 1, SWITCHED_ON = 3, ENABLED, STOPPED, REACTION, FAULT, WATCHDOG_FAULT = 1 };
enum { FREQUENCY_MIN = 200, FREQUENCY_MAX = 20000, FULL = 10000, RAMP_MAX = 1000 };

/* The clock: 2^32 steps in 20 s, here without going round. */
#define CLOCK_HZ (4294967296.0 / 20)
static double clock_start, clock_from, clock_speed = CLOCK_HZ;
static double clock_at(double time) { return clock_start + (time - clock_from) * clock_speed; }
static uint32_t clock_word(double time) { return (uint32_t)(uint64_t)clock_at(time); }
static double moment_of(double clock) { return clock_from + (clock - clock_start) / clock_speed; }
static void set_clock(double time, int shift, int rate) {
    clock_start = clock_at(time) + 65536.0 * shift, clock_from = time;
    clock_speed = CLOCK_HZ * (1 + rate * 1e-7);
}

typedef double complex Amplitude;
typedef struct {           /* a tone, from start through its points, a step apart */
    int is_on, is_released, layer, frequency, level, phase, points, has_ending;
    double start, step;
    Amplitude point[KNOTS + 2];
    uint16_t ending[2 + 2 * KNOTS];
} Voice;

typedef struct {           /* one whose token is 0 is not there */
    uint16_t token, word[SET_WORDS];
    int words;
} Stream;

typedef struct {
    uint16_t token, head[3]; /* of the set that plays */
    Stream waiting;
    double waits_until, ends; /* 0: never */
} Layer;

static Voice voices[CHANNELS][SLOTS];
static Layer layers[LAYERS];
static int is_silent = 1, limited; /* limited: the sum of a channel, since the last Status */

#define EACH_CHANNEL(c) for (int c = 0; c < CHANNELS; c++)
#define EACH_OF(c, voice) for (Voice *voice = voices[c]; voice < voices[c] + SLOTS; voice++)
#define EACH_VOICE(c, voice) EACH_CHANNEL(c) EACH_OF(c, voice)

static int plays_in(const Voice *voice, int layer) {
    return voice->is_on && voice->layer == layer && !voice->is_released;
}
static int is_over(int layer) {
    EACH_VOICE(channel, voice) if (plays_in(voice, layer)) return 0;
    return 1;
}
static double end_of(const Voice *one) { return one->start + one->step * (one->points - 1); }
static Amplitude last_of(const Voice *voice) { return voice->point[voice->points - 1]; }
static int lasts(const Voice *voice, double until) { /* longer than that */
    return voice->is_on && (last_of(voice) || end_of(voice) > until);
}
static Amplitude amplitude_of(const Voice *voice, double time) {
    if (time >= end_of(voice)) return last_of(voice);
    double steps = (time - voice->start) / voice->step, way = steps - (int)steps;
    const Amplitude *from = voice->point + (int)steps;
    if (voice->points == 2) way = (1 - cos(M_PI * way)) / 2;
    return from[0] + (from[1] - from[0]) * way;
}

static double level_of(int channel, double time) {
    double level = 0;
    EACH_OF(channel, voice) {
        Amplitude sum = 0;
        int count = 0;     /* of the same frequency: each adds its share of their sum */
        EACH_OF(channel, other) if (other->is_on && other->frequency == voice->frequency)
            sum += amplitude_of(other, time), count++;
        if (voice->is_on) level += cabs(sum) / count;
    }
    limited |= level > 1 + 1.001 / FULL;
    return fmin(level, 1);
}

double sample_of(int channel, double time) { /* of the output, from -1 to 1 */
    double sum = 0;
    EACH_OF(channel, voice) if (voice->is_on) {
        uint32_t angle = (uint32_t)voice->frequency * clock_word(time);
        sum += cimag(amplitude_of(voice, time) * cexp(I * 2 * M_PI * (angle / 4294967296.0)));
    }
    return fmax(-1, fmin(1, sum));
}
static Amplitude polar(const uint16_t *word) {
    return word[0] / (double)FULL * cexp(I * M_PI * (int16_t)word[1] / 18000);
}
static int is_polar(const uint16_t *word) {
    return word[0] <= FULL && (int16_t)word[1] >= -18000 && (int16_t)word[1] < 18000;
}

static void lead(Voice *voice, double time, const uint16_t *envelope, double ramp, Amplitude to) {
    int knots = envelope ? envelope[0] : 0;
    voice->point[0] = amplitude_of(voice, time);
    for (int i = 1; i <= knots; i++) voice->point[i] = polar(envelope + 2 * i);
    voice->point[knots + 1] = to;
    voice->points = knots + 2, voice->start = time;
    voice->step = envelope ? envelope[1] / 10000.0 : ramp;
}
static void fade(Voice *voice, double time, double ramp) {
    if (last_of(voice) || end_of(voice) > time + ramp) lead(voice, time, NULL, ramp, 0);
    voice->is_released = 1;
}
/* The fade or ending of a channel that began first, of those that last longer. */
static Voice *oldest_fade(int channel, double until) {
    Voice *first = NULL;
    EACH_OF(channel, voice) if (voice->is_released && lasts(voice, until))
        if (!first || voice->start < first->start) first = voice;
    return first;
}

/* Words of a command, and of a layer: more than are left if the stream ends amid it. */
static int words_of_command(const uint16_t *word, int left) {
    int at = 4, envelopes = left < at ? 0 : (word[0] >> 1 & 1) + (word[0] & 1);
    for (; envelopes; envelopes--) at += at + 2 > left ? 2 : 2 + 2 * word[at];
    return at;
}
static int words_of_layer(const uint16_t *word, int left) {
    int at = 3, commands = left < at ? 0 : word[0] & 31;
    for (; commands && at < left; commands--) at += words_of_command(word + at, left - at);
    return at + 4 * commands;
}
static int is_good_command(const uint16_t *word) {
    int flags = word[0], is_driven = word[2] || flags & 2;
    if (flags >> 8 || !is_polar(word + 2)) return 0;
    if (is_driven && (word[1] < FREQUENCY_MIN || word[1] > FREQUENCY_MAX)) return 0;
    word += 4;
    for (int envelopes = (flags >> 1 & 1) + (flags & 1); envelopes; envelopes--) {
        int knots = word[0];
        if (knots > KNOTS || word[1] < 1 || word[1] > 1000) return 0;
        for (word += 2; knots; knots--, word += 2) if (!is_polar(word)) return 0;
    }
    return 1;
}
/* The code for what is wrong with a stream, or 0, and the channel at fault. */
static int check_stream(const uint16_t *word, int count, int *channel) {
    if (count > SET_WORDS) return BAD_LENGTH;
    for (int seen = 0; count;) {
        int head = word[0], layer = head >> 7, commands = head & 31, channels = 0;
        int size = words_of_layer(word, count);
        if (size > count) return BAD_LENGTH;
        int is_odd = commands ? head >> 5 & 1 : head >> 6 & 1; /* renew with, after without */
        if (is_odd || layer >= LAYERS || seen >> layer & 1) return BAD_VALUE;
        if (word[1] > RAMP_MAX || word[2] > 60000) return BAD_VALUE;
        seen |= 1 << layer, count -= size;
        for (word += 3; commands; commands--, word += words_of_command(word, SET_WORDS)) {
            *channel = word[0] >> 4 & 15;
            if (*channel >= CHANNELS || channels >> *channel & 1) return BAD_CHANNEL;
            if (!is_good_command(word)) return BAD_VALUE;
            channels |= 1 << *channel;
        }
        *channel = NO_CHANNEL;
    }
    return 0;
}

/* Begin the commands of a layer, given by its words; without any it falls silent. */
static void play(const uint16_t *word, int count, uint16_t token, double time) {
    Layer *layer = &layers[word[0] >> 7];
    double ramp = word[1] / 1000.0;
    layer->waiting.token = 0, layer->ends = count && word[2] ? time + word[2] / 1000.0 : 0;
    EACH_CHANNEL(channel) {
        static const uint16_t none[4];
        const uint16_t *command = none, *next = word + 3;
        for (int i = 0; i < count; i++, next += words_of_command(next, SET_WORDS))
            if (next[0] >> 4 == channel) command = next;
        const uint16_t *onset = command[0] & 2 ? command + 4 : NULL;
        const uint16_t *ending = command + (onset ? 6 + 2 * onset[0] : 4);
        int is_driven = command[2] || onset, keeps_phase = command[0] & 8;
        Voice *voice = NULL;
        EACH_OF(channel, each) if (plays_in(each, word[0] >> 7)) voice = each;
        if (voice && !(is_driven && keeps_phase && voice->frequency == command[1])) {
            if (is_driven || command[0] & 4 || !voice->has_ending) fade(voice, time, ramp);
            else lead(voice, time, voice->ending, ramp, 0);
            voice->is_released = 1, voice = NULL;
        }
        if (!is_driven) continue;
        if (!voice) {
            voice = oldest_fade(channel, 0);
            EACH_OF(channel, each) if (!each->is_on) voice = each;
            *voice = (Voice){.is_on = 1, .layer = word[0] >> 7, .points = 1, .start = time};
        }
        lead(voice, time, onset, ramp, polar(command + 2));
        voice->frequency = command[1], voice->level = command[2], voice->phase = command[3];
        voice->has_ending = command[0] & 1;
        if (voice->has_ending) memcpy(voice->ending, ending, (2 + 2 * ending[0]) * sizeof *word);
        int excess = -VOICES;
        EACH_OF(channel, each) excess += lasts(each, time + 0.002);
        for (; excess > 0; excess--) fade(oldest_fade(channel, time + 0.002), time, 0.002);
    }
    if (count) layer->token = token, memcpy(layer->head, word, sizeof layer->head);
}

static void start(const Stream *stream, double time) {
    for (int at = 0, size; at < stream->words; at += size) {
        const uint16_t *word = stream->word + at;
        int layer = word[0] >> 7, is_after = word[0] >> 6 & 1, renews = word[0] >> 5 & 1;
        double waits_until = time;
        EACH_VOICE(channel, voice) if (plays_in(voice, layer) && voice->points > 2)
            waits_until = fmax(waits_until, end_of(voice));
        Layer *one = &layers[layer];
        size = words_of_layer(word, stream->words - at);
        if (renews) {
            if (!is_over(layer)) one->ends = word[2] ? time + word[2] / 1000.0 : 0;
        } else if (is_after && waits_until > time) {
            one->waits_until = waits_until;
            one->waiting.token = stream->token, one->waiting.words = size;
            memcpy(one->waiting.word, word, size * sizeof *word);
        } else play(word, word[0] & 31, stream->token, time);
    }
}

static int state = DISABLED, fault;
static uint16_t session, latch, committed;
static double watchdog, last_fed, faults_at[2] = {-1, -1};
static Stream staged, waiting;
static double waits_for;   /* the clock at which what waits starts */
static struct {            /* what is staged keeps its token here, too */
    uint16_t token, word[127][117];
    int parts, length[127]; /* one more than the words of a part, 0 for none */
    double began;
} collected;

static int is_newer(uint16_t token, uint16_t than) {
    return !than || (token != than && (uint16_t)(token - than) < 32768);
}
static void drop_set(void) { memset(&collected, 0, sizeof collected), staged.token = 0; }
static void silence(double time, double ramp) {
    for (int i = 0; i < LAYERS; i++) layers[i].ends = layers[i].waiting.token = 0;
    EACH_VOICE(channel, voice) if (voice->is_on) fade(voice, time, ramp);
    drop_set(), waiting.token = 0;
}

/* Let happen what is due until now, each at its moment. */
static void tick(double now) {
    for (double time = -1; time < now;) {
        time = now;
        if (state == ENABLED) time = fmin(time, last_fed + watchdog);
        if (waiting.token) time = fmin(time, moment_of(waits_for));
        for (Layer *one = layers; one < layers + LAYERS; one++) {
            if (one->waiting.token) time = fmin(time, one->waits_until);
            if (one->ends) time = fmin(time, one->ends);
        }
        EACH_VOICE(c, each) if (end_of(each) < time && !lasts(each, time)) each->is_on = 0;
        if (state == ENABLED && time >= last_fed + watchdog) {
            faults_at[1] = faults_at[0], faults_at[0] = time;
            silence(time, 0.005), set_clock(time, 0, 0);
            state = REACTION, fault = WATCHDOG_FAULT, latch = latch % 65535 + 1;
        }
        if (collected.token && time >= collected.began + 1) drop_set();
        if (waiting.token && time >= moment_of(waits_for)) start(&waiting, time), waiting.token = 0;
        for (Layer *one = layers; one < layers + LAYERS; one++) {
            const uint16_t *next = one->waiting.word;
            int starts = one->waiting.token && time >= one->waits_until;
            if (starts) play(next, next[0] & 31, one->waiting.token, time);
            else if (one->ends && time >= one->ends) play(one->head, 0, 0, time);
        }
        is_silent = 1;
        EACH_VOICE(channel, voice) if ((voice->is_on = lasts(voice, time))) is_silent = 0;
        EACH_CHANNEL(channel) level_of(channel, time);
        if (is_silent && state == REACTION) state = FAULT;
        if (is_silent && state == SWITCHED_ON) state = DISABLED;
    }
}

/* Start what is staged: at once, or in some steps of the high word of the clock. */
static void commit(double now, uint16_t steps) {
    if (waiting.token) start(&waiting, now), waiting.token = 0;
    committed = staged.token;
    waits_for = (floor(clock_at(now) / 65536) + steps) * 65536;
    if (steps >= 1 && steps <= 1638) waiting = staged;
    else start(&staged, now);
    drop_set();
}

/* Requests: words in, words out; the code of a refusal, 0, or -1 for a part that is not kept. */
static uint16_t out[120];
static int out_count;
static void put(uint32_t word) { out[out_count++] = (uint16_t)word; }
static int take_part(const uint16_t *in, int count, double now, int *channel) {
    static uint16_t word[127 * 117];
    uint16_t token = in[1];
    int index = in[2] >> 8, parts = in[2] >> 1 & 127, plays = in[2] & 1, words = 0;
    int is_same = token == collected.token, is_staged = token == staged.token;
    int is_old = !is_newer(token, committed) || !(is_same || is_newer(token, collected.token));
    if (index < parts - 1) {
        if (is_old || is_staged || (is_same && parts != collected.parts)) return -1;
        if (!is_same) drop_set(), collected.began = now;
        collected.token = token, collected.parts = parts, collected.length[index] = count + 1;
        memcpy(collected.word[index], in + 3, count * sizeof *in);
        return 0;
    }
    if (token != committed && !is_staged) {
        if (is_old) return BAD_TOKEN;
        if (index >= parts || (is_same && parts != collected.parts)) return BAD_VALUE;
        for (int i = 0; i < index; words += collected.length[i++] - 1) {
            if (!is_same || !collected.length[i]) return put(token), put(0), put(i), 0;
            memcpy(word + words, collected.word[i], (collected.length[i] - 1) * sizeof *in);
        }
        memcpy(word + words, in + 3, count * sizeof *in), words += count;
        int code = check_stream(word, words, channel);
        if (code && is_same) drop_set();
        if (code) return code;
        if (!is_same) collected.began = now;
        collected.token = staged.token = token, staged.words = words;
        memcpy(staged.word, word, words * sizeof *word);
    }
    if (token != committed && plays) commit(now, 0);
    return put(token), put(token == committed ? 5 : 6), put(0), 0; /* exact, and which */
}

static int handle(int type, const uint16_t *in, int bytes, double now, int *channel) {
    static const char *const kinds[] = { /* session, token, watchdog, ramp, layer, others */
        "", "sw*", "*", "st*", "st*", "sr", "*", "", "", "*", "s*", "l"};
    if (type < GET_CAPS || type > GET_ACHIEVED) return UNKNOWN_TYPE;
    const char *kind = kinds[type - GET_CAPS];
    int count = (int)strlen(kind), feeds = kind[0] == 's', is_armed = state == ENABLED, code = 0;
    for (int i = 0; i < count; i++) {
        int word = in[i];
        if (bytes % 2 || bytes < 2 * i + 2) return BAD_LENGTH;
        if (kind[i] == 't' && !word) return BAD_TOKEN;
        if ((kind[i] == 's' && !word) || (kind[i] == 'w' && (word < 100 || word > 2000)) ||
            (kind[i] == 'r' && word > RAMP_MAX) || (kind[i] == 'l' && word > 15)) return BAD_VALUE;
    }
    if (bytes % 2 || (type != SET && bytes > 2 * count)) return BAD_LENGTH;
    if (type == ARM ? state > ENABLED : feeds && type != PING && !is_armed) return WRONG_STATE;
    if (feeds && is_armed && in[0] != session) return WRONG_SESSION;
    if (type == ARM && !is_armed && in[0] == session) return WRONG_SESSION;
    if (type == ARM) {
        watchdog = in[1] / 1000.0, session = in[0], state = ENABLED;
        if (!is_armed) silence(now, 0.005), set_clock(now, in[2], 0), committed = 0;
    } else if (type == DISARM || type == STOP) {
        silence(now, fmin(in[0], RAMP_MAX) / 1000), set_clock(now, 0, 0);
        if (type == STOP) latch = latch % 65535 + 1;
        if (type == STOP && state < STOPPED) state = STOPPED;
        if (type == DISARM && is_armed) state = SWITCHED_ON;
    } else if (type == SILENCE) silence(now, in[1] / 1000.0);
    else if (type == CLEAR && (state == STOPPED || state == FAULT)) {
        if (in[0] != latch) return WRONG_LATCH;
        if (is_silent) state = DISABLED, fault = 0;
    } else if (type == PING && is_armed) set_clock(now, 0, (int16_t)in[1]);
    else if (type == SET) code = take_part(in, bytes / 2 - 3, now, channel);
    else if (type == COMMIT && in[1] != committed) {
        if (in[1] != collected.token) return BAD_TOKEN;
        if (in[1] != staged.token) return INCOMPLETE;
        commit(now, (uint16_t)(in[2] - (clock_word(now) >> 16)));
    } else if (type == GET_ACHIEVED && in[0] >= LAYERS) return BAD_VALUE;
    if (feeds && state == ENABLED && !code) last_fed = now;
    tick(now);
    return code;
}

static void put_status(double now) {
    int is_high = state == ENABLED || !is_silent;
    put(state), put(fault), put(is_high | limited << 2), put(latch), limited = 0;
    put(state == ENABLED ? (int)lround(1000 * (last_fed + watchdog - now)) : 0);
    put(250), put(is_high ? 1800 : 0), put(clock_word(now) >> 16), put(clock_word(now));
    put(committed), put(CHANNELS << 8 | LAYERS);
    EACH_CHANNEL(i) put((int)lround(FULL * level_of(i, now)));
    for (int i = 0; i < LAYERS; i++) put(is_over(i) ? 0 : layers[i].token);
}
static void put_achieved(int layer) {
    static const Layer none;
    const Layer *one = is_over(layer) ? &none : &layers[layer];
    put(one->token), put(layer << 7), put(one->head[1]), put(one->head[2]);
    EACH_VOICE(channel, voice) if (plays_in(voice, layer)) {
        put(channel << 4), put(voice->frequency), put(voice->level), put(voice->phase);
        out[1]++;          /* count */
    }
}
static void put_reply(int type, const uint16_t *in, double now) {
    static const uint16_t caps[] = {CHANNELS, LAYERS, VOICES, SET_WORDS, KNOTS, 0, FREQUENCY_MIN,
                                    FREQUENCY_MAX, 1, FULL, 1, 1, RAMP_MAX, 0, 100, 2000, 1, 1000,
                                    10, FREQUENCY_MIN, FREQUENCY_MAX, FULL, FREQUENCY_MIN,
                                    FREQUENCY_MAX, FULL};
    if (type == GET_CAPS) {
        for (unsigned i = 0; i < sizeof caps / sizeof *caps; i++) put(caps[i]);
    } else if (type == GET_FAULTS) {
        put((faults_at[0] >= 0) + (faults_at[1] >= 0));
        for (int i = 0; i < 2 && faults_at[i] >= 0; i++) {
            uint32_t age = (uint32_t)(1000 * (now - faults_at[i]));
            put(WATCHDOG_FAULT), put(NO_CHANNEL), put(age >> 16), put(age);
        }
    } else if (type == GET_ACHIEVED) put_achieved(in[0]);
    else if (type != SET) put_status(now);
}

/* The serial line: 00, COBS of (type, version, address, sequence, payload, CRC-32), 00. */
enum { CRC_WITH_CRC = 0x2144DF1C }; /* of any bytes with their CRC behind them */
static uint32_t crc_of(const uint8_t *data, int length) {
    uint32_t crc = 0xFFFFFFFF;
    for (int bit = 0; bit < 8 * length; bit++) {
        crc ^= data[bit / 8] >> bit % 8 & 1;
        crc = crc >> 1 ^ (crc & 1 ? 0xEDB88320 : 0);
    }
    return ~crc;
}
static void send_frame(int line, uint8_t *frame, int length) {
    uint32_t crc = crc_of(frame, length);
    for (int i = 0; i < 4; i++) frame[length++] = (uint8_t)(crc >> 8 * i);
    uint8_t stuffed[PAYLOAD + 16] = {0};
    int code = 1;
    for (int i = 0; i < length; i++) {
        stuffed[i + 2] = frame[i];
        if (!frame[i]) stuffed[code] = (uint8_t)(i + 2 - code), code = i + 2;
    }
    stuffed[code] = (uint8_t)(length + 2 - code);
    if (write(line, stuffed, length + 3) != length + 3) perror("write");
}

static void received(int line, const uint8_t *stuffed, int length, double now) {
    static const char hello[] = "\x10\0" "\3you" "\22smallest amplifier" "\12SMALLEST-1" "\0011";
    uint8_t frame[PAYLOAD + 16];
    int size = 0, code_at = 0;
    for (int i = 0; i < length; i++) {
        if (i) frame[size++] = i == code_at ? 0 : stuffed[i];
        if (i == code_at) code_at += stuffed[i];
    }
    if (code_at != length || size < 9 || crc_of(frame, size) != CRC_WITH_CRC) return;
    int type = frame[0], address = frame[2], bytes = size - 9;
    int is_known = frame[1] == VERSION, is_for_all = is_known && (type == COMMIT || type == STOP);
    if (type & REPLY || type == EVENT) return;
    if (address != ADDRESS && !(address == BROADCAST && is_for_all)) return;
    if (type == HELLO) {
        frame[0] = HELLO | REPLY, frame[1] = 0;
        memcpy(frame + 5, hello, sizeof hello - 1);
        send_frame(line, frame, 5 + sizeof hello - 1);
        return;
    }
    uint16_t in[PAYLOAD / 2] = {0};
    for (int i = 0; i < bytes; i++) in[i / 2] |= (uint16_t)(frame[5 + i] << 8 * (i % 2));
    out_count = 0;
    tick(now);
    int channel = NO_CHANNEL;
    int code = is_known ? handle(type, in, bytes, now, &channel) : UNSUPPORTED_VERSION;
    int is_part = is_known && type == SET && bytes >= 6 && in[2] >> 8 < (in[2] >> 1 & 127) - 1;
    if (address == BROADCAST || is_part) return;
    if (code) out_count = 0, put(type), put(code), put(channel);
    else put_reply(type, in, now);
    frame[0] = (uint8_t)((code ? NAK : type) | REPLY), frame[1] = is_known ? VERSION : 0;
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

int main(int argc, char **argv) {
    if (argc != 2) return fprintf(stderr, "usage: amplifier TTY | --pty\n"), 2;
    int is_pty = !strcmp(argv[1], "--pty"), flags = O_RDWR | O_NOCTTY;
    int line = is_pty ? posix_openpt(flags) : open(argv[1], flags), far = line;
    if (is_pty) far = grantpt(line) || unlockpt(line) ? -1 : open(ptsname(line), flags);
    struct termios raw;
    if (far < 0 || tcgetattr(far, &raw)) return perror(argv[1]), 2;
    cfmakeraw(&raw), cfsetspeed(&raw, B921600), tcsetattr(far, TCSANOW, &raw);
    if (is_pty) printf("serial://%s\n", ptsname(line)), fflush(stdout);
    uint8_t data[256];
    struct pollfd ready = {.fd = line, .events = POLLIN};
    for (;;) {
        poll(&ready, 1, 1);
        if (ready.revents & (POLLHUP | POLLERR)) return 0;
        ssize_t count = ready.revents & POLLIN ? read(line, data, sizeof data) : 0;
        struct timespec clock;
        clock_gettime(CLOCK_MONOTONIC, &clock);
        double now = (double)clock.tv_sec + clock.tv_nsec / 1e9;
        tick(now);
        take(line, data, count, now);
    }
}
