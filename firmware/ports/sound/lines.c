// SPDX-License-Identifier: MIT

#define _XOPEN_SOURCE 700

#include "engine.h"

#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <pthread.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#define PRIORITY 4     // SCHED_RR, below that of sound threads
#define PIECE 250      // bytes in a record
#define WAIT 100       // ms
#define SOON 1         // ms until the requests are looked at again while their ring is full
#define WATCHED (CONNECTIONS + 2)

static struct line {
    int connection; // -1: none
    uint32_t generation;
    uint8_t received[PIECE];
    uint16_t length;
} lines[CONNECTIONS];

static struct engine *engine;
static struct lines_settings settings;

static bool pass_on(struct line *line, const uint8_t *bytes, uint16_t length)
{
    struct record *record = ring_free(&engine->requests);
    if (record == NULL)
        return false;
    record->connection = (uint8_t)(line - lines);
    record->generation = line->generation;
    record->length = length;
    memcpy(record->bytes, bytes, length);
    ring_push(&engine->requests);
    return true;
}

static void open_host(struct line *line, int connection)
{
    line->connection = connection;
    line->generation++;
    line->length = 0;
    pass_on(line, line->received, 0); // there is room: hosts are accepted only then
}

static void close_host(struct line *line)
{
    close(line->connection);
    line->connection = -1;
}

static void take(struct line *line)
{
    uint16_t room = (uint16_t)(PIECE - line->length);
    ssize_t size = 0;
    if (room > 0) {
        size = read(line->connection, line->received + line->length, room);
        if (size < 0 && (errno == EAGAIN || errno == EINTR || line->connection == settings.terminal))
            return;
        if (size <= 0) {
            if (line->connection != settings.terminal)
                close_host(line);
            return;
        }
        line->length = (uint16_t)(line->length + size);
    }
    if (pass_on(line, line->received, line->length))
        line->length = 0;
}

static void accept_host(void)
{
    int yes = 1, connection = accept(settings.listening, NULL, NULL);
    // A serial line has one host, the newest: one that vanished must not keep others out.
    unsigned places = engine->settings.protocol == SERIAL_PROTOCOL ? 1 : CONNECTIONS;
    if (connection < 0)
        return;
    fcntl(connection, F_SETFL, O_NONBLOCK);
    setsockopt(connection, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    for (unsigned i = 0; i < places; i++)
        if (lines[i].connection < 0) {
            open_host(&lines[i], connection);
            return;
        }
    if (places == 1) {
        close_host(&lines[0]);
        open_host(&lines[0], connection);
    } else {
        close(connection);
    }
}

static void send_replies(void)
{
    const struct record *reply;
    while ((reply = ring_first(&engine->replies)) != NULL) {
        struct line *line = &lines[reply->connection];
        bool is_terminal = line->connection == settings.terminal;
        ssize_t sent = 0;
        if (line->connection >= 0 && line->generation == reply->generation)
            sent = is_terminal ? write(line->connection, reply->bytes, reply->length)
                               : send(line->connection, reply->bytes, reply->length, MSG_NOSIGNAL);
        (void)sent; // what a full line does not take is lost, as on a wire that nobody reads
        ring_pop(&engine->replies);
    }
}

static void watch(struct pollfd watched[WATCHED])
{
    bool has_room = engine->requests.written - GET(engine->requests.taken) <= RING_SIZE / 2;
    for (unsigned i = 0; i < CONNECTIONS; i++)
        watched[i].fd = has_room ? lines[i].connection : -1;
    watched[CONNECTIONS].fd = has_room ? settings.listening : -1;
    watched[CONNECTIONS + 1].fd = engine->wake[0];
    for (unsigned i = 0; i < WATCHED; i++)
        watched[i].events = POLLIN;
    if (poll(watched, WATCHED, has_room ? WAIT : SOON) < 0)
        for (unsigned i = 0; i < WATCHED; i++)
            watched[i].revents = 0;
}

static void *serve_lines(void *ignored)
{
    char bytes[64];
    struct pollfd watched[WATCHED];
    for (;;) {
        watch(watched);
        while (read(engine->wake[0], bytes, sizeof bytes) > 0)
            continue;
        send_replies();
        for (unsigned i = 0; i < CONNECTIONS; i++)
            if (watched[i].revents != 0 && lines[i].connection >= 0)
                take(&lines[i]);
        if (watched[CONNECTIONS].revents != 0)
            accept_host();
    }
    return ignored;
}

int lines_start(struct engine *served, const struct lines_settings *given)
{
    pthread_t thread;
    struct sched_param priority = {.sched_priority = PRIORITY};
    engine = served;
    settings = *given;
    for (unsigned i = 0; i < CONNECTIONS; i++)
        lines[i].connection = -1;
    if (settings.terminal >= 0)
        open_host(&lines[0], settings.terminal);
    int problem = pthread_create(&thread, NULL, serve_lines, NULL);
    if (problem == 0)
        pthread_setschedparam(thread, SCHED_RR, &priority); // where that is allowed
    return problem;
}
