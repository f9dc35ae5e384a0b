// SPDX-License-Identifier: MIT
//
// Work whose cost cost.py measures: Pings, sets and samples in silence, with 4 layers, and with all
// voices of all channels on their ramps. Between two pieces of work the program writes the name of
// the last one to UART 0; at the end, the stack used and a checksum of the samples.

#include "cortex_m.h"
#include "crc.h"
#include "messages.h"
#include "mps2.h"
#include "serial.h"

#include <string.h>

#define SESSION 7
#define HEADER 5
#define PART_WORDS (WORDS_MAX - SET_STREAM)

static struct amplifier amplifier;
static struct serial serial;
static uint16_t token;
static uint32_t checksum;

// Called before and after a piece of work; cost.py recognizes their addresses.
__attribute__((noinline)) void work_begins(void)
{
    __asm volatile("" ::: "memory");
}

__attribute__((noinline)) void work_ends(void)
{
    __asm volatile("nop" ::: "memory");
}

__attribute__((noinline)) void finish(void)
{
    for (;;) {
    }
}

void board_shut_down(void) {}
void tick(void) {}

static void print(const char *text)
{
    for (; *text != 0; text++) {
        while (UART(0)->state & UART_SEND_FULL) {
        }
        UART(0)->data = (uint32_t)*text;
    }
}

static void print_number(const char *name, uint32_t number)
{
    char digits[12], *digit = digits + sizeof digits;
    *--digit = 0;
    do {
        *--digit = (char)('0' + number % 10);
        number /= 10;
    } while (number > 0);
    print(name);
    print("=");
    print(digit);
    print("\n");
}

static void work_done(const char *name)
{
    work_ends();
    print(name);
    print("\n");
}

// Send a request in a frame to the serial line, byte by byte.
static void send(const char *name, uint8_t type, const uint16_t *words, uint16_t count)
{
    static uint8_t frame[SERIAL_FRAME_MAX], line[SERIAL_STUFFED_MAX]; // not on the measured stack
    uint16_t length = HEADER, code_at = 0, out = 1;
    frame[0] = type;
    frame[1] = PROTOCOL_VERSION;
    frame[2] = 1; // address
    for (uint16_t i = 0; i < count; i++) {
        frame[length++] = (uint8_t)words[i];
        frame[length++] = (uint8_t)(words[i] >> 8);
    }
    uint32_t crc = crc32_of(frame, length);
    for (int i = 0; i < 4; i++)
        frame[length++] = (uint8_t)(crc >> 8 * i);
    for (uint16_t i = 0; i < length; i++) {
        if (frame[i] == 0) {
            line[code_at] = (uint8_t)(out - code_at);
            code_at = out++;
        } else {
            line[out++] = frame[i];
        }
    }
    line[code_at] = (uint8_t)(out - code_at);
    line[out++] = 0;
    for (uint16_t i = 0; i + 1 < out; i++)
        serial_byte(&serial, line[i]);
    work_begins();
    serial_byte(&serial, 0);
    work_done(name);
}

static void make_samples(const char *name, unsigned count)
{
    int16_t samples[CHANNELS_MAX];
    for (unsigned i = 0; i < count; i++) {
        work_begins();
        amplifier_sample(&amplifier, samples);
        work_done(name);
        for (unsigned channel = 0; channel < CHANNELS; channel++)
            checksum = (checksum << 5 | checksum >> 27) ^
                       (uint32_t)(uint16_t)samples[channel] * UINT32_C(2654435761);
    }
}

// Send a set of some layers on all channels, each tone on its ramp [ms]; is_now: it starts.
static void play(const char *name, unsigned layers, uint16_t ramp, unsigned frequency, bool is_now)
{
    static uint16_t stream[STREAM_WORDS], words[WORDS_MAX];
    uint16_t count = 0;
    for (unsigned layer = 0; layer < layers; layer++) {
        stream[count++] = (uint16_t)(layer << LAYER_LAYER_SHIFT | CHANNELS);
        stream[count++] = ramp;
        stream[count++] = 0; // valid_for
        for (unsigned channel = 0; channel < CHANNELS; channel++) {
            stream[count++] = (uint16_t)(channel << COMMAND_CHANNEL_SHIFT);
            stream[count++] = (uint16_t)(frequency + 200 * layer + 20 * channel);
            stream[count++] = 8000; // level
            stream[count++] = (uint16_t)(1000 * layer + 7 * channel);
        }
    }
    token++;
    unsigned parts = (unsigned)(count + PART_WORDS - 1) / PART_WORDS;
    for (unsigned part = 0; part < parts; part++) {
        unsigned first = part * PART_WORDS;
        unsigned length = count - first < PART_WORDS ? count - first : PART_WORDS;
        words[SET_SESSION] = SESSION;
        words[SET_TOKEN] = token;
        words[SET_BITS] = (uint16_t)(part << SET_INDEX_SHIFT | parts << SET_PARTS_SHIFT | is_now);
        memcpy(words + SET_STREAM, stream + first, length * sizeof stream[0]);
        send(name, MESSAGE_SET, words, (uint16_t)(SET_STREAM + length));
    }
}

static void ping(const char *name)
{
    const uint16_t words[] = {SESSION, 0};
    send(name, MESSAGE_PING, words, 2);
}

static void silence(void)
{
    const uint16_t words[] = {SESSION, 0};
    send("Silence", MESSAGE_SILENCE, words, 2);
}

int main(void)
{
    const uint16_t arm[] = {SESSION, 2000, 0};
    UART(0)->divider = 16;
    UART(0)->control = UART_ENABLE;
    amplifier_init(&amplifier, "COST", NULL);
    serial_init(&serial, &amplifier, 1);
    ping("Ping in silence");
    send("Arm", MESSAGE_ARM, arm, 3);
    ping("Ping in silence");
    make_samples("sample in silence", 2);
    play("Set", 4, 20, 2000, true);
    make_samples("sample of 4 layers", 2);
    ping("Ping with 4 layers");
    silence();
    // Full pools: every voice on its ramp, and as many fades as a set can cut.
    for (unsigned layers = LAYERS; layers <= VOICES; layers += LAYERS) {
        play("Set", LAYERS, 20, 4000 + 4 * layers, true);
        make_samples("filling", 1);
    }
    play("Set on full pools", LAYERS, 20, 6000, true);
    make_samples("sample of full pools", 2);
    ping("Ping with full pools");
    play("Set", LAYERS, 20, 7000, false);
    uint16_t at = (uint16_t)((amplifier_clock(&amplifier) >> 16) + 2);
    const uint16_t commit[] = {SESSION, token, at};
    send("Commit", MESSAGE_COMMIT, commit, 3);
    make_samples("start of a set at a moment", SAMPLES_PER_MS);
    silence();
    print_number("stack", stack_used());
    print_number("checksum", checksum);
    finish();
}
