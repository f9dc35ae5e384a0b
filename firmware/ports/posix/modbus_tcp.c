// SPDX-License-Identifier: MIT

#define _XOPEN_SOURCE 700

#include "modbus_tcp.h"
#include "line.h"
#include "loop.h"

#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

// A frame: transaction u16, protocol u16 (0), length u16 of what follows, unit u8, PDU.
#define HEADER 7
#define FRAME_MAX (HEADER + MODBUS_PDU_MAX)
#define ANY_UNIT 255

static int listening = -1;

static struct host {
    int connection; // 0: none
    uint8_t received[FRAME_MAX];
    uint16_t length;
} hosts[TCP_HOSTS];

uint16_t tcp_open(uint16_t port)
{
    listening = listen_at(&port);
    return port;
}

void tcp_watch(struct pollfd watched[TCP_WATCHED])
{
    for (int i = 0; i < TCP_HOSTS; i++) {
        watched[i].fd = hosts[i].connection > 0 ? hosts[i].connection : -1;
        watched[i].events = POLLIN;
    }
    watched[TCP_HOSTS].fd = listening;
    watched[TCP_HOSTS].events = POLLIN;
}

static void answer(struct modbus *modbus, struct host *host, uint16_t size)
{
    uint8_t reply[FRAME_MAX];
    uint8_t unit = host->received[6] == ANY_UNIT ? modbus->unit : host->received[6];
    uint16_t length = modbus_request(modbus, unit, host->received + HEADER,
                                     (uint16_t)(size - HEADER), reply + HEADER);
    if (length == 0)
        return;
    memcpy(reply, host->received, HEADER); // transaction, protocol and unit are the request's
    reply[4] = (uint8_t)((length + 1) >> 8);
    reply[5] = (uint8_t)(length + 1);
    if (send(host->connection, reply, (size_t)(HEADER + length), MSG_NOSIGNAL) < 0)
        return; // a host that does not read loses replies; one that is gone is noticed below
}

// Answer the whole frames that have arrived. What is no frame is discarded with all that came with it.
static void take_frames(struct modbus *modbus, struct host *host)
{
    while (host->length >= HEADER) {
        uint16_t following = (uint16_t)(host->received[4] << 8 | host->received[5]);
        bool is_frame = host->received[2] == 0 && host->received[3] == 0 && following >= 2 &&
                        following <= MODBUS_PDU_MAX + 1;
        uint16_t size = (uint16_t)(6 + following);
        if (!is_frame) {
            host->length = 0;
            return;
        }
        if (host->length < size)
            return;
        answer(modbus, host, size);
        host->length = (uint16_t)(host->length - size);
        memmove(host->received, host->received + size, host->length);
    }
}

static void take(struct modbus *modbus, struct host *host)
{
    for (;;) {
        ssize_t size = recv(host->connection, host->received + host->length,
                            sizeof host->received - host->length, 0);
        if (size < 0 && (errno == EAGAIN || errno == EINTR))
            return;
        if (size <= 0) {
            close(host->connection);
            host->connection = 0;
            return;
        }
        host->length = (uint16_t)(host->length + size);
        loop_samples();
        take_frames(modbus, host);
    }
}

static void accept_host(void)
{
    int yes = 1, connection = accept(listening, NULL, NULL);
    for (int i = 0; i < TCP_HOSTS && connection > 0; i++) {
        if (hosts[i].connection > 0)
            continue;
        fcntl(connection, F_SETFL, O_NONBLOCK);
        // A reply must not wait for the acknowledgement of the one before.
        setsockopt(connection, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
        hosts[i].connection = connection;
        hosts[i].length = 0;
        return;
    }
    if (connection > 0)
        close(connection);
}

void tcp_serve(struct modbus *modbus)
{
    if (listening >= 0)
        accept_host();
    for (int i = 0; i < TCP_HOSTS; i++)
        if (hosts[i].connection > 0)
            take(modbus, &hosts[i]);
}
