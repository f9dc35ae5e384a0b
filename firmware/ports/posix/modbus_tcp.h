// SPDX-License-Identifier: MIT
//
// Modbus over TCP, for up to four hosts at once.

#ifndef MODBUS_TCP_H
#define MODBUS_TCP_H

#include "modbus.h"

#include <poll.h>

#define TCP_HOSTS 4
#define TCP_WATCHED (TCP_HOSTS + 1)

// Listen at a port of 127.0.0.1; 0: any. Return the port, or -1 where that fails.
int tcp_open(uint16_t port);

// Fill in what to wait for.
void tcp_watch(struct pollfd watched[TCP_WATCHED]);

// Take what has arrived, call `arrived`, and answer it.
void tcp_serve(struct modbus *modbus, void (*arrived)(void));

#endif
