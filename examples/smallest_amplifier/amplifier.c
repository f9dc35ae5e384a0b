/* The smallest amplifier of protocol 4: two channels on a serial line, in one file.
 *
 *     cc -O2 -o amplifier amplifier.c -lm && ./amplifier --pty    (or /dev/ttyUSB0)
 *
 * Written from the rules of the protocol alone. It plays nothing: `level_of` is where the samples
 * of a channel come from. Times are in seconds, amplitudes in full levels.
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

enum { CHANNELS = 2, LAYERS = 4, VOICES = 8, KNOTS = 32, SET_WORDS = 512, PAYLOAD = 240 };
enum { ADDRESS = 1, BROADCAST = 0, VERSION = 3, REPLY = 0x80, NO_CHANNEL = 255 };
enum { HELLO = 1, GET_CAPS, ARM, DISARM, SET, COMMIT, SILENCE, STOP, GET_STATUS, GET_FAULTS, CLEAR,
       PING, GET_ACHIEVED, EVENT = 30, NAK };
enum { UNKNOWN_TYPE = 1, BAD_LENGTH, BAD_VALUE, BAD_CHANNEL, WRONG_STATE, BAD_TOKEN,
       UNSUPPORTED_VERSION = 8, WRONG_SESSION = 10, WRONG_LATCH, INCOMPLETE };
enum { DISABLED = 1, SWITCHED_ON = 3, ENABLED, STOPPED, REACTION, FAULT, WATCHDOG_FAULT = 1 };
enum { FREQUENCY_MIN = 200, FREQUENCY_MAX = 20000, FULL = 10000, RAMP_MAX = 1000 };

typedef struct {
    int knots;
    double step;
    double complex knot[KNOTS];
} Envelope;

typedef struct {           /* a tone, from start through its points, a step apart */
    int is_on, layer, has_ended, has_ending, points;
    double frequency, origin, start, step;
    double complex point[KNOTS + 2];
    Envelope ending;
} Voice;

typedef struct {
    uint16_t token, ramp, valid_for, waiting[SET_WORDS], waiting_token;
    int waiting_words;
    double ends, waits_until;
} Layer;

static Voice voices[CHANNELS][VOICES];
static Layer layers[LAYERS];
static int limited;        /* the sum of a channel, since the last status */

#define EACH_VOICE(channel, voice)                      \
    for (int channel = 0; channel < CHANNELS; channel++) \
        for (Voice *voice = voices[channel]; voice < voices[channel] + VOICES; voice++)

static int plays_in(const Voice *voice, int layer) {
    return voice->is_on && voice->layer == layer && !voice->has_ended;
}

static double end_of(const Voice *one) { return one->start + one->step * (one->points - 1); }
static double complex last_of(const Voice *voice) { return voice->point[voice->points - 1]; }

static double complex amplitude_of(const Voice *voice, double time) {
    if (time >= end_of(voice)) return last_of(voice);
    double steps = (time - voice->start) / voice->step, way = steps - (int)steps;
    int index = (int)steps;
    if (voice->points == 2) way = (1 - cos(M_PI * way)) / 2;
    return voice->point[index] + (voice->point[index + 1] - voice->point[index]) * way;
}

