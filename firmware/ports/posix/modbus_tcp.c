// SPDX-License-Identifier: MIT

#define _XOPEN_SOURCE 700

#include "modbus_tcp.h"
#include "mbap.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

static int listening = -1;

static struct host {
    int connection; // 0: none
    struct mbap mbap;
} hosts[TCP_HOSTS];

int tcp_open(uint16_t port)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(port)};
    socklen_t size = sizeof address;
    int yes = 1;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    listening = socket(AF_INET, SOCK_STREAM, 0);
    if (listening < 0 || setsockopt(listening, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) < 0 ||
        bind(listening, (struct sockaddr *)&address, size) < 0 || listen(listening, 1) < 0 ||
        getsockname(listening, (struct sockaddr *)&address, &size) < 0 ||
        fcntl(listening, F_SETFL, O_NONBLOCK) < 0)
        return -1;
    return ntohs(address.sin_port);
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

static void send_frame(int connection, const uint8_t *frame, uint16_t length)
{
    if (send(connection, frame, length, MSG_NOSIGNAL) < 0)
        return; // a host that does not read loses replies; one that is gone is noticed below
}

static void take(struct modbus *modbus, struct host *host, void (*arrived)(void))
{
    for (;;) {
        uint8_t bytes[MBAP_FRAME_MAX];
        ssize_t size = recv(host->connection, bytes, sizeof bytes, 0);
        if (size < 0 && (errno == EAGAIN || errno == EINTR))
            return;
        if (size <= 0) {
            close(host->connection);
            host->connection = 0;
            return;
        }
        arrived();
        mbap_take(&host->mbap, bytes, (uint16_t)size, modbus, 1, send_frame, host->connection);
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
        hosts[i].mbap.length = 0;
        return;
    }
    if (connection > 0)
        close(connection);
}

void tcp_serve(struct modbus *modbus, void (*arrived)(void))
{
    if (listening >= 0)
        accept_host();
    for (int i = 0; i < TCP_HOSTS; i++)
        if (hosts[i].connection > 0)
            take(modbus, &hosts[i], arrived);
}
