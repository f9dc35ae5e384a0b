// SPDX-License-Identifier: MIT
//
// The board of the program: lines are pseudo-terminals, samples go to a file or pipe. Options; without
// any it is --serial:
//
//     --serial              serve the serial protocol on a pseudo-terminal; prints its URL
//     --modbus-rtu          serve Modbus RTU on a pseudo-terminal; prints its URL
//     --modbus-tcp PORT     serve Modbus TCP on 127.0.0.1, 0 being any port; prints its URL
//     --slcan               serve CAN as text on a pseudo-terminal; prints its URL
//     --samples FILE        write the samples: 16-bit integers, the channels one after another
//     --addresses FILE      keep the addresses that hosts set
//     --serial-number TEXT  of the amplifier
//     --until-eof           end with standard input
//
// The signal USR1 opens its interlock, and closes it again.

#define _XOPEN_SOURCE 700

#include "board.h"
#include "modbus_tcp.h"
#include "posix.h"

#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define LINES 3

static int lines[LINES] = {-1, -1, -1};
static uint8_t received[LINES][512];
static ssize_t received_length[LINES], received_at[LINES];
static uint64_t heard_at[LINES];
static const char *serial_number = "FW-1";
static const char *addresses_path; // of the file that stands for memory without supply
static uint8_t addresses[LINES] = {1, 1, 1};
static bool ends_with_input;
static volatile sig_atomic_t is_interlock_open;
static FILE *samples_file;
static uint64_t started_at; // us
static uint64_t samples_counted;

static void fail(const char *what)
{
    perror(what);
    exit(1);
}

static uint64_t microseconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000 + (uint64_t)now.tv_nsec / 1000;
}

uint64_t board_microseconds(void)
{
    return microseconds() - started_at;
}

uint32_t board_samples_due(int32_t *ahead)
{
    uint64_t passed = board_microseconds() * SAMPLE_RATE; // in millionths of a sample
    uint64_t due = passed / 1000000 - samples_counted;
    *ahead = (int32_t)((1000000 - passed % 1000000) * 65536 / 1000000);
    samples_counted += due;
    return due > UINT32_MAX ? UINT32_MAX : (uint32_t)due;
}

void board_output(const int16_t samples[CHANNELS])
{
    if (samples_file != NULL)
        fwrite(samples, sizeof samples[0], CHANNELS, samples_file);
}

void board_wait(void)
{
    struct pollfd watched[LINES + 1 + TCP_WATCHED];
    for (int i = 0; i < LINES; i++) {
        watched[i].fd = lines[i];
        watched[i].events = POLLIN;
    }
    watched[LINES].fd = ends_with_input ? STDIN_FILENO : -1;
    watched[LINES].events = POLLIN;
    tcp_watch(&watched[LINES + 1]);
    char ignored[64];
    if (samples_file != NULL)
        fflush(samples_file);
    if (poll(watched, LINES + 1 + TCP_WATCHED, 1) > 0 && watched[LINES].revents != 0 &&
        read(STDIN_FILENO, ignored, sizeof ignored) <= 0)
        exit(0);
}

int board_read(enum line line)
{
    if (received_at[line] == received_length[line]) {
        received_at[line] = 0;
        received_length[line] = 0;
        if (lines[line] >= 0)
            received_length[line] = read(lines[line], received[line], sizeof received[line]);
        if (received_length[line] <= 0) {
            received_length[line] = 0;
            return -1;
        }
        heard_at[line] = microseconds();
    }
    return received[line][received_at[line]++];
}

void board_write(enum line line, const uint8_t *bytes, uint16_t length)
{
    // What a full line does not take is lost, as on a wire that nobody reads.
    if (write(lines[line], bytes, length) < 0)
        return;
}

uint32_t board_silence(enum line line)
{
    return (uint32_t)(microseconds() - heard_at[line]);
}

bool board_interlock_open(void)
{
    return is_interlock_open;
}

static void move_interlock(int number)
{
    (void)number;
    is_interlock_open = !is_interlock_open;
}

const char *board_serial_number(void)
{
    return serial_number;
}

uint8_t board_address(enum line line)
{
    return addresses[line];
}