static double level_of(int channel, double time) { /* at the most: voices may cancel */
    double level = 0;
    for (int i = 0; i < VOICES; i++)
        if (voices[channel][i].is_on) level += cabs(amplitude_of(&voices[channel][i], time));
    if (level > 1 + 0.5 / FULL) limited = 1;
    return fmin(level, 1);
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

static void fade(Voice *voice, double time, double ramp, int by_ending) {
    int was_fading = voice->has_ended;
    voice->has_ended = 1;
    if (by_ending && voice->has_ending && !was_fading) lead(voice, time, &voice->ending, ramp, 0);
    else if (last_of(voice) || end_of(voice) > time + ramp) lead(voice, time, NULL, ramp, 0);
}

static void let_last(int layer) { layers[layer].ends = layers[layer].waits_until = INFINITY; }
static void fade_layer(int layer, double time, double ramp, int by_ending) {
    EACH_VOICE(channel, voice) if (plays_in(voice, layer)) fade(voice, time, ramp, by_ending);
    let_last(layer);
}

static Voice *free_voice(int channel) { /* or the one that began to fade first: layers are fewer */
    Voice *oldest = NULL;
    for (Voice *voice = voices[channel]; voice < voices[channel] + VOICES; voice++) {
        if (!voice->is_on) return voice;
        if (voice->has_ended && (!oldest || voice->start < oldest->start)) oldest = voice;
    }
    return oldest;
}

typedef struct {
    const uint16_t *word;
    int count, at, code, channel;
} Words;

static uint16_t next(Words *words) {
    if (words->at < words->count) return words->word[words->at++];
    words->code = BAD_LENGTH;
    return 0;
}

static void check(Words *words, int is_good, int code, int channel) {
    if (!is_good && !words->code) words->code = code, words->channel = channel;
}

/* Read a level and a phase. */
static double complex polar(Words *words, int channel) {
    uint16_t level = next(words);
    int16_t phase = (int16_t)next(words);
    check(words, level <= FULL && phase >= -18000 && phase < 18000, BAD_VALUE, channel);
    return level / (double)FULL * cexp(I * M_PI * phase / 18000);
}

static void read_envelope(Words *words, Envelope *envelope, int channel) {
    int knots = next(words), step = next(words);
    check(words, knots <= KNOTS && step >= 10 && step <= 1000, BAD_VALUE, channel);
    if (words->code) return;
    envelope->knots = knots, envelope->step = step / 10000.0;
    for (int i = 0; i < knots; i++) envelope->knot[i] = polar(words, channel);
}

/* Read one layer; with `plays` its commands start at a time, else it is only checked. */
static void read_layer(Words *words, int plays, uint16_t token, double time, int is_due) {
    int start = words->at;
    uint16_t head = next(words), ramp = next(words), valid_for = next(words);
    int layer = head >> 7, after = head >> 6 & 1, renew = head >> 5 & 1, count = head & 31;
    check(words, layer < LAYERS && ramp <= RAMP_MAX, BAD_VALUE, NO_CHANNEL);
    check(words, valid_for <= 60000 && !(count ? renew : after), BAD_VALUE, NO_CHANNEL);
    if (words->code) return;
    double ends = valid_for ? time + valid_for / 1000.0 : INFINITY, waits = time;
    Layer *state = &layers[layer];
    if (plays && renew) { state->ends = ends; return; }
    if (plays && after && !is_due)
        EACH_VOICE(channel, voice)
            if (plays_in(voice, layer) && voice->points > 2) waits = fmax(waits, end_of(voice));
    int plays_now = plays && waits <= time, named = 0;
    for (int i = 0; i < count; i++) {
        uint16_t flags = next(words), frequency = next(words);
        int channel = flags >> 4 & 15, has_onset = flags >> 1 & 1, has_ending = flags & 1;
        check(words, !(flags >> 8), BAD_VALUE, NO_CHANNEL);
        int is_new = channel < CHANNELS && !(named >> channel & 1);
        double complex last = polar(words, channel);
        check(words, is_new, BAD_CHANNEL, channel);
        int is_driven = last != 0 || has_onset;
        int is_within = frequency >= FREQUENCY_MIN && frequency <= FREQUENCY_MAX;
        check(words, is_within || !is_driven, BAD_VALUE, channel);
        Envelope onset, ending;
        if (has_onset) read_envelope(words, &onset, channel);
        if (has_ending) read_envelope(words, &ending, channel);
        if (words->code) return;
        named |= 1 << channel;
        if (!plays_now) continue;
        Voice *kept = NULL;
        for (Voice *voice = voices[channel]; voice < voices[channel] + VOICES; voice++) {
            if (!plays_in(voice, layer)) continue;
            int keeps = flags >> 3 & 1 && voice->frequency == frequency / 20.0;
            if (is_driven && keeps) kept = voice;
            else fade(voice, time, ramp / 1000.0, !is_driven && !(flags >> 2 & 1));
        }
        if (!is_driven) continue;
        if (!kept) {
            kept = free_voice(channel);
            *kept = (Voice){.is_on = 1, .layer = layer, .points = 1, .frequency = frequency / 20.0,
                            .origin = time, .start = time};
        }
        lead(kept, time, has_onset ? &onset : NULL, ramp / 1000.0, last);
        kept->has_ending = has_ending;
        if (has_ending) kept->ending = ending;
    }
    if (!plays) return;
    state->waits_until = INFINITY;
    if (!plays_now) {
        state->waits_until = waits;
        state->waiting_words = words->at - start;
        memcpy(state->waiting, words->word + start, state->waiting_words * sizeof(uint16_t));
        state->waiting_token = token;
        return;
    }
    EACH_VOICE(channel, voice)
        if (plays_in(voice, layer) && !(named >> channel & 1)) fade(voice, time, ramp / 1000.0, 1);
    state->token = token, state->ramp = ramp, state->valid_for = valid_for, state->ends = ends;
}

static int state = DISABLED, fault;
static uint16_t session, latch, committed;
static double watchdog, last_fed, silent_from, faults_at[2] = {-1, -1};
static struct {
    uint16_t token, word[SET_WORDS], part[127][118];
    int words, parts, length[127], is_whole;
    double began;
} staged;

static uint16_t after(uint16_t number) { return number == 65535 ? 1 : number + 1; }
static int is_newer(uint16_t token, uint16_t than) {
    return !than || (token != than && (uint16_t)(token - than) < 32768);
}

static void silence(double time, double ramp) {
    silent_from = time;
    for (int layer = 0; layer < LAYERS; layer++) let_last(layer);
    EACH_VOICE(channel, voice) {
        if (!voice->is_on) continue;
        fade(voice, time, ramp, 0);
        silent_from = fmax(silent_from, end_of(voice));
    }
    memset(&staged, 0, sizeof staged);
}

static void tick(double now) {
    if (state == ENABLED && now >= last_fed + watchdog) {
        faults_at[1] = faults_at[0], faults_at[0] = last_fed + watchdog;
        silence(faults_at[0], 0.005);
        state = REACTION, fault = WATCHDOG_FAULT, latch = after(latch);
    }
    for (int layer = 0; layer < LAYERS; layer++) {
        Layer *one = &layers[layer];
        if (now >= one->waits_until) {
            Words words = {.word = one->waiting, .count = one->waiting_words};
            read_layer(&words, 1, one->waiting_token, one->waits_until, 1);
        }
        if (now >= one->ends) fade_layer(layer, one->ends, one->ramp / 1000.0, 1);
    }
    EACH_VOICE(channel, voice)
        if (voice->is_on && !last_of(voice) && now >= end_of(voice)) voice->is_on = 0;
    for (int channel = 0; channel < CHANNELS; channel++) level_of(channel, now);
    if (state == REACTION && now >= silent_from) state = FAULT;
    if (state == SWITCHED_ON && now >= silent_from) state = DISABLED;
}

/* Requests: words in, words out; the code of a refusal, or 0. */
static uint16_t out[120];
static int out_count;
static void put(int word) { out[out_count++] = (uint16_t)word; }

static int token_of(int layer) {
    EACH_VOICE(channel, voice) if (plays_in(voice, layer)) return layers[layer].token;
    return 0;
}
static void status(double now) {
    int is_on = state == ENABLED || state == SWITCHED_ON || now < silent_from;
    put(state), put(fault), put(is_on | limited << 2), put(latch), limited = 0;
    put(state == ENABLED ? (int)lround(1000 * (last_fed + watchdog - now)) : 0);
    put(250), put(is_on ? 1800 : 0), put(committed), put(CHANNELS << 8 | LAYERS);
    for (int channel = 0; channel < CHANNELS; channel++)
        put((int)lround(FULL * level_of(channel, now)));
    for (int layer = 0; layer < LAYERS; layer++) put(token_of(layer));
}

static void play(const uint16_t *word, int count, uint16_t token, double now) {
    Words words = {.word = word, .count = count};
    while (words.at < count) read_layer(&words, 1, token, now, 0);
    committed = token;
    staged.is_whole = staged.parts = 0;
}

static int drop(int code) { return memset(&staged, 0, sizeof staged), code; }
static int taken(uint16_t token, int is_staged, int is_played, int missing) {
    return put(token), put(1 << 2 | is_staged << 1 | is_played), put(missing), 0;
}

static int take_part(const uint16_t *in, int count, double now, int *channel) {
    uint16_t token = in[1];
    int index = in[2] >> 8, parts = in[2] >> 1 & 127, plays = in[2] & 1;
    if (token == committed) return taken(token, 0, 1, 0);
    if (!token || !is_newer(token, committed)) return BAD_TOKEN;
    if (index >= parts || count > 121) return BAD_VALUE;
    if (staged.token != token || now - staged.began > 1) {
        if (staged.token && now - staged.began <= 1 && !is_newer(token, staged.token))
            return BAD_TOKEN;
        memset(&staged, 0, sizeof staged);
        staged.token = token, staged.parts = parts, staged.began = now;
    }
    if (staged.is_whole) return taken(token, 1, 0, 0);
    if (staged.parts != parts) return BAD_VALUE;
    memcpy(staged.part[index], in + 3, (count - 3) * sizeof *in);
    staged.length[index] = count - 3 + 1;
    for (int i = 0; i < parts; i++)
        if (!staged.length[i]) return taken(token, 0, 0, i);
    staged.words = 0;
    for (int i = 0; i < parts; i++) {
        int length = staged.length[i] - 1;
        if (staged.words + length > SET_WORDS) return drop(BAD_LENGTH);
        memcpy(staged.word + staged.words, staged.part[i], length * sizeof *in);
        staged.words += length;
    }
    Words words = {.word = staged.word, .count = staged.words, .channel = NO_CHANNEL};
    int seen = 0;
    while (words.at < words.count && !words.code) {
        int layer = staged.word[words.at] >> 7 & 15;
        check(&words, !(seen >> layer & 1), BAD_VALUE, NO_CHANNEL);
        seen |= 1 << layer;
        read_layer(&words, 0, 0, 0, 0);
    }
    if (words.code) return *channel = words.channel, drop(words.code);
    staged.is_whole = 1;
    if (plays) play(staged.word, staged.words, token, now);
    return taken(token, !plays, plays, 0);
}

static int commit(uint16_t token, double now) {
    if (token == committed) return 0;
    if (staged.token != token || now - staged.began > 1) return BAD_TOKEN;
    if (!staged.is_whole) return staged.parts ? INCOMPLETE : BAD_TOKEN;
    play(staged.word, staged.words, token, now);
    return 0;
}

static int achieved(int layer) {
    if (layer >= LAYERS) return BAD_VALUE;
    int token = token_of(layer), count = 0, head = out_count + 1;
    put(token), put(0);
    put(token ? layers[layer].ramp : 0), put(token ? layers[layer].valid_for : 0);
    EACH_VOICE(channel, voice) {
        if (!plays_in(voice, layer)) continue;
        put(channel << 4), put((int)lround(20 * voice->frequency));
        put((int)lround(FULL * cabs(last_of(voice))));
        put((int)lround(18000 / M_PI * carg(last_of(voice))));
        count++;
    }
    out[head] = (uint16_t)(layer << 7 | count);
    return 0;
}

static int handle(int type, const uint16_t *in, int count, double now, int *channel) {
    static const int lengths[] = {[ARM] = 2, [DISARM] = 1, [SET] = 3, [COMMIT] = 2, [SILENCE] = 2,
                                  [STOP] = 1, [CLEAR] = 1, [PING] = 1, [GET_ACHIEVED] = 1};
    if (type < GET_CAPS || type > GET_ACHIEVED) return UNKNOWN_TYPE;
    if (count < lengths[type] || (type != SET && count > lengths[type])) return BAD_LENGTH;
    int feeds = type == ARM || type == SET || type == COMMIT || type == SILENCE || type == PING;
    int plays = type == SET || type == COMMIT || type == SILENCE, code = 0;
    if ((plays && state != ENABLED) || (type == ARM && state > ENABLED)) return WRONG_STATE;
    if (feeds && !in[0]) return BAD_VALUE;
    if (feeds && state == ENABLED && in[0] != session) return WRONG_SESSION;
    if (type == ARM && state != ENABLED && in[0] == session) return WRONG_SESSION;
    if (type == ARM && (in[1] < 100 || in[1] > 2000)) return BAD_VALUE;
    if (type == SILENCE && in[1] > RAMP_MAX) return BAD_VALUE;
    if (type == ARM) {
        watchdog = in[1] / 1000.0;
        if (state != ENABLED) silence(now, 0.005), committed = 0, session = in[0], state = ENABLED;
    } else if (type == DISARM || type == STOP) {
        if (type == STOP) latch = after(latch);
        silence(now, fmin(in[0], RAMP_MAX) / 1000);
        if (type == DISARM && state == ENABLED) state = SWITCHED_ON;
        if (type == STOP && state < REACTION) state = STOPPED;
    } else if (type == SILENCE) {
        silence(now, in[1] / 1000.0);
    } else if (type == CLEAR && state >= STOPPED) {
        if (in[0] != latch) return WRONG_LATCH;
        if (now >= silent_from && state != REACTION) state = DISABLED, fault = 0;
    } else if (type == SET) {
        code = take_part(in, count, now, channel);
    } else if (type == COMMIT) {
        code = in[1] ? commit(in[1], now) : BAD_TOKEN;
    }
    if (code) return code;
    if (feeds && state == ENABLED) last_fed = now;
    tick(now);
    if (type == SET || type == GET_ACHIEVED) return type == SET ? 0 : achieved(in[0]);
    if (type == GET_FAULTS) {
        put((faults_at[0] >= 0) + (faults_at[1] >= 0));
        for (int i = 0; i < 2 && faults_at[i] >= 0; i++) {
            uint32_t age = (uint32_t)(1000 * (now - faults_at[i]));
            put(WATCHDOG_FAULT), put(NO_CHANNEL), put(age >> 16), put(age & 0xFFFF);
        }
        return 0;
    }
    if (type != GET_CAPS) return status(now), 0;
    int caps[] = {CHANNELS, LAYERS, VOICES, SET_WORDS, KNOTS, 0, FREQUENCY_MIN, FREQUENCY_MAX, 1,
                  FULL, 1, 1, RAMP_MAX, 65535, 100, 2000, 10, 1000};
    for (unsigned i = 0; i < sizeof caps / sizeof *caps; i++) put(caps[i]);
    for (int i = 0; i < CHANNELS; i++) put(FREQUENCY_MIN), put(FREQUENCY_MAX), put(FULL);
    return 0;
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
    if (size < 9 || size > PAYLOAD + 9) return;
    uint32_t crc = 0;
    for (int i = 0; i < 4; i++) crc |= (uint32_t)frame[size - 4 + i] << 8 * i;
    int type = frame[0], address = frame[2], bytes = size - 9;
    if (crc != crc_of(frame, size - 4) || type & REPLY || type == EVENT) return;
    if (address != ADDRESS && !(address == BROADCAST && (type == COMMIT || type == STOP))) return;
    tick(now);
    int code = 0, channel = NO_CHANNEL, version = VERSION;
    uint16_t in[PAYLOAD / 2] = {0};
    for (int i = 0; i < bytes; i++) in[i / 2] |= (uint16_t)(frame[5 + i] << 8 * (i % 2));
    out_count = 0;
    if (type == HELLO) {
        static const char *const texts[] = {"you", "smallest amplifier", "SMALLEST-1", "1"};
        frame[0] = HELLO | REPLY, frame[1] = 0, frame[5] = 1 << VERSION, frame[6] = 0;
        int at = 7;
        for (int i = 0; i < 4; i++) {
            frame[at] = (uint8_t)strlen(texts[i]);
            memcpy(frame + at + 1, texts[i], frame[at]), at += 1 + frame[at];
        }
        send_frame(line, frame, at);
        return;
    }
    if (frame[1] != VERSION) code = UNSUPPORTED_VERSION, version = 0;
    else if (bytes % 2) code = BAD_LENGTH;
    else code = handle(type, in, bytes / 2, now, &channel);
    if (address == BROADCAST) return;
    if (code) out_count = 0, put(type), put(code), put(channel);
    frame[0] = (uint8_t)((code ? NAK : type) | REPLY), frame[1] = (uint8_t)version;
    for (int i = 0; i < 2 * out_count; i++) frame[5 + i] = (uint8_t)(out[i / 2] >> 8 * (i % 2));
    send_frame(line, frame, 5 + 2 * out_count);
}

static void take(int line, const uint8_t *data, ssize_t count, double now) {
    static uint8_t frame[PAYLOAD + 16];
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
    cfmakeraw(&raw);
    cfsetspeed(&raw, B921600);
    tcsetattr(far, TCSANOW, &raw);
    if (is_pty) printf("serial://%s\n", ptsname(line)), fflush(stdout);
    for (int layer = 0; layer < LAYERS; layer++) let_last(layer);
    uint8_t data[256];
    struct pollfd ready = {.fd = line, .events = POLLIN};
    for (;;) {
        poll(&ready, 1, 1);
        struct timespec clock;
        clock_gettime(CLOCK_MONOTONIC, &clock);
        double now = (double)clock.tv_sec + clock.tv_nsec / 1e9;
        tick(now);
        if (ready.revents & (POLLHUP | POLLERR)) return 0;
        if (ready.revents & POLLIN) take(line, data, read(line, data, sizeof data), now);
    }
}
