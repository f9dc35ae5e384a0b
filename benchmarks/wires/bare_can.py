"""Bare python-can doing the exchange of an apply: see `benchmarks.wires.bare`."""

import struct
import time
from collections.abc import Sequence

import can

from drivers.codec.can_bus.frame import CanFrame, cob_id
from drivers.codec.can_bus.requests import encode_request
from drivers.guard import SafeCommandSet
from drivers.protocol.messages import Apply, Arm
from drivers.urls.can_bus import CanUrl
from sim.far_ends.can_bus.set_buffer import Action, RequestFrame, SetBuffer

CALM = 2.0  # s; the longest watchdog


def bare_can(url: str, sets: Sequence[SafeCommandSet]) -> list[float]:
    """python-can: send the frames of a set, receive until its answer."""
    parsed = CanUrl.parse(url)
    answer = cob_id("answer", parsed.node)
    numbered = [(number % 254 + 1, safe) for number, safe in enumerate(sets)]
    requests = [
        (number, _messages(encode_request(Apply(safe), node=parsed.node, sequence=number)))
        for number, safe in numbered
    ]
    arm = _messages(encode_request(Arm(CALM), node=parsed.node, sequence=255))
    times = []
    with _open(parsed) as bus:
        bus.send(can.Message(arbitration_id=0, data=[1, parsed.node], is_extended_id=False))
        _exchange(bus, arm, answer, 255)
        for number, messages in requests:
            begin = time.perf_counter()
            _exchange(bus, messages, answer, number)
            times.append(time.perf_counter() - begin)
    return times


def can_codec(safe: SafeCommandSet) -> None:
    """Encode a set into its frames and read them as an amplifier does."""
    buffer = SetBuffer(16)
    for frame in encode_request(Apply(safe), node=1, sequence=7):
        if frame.id == cob_id("order", 1):
            token, ramp, duration, what, sequence = struct.unpack("<HHHBB", frame.data)
            action, count = Action(what & 7), what >> 3
            request = RequestFrame(token, ramp, duration, action, count, sequence, fd=False)
            buffer.take_request(request)
        else:
            buffer.take(frame.data[6] >> 4, frame.data)
    assert buffer.is_complete
    buffer.command_set(request)


def _open(url: CanUrl) -> can.BusABC:
    bus = url.bus
    if bus.interface == "slcan":
        return can.Bus(
            interface="slcan",
            channel=bus.channel,
            bitrate=bus.bitrate,
            sleep_after_open=0,
            ignore_config=True,
        )
    return can.Bus(
        interface="socketcand",
        channel=bus.channel,
        host=bus.host,
        port=bus.port,
        tcp_tune=True,
        ignore_config=True,
    )


def _messages(frames: Sequence[CanFrame]) -> list[can.Message]:
    return [
        can.Message(arbitration_id=frame.id, data=frame.data, is_extended_id=False)
        for frame in frames
    ]


def _exchange(bus: can.BusABC, messages: list[can.Message], answer: int, number: int) -> None:
    for message in messages:
        bus.send(message)
    while True:
        received = bus.recv(1.0)
        assert received is not None
        if received.arbitration_id == answer and received.data[0] == number:
            return