void board_store_address(enum line line, uint8_t address)
{
    addresses[line] = address;
    if (addresses_path == NULL)
        return;
    FILE *file = fopen(addresses_path, "wb");
    if (file == NULL || fwrite(addresses, sizeof addresses, 1, file) != 1 || fclose(file) != 0)
        perror(addresses_path);
}

static void load_addresses(const char *path)
{
    uint8_t kept[LINES];
    FILE *file = fopen(path, "rb");
    addresses_path = path;
    if (file == NULL)
        return; // none was set yet
    if (fread(kept, sizeof kept, 1, file) == 1)
        memcpy(addresses, kept, sizeof kept);
    fclose(file);
}

static void usage(const char *program)
{
    fprintf(stderr,
            "usage: %s [--addresses FILE] [--serial] [--modbus-rtu] [--modbus-tcp PORT] [--slcan]\n"
            "       [--samples FILE] [--serial-number TEXT] [--until-eof]\n",
            program);
    exit(2);
}

// A descriptor to read and write without blocking; `path` gets the name that a host opens.
static int open_terminal(const char **path)
{
    int near = posix_openpt(O_RDWR | O_NOCTTY);
    if (near < 0 || grantpt(near) < 0 || unlockpt(near) < 0)
        fail("pseudo-terminal");
    *path = strdup(ptsname(near));
    // The far side stays open, so that a host that closes it does not hang up the line.
    int far = open(*path, O_RDWR | O_NOCTTY);
    struct termios raw;
    if (far < 0 || tcgetattr(far, &raw) < 0)
        fail(*path);
    raw.c_iflag = 0;
    raw.c_oflag = 0;
    raw.c_lflag = 0;
    raw.c_cflag = CS8 | CREAD | CLOCAL;
    raw.c_cc[VMIN] = 1;
    raw.c_cc[VTIME] = 0;
    if (tcsetattr(far, TCSANOW, &raw) < 0 || fcntl(near, F_SETFL, O_NONBLOCK) < 0)
        fail(*path);
    return near;
}

// separator: what precedes the address in a URL.
static void open_line(enum line line, const char *scheme, const char *separator)
{
    const char *path;
    lines[line] = open_terminal(&path);
    printf("%s%s", scheme, path);
    if (addresses[line] != 1 || line == LINE_CAN)
        printf("%s%u", separator, addresses[line]);
    printf("\n");
}

void board_open(int count, char **arguments)
{
    for (int i = 1; i < count; i++) {
        const char *option = arguments[i], *value = i + 1 < count ? arguments[i + 1] : NULL;
        if (strcmp(option, "--serial") == 0) {
            open_line(LINE_SERIAL, "serial://", "?address=");
        } else if (strcmp(option, "--modbus-rtu") == 0) {
            open_line(LINE_MODBUS, "modbus+rtu://", "#");
        } else if (strcmp(option, "--modbus-tcp") == 0 && value != NULL) {
            int port = tcp_open((uint16_t)atoi(arguments[++i]));
            if (port < 0)
                fail("listen");
            printf("modbus+tcp://127.0.0.1:%d/%u\n", port, addresses[LINE_MODBUS]);
        } else if (strcmp(option, "--slcan") == 0) {
            open_line(LINE_CAN, "can+slcan://", "#");
        } else if (strcmp(option, "--until-eof") == 0) {
            ends_with_input = true;
        } else if (strcmp(option, "--samples") == 0 && value != NULL) {
            samples_file = fopen(arguments[++i], "wb");
            if (samples_file == NULL)
                fail(value);
        } else if (strcmp(option, "--addresses") == 0 && value != NULL) {
            load_addresses(arguments[++i]);
        } else if (strcmp(option, "--serial-number") == 0 && value != NULL && strlen(value) <= 32) {
            serial_number = arguments[++i];
        } else {
            usage(arguments[0]);
        }
    }
    if (count == 1)
        open_line(LINE_SERIAL, "serial://", "?address=");
    fflush(stdout);
    struct sigaction moves = {.sa_handler = move_interlock, .sa_flags = SA_RESTART};
    sigaction(SIGUSR1, &moves, NULL);
    started_at = microseconds();
}
