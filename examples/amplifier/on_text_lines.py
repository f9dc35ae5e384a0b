"""The amplifier of `amplifier.py` behind a protocol of its own: lines of JSON over TCP.

    python on_text_lines.py 7010

It serves one host at a time, on 127.0.0.1. A request is a line as {"id": 7, "ask": "arm",
"watchdog": 250, "session": 9}, its answer one as {"id": 7, "state": 4, ...} or {"id": 7,
"refused": 5}. Sessions and the watchdog are those of the wire protocol's page.
"""

import contextlib
import json
import socket
import sys

import amplifier as parts
from amplifier import Amplifier, Refused

HELLO = {"vendor": "Example", "product": "Lines", "serial_number": "LN-1", "firmware": "0.1"}
CAPABILITIES = {
    "channels": parts.CHANNELS,
    "frequency": parts.FREQUENCY,
    "longest_ramp": parts.MAX_RAMP,
    "voices": parts.VOICES,
    "watchdog": parts.WATCHDOG_RANGE,
}


def answer(amplifier, line):
    """Reply to a line; None for one that is not a request."""
    try:
        request = json.loads(line)
        number, ask = request.pop("id"), request.pop("ask")
    except (ValueError, KeyError, AttributeError, RecursionError):
        return None
    amplifier.update()
    try:
        reply = carry_out(amplifier, ask, request)
    except Refused as refused:
        reply = {"refused": refused.code, "channel": refused.channel}
    except (TypeError, ValueError):  # missing, too many, or not numbers
        reply = {"refused": parts.BAD_VALUE, "channel": None}
    return json.dumps({"id": number, **reply})


def carry_out(amplifier, ask, values):
    """Carry out a request and return the reply; raises Refused."""
    if ask == "hello":
        return HELLO
    if ask == "capabilities":
        return CAPABILITIES
    if ask == "faults":
        return {"faults": amplifier.faults}
    if ask in ("arm", "disarm", "stop", "clear", "stage", "commit", "apply", "ping"):
        done = getattr(amplifier, ask)(**values)
    elif ask == "status":
        done = None
    else:
        raise Refused(1)
    if done is not None:
        return {"token": done[0], "commands": done[1]}
    amplifier.update()
    return {
        "state": amplifier.state,
        "fault": amplifier.fault,
        "token": amplifier.token,
        "latch": amplifier.latch,
        "high_voltage": amplifier.high_voltage,
        "watchdog_left": amplifier.watchdog_left,
        "levels": amplifier.levels,
    }


def serve(amplifier, connection):
    """Serve one host until it disconnects, and update the amplifier meanwhile."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # send replies at once
    connection.settimeout(0.005)
    waiting = b""
    while True:
        try:
            data = connection.recv(4096)
        except TimeoutError:
            amplifier.update()
            continue
        if not data:
            return
        *lines, waiting = (waiting + data).split(b"\n")
        waiting = waiting[:4096]  # of an unfinished line
        for line in lines:
            reply = answer(amplifier, line)
            if reply is not None:
                connection.sendall(reply.encode() + b"\n")


def main():
    """Serve one host after the other."""
    amplifier = Amplifier()
    with socket.create_server(("127.0.0.1", int(sys.argv[1]))) as server:
        host, port = server.getsockname()
        print(f"lines://{host}:{port}", flush=True)
        server.settimeout(0.005)
        while True:
            try:
                connection, _ = server.accept()
            except TimeoutError:
                amplifier.update()
                continue
            with connection:
                try:
                    serve(amplifier, connection)
                except ConnectionError:
                    continue  # the host is gone; the watchdog knows what to do


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):  # Ctrl-C
        main()
