"""The bare library of each wire doing the exchange of an apply, nothing around it.

Each takes the URL of a simulated amplifier that is armed and requests that are encoded already, and
gives the time of each exchange [s].
"""

import time
from collections.abc import Sequence

import serial

from drivers.backends.serial_url import SerialUrl
from drivers.guard import SafeCommand
from drivers.protocol.messages import Apply, Arm
from drivers.protocol.serial_codec import encode_request
from drivers.protocol.serial_frame import encode_frame


def bare_serial(url: str, sets: Sequence[SafeCommand]) -> list[float]:
    """pyserial: write the frame, read until the zero that ends the reply."""
    parsed = SerialUrl.parse(url)
    requests = [
        encode_frame(encode_request(Apply(safe), address=1, sequence=number & 0xFFFF))
        for number, safe in enumerate(sets)
    ]
    arm = encode_frame(encode_request(Arm(2.0), address=1, sequence=0))
    times = []
    with serial.Serial(parsed.port, parsed.baud, timeout=1, exclusive=True) as port:
        _exchange(port, arm)
        while port.in_waiting:  # the event of having been armed
            port.read(port.in_waiting)
        for request in requests:
            begin = time.perf_counter()
            _exchange(port, request)
            times.append(time.perf_counter() - begin)
    return times


def _exchange(port: serial.Serial, request: bytes) -> None:
    port.write(request)
    ends = 0
    while ends < 2:  # one zero in front, one behind
        ends += port.read(max(1, port.in_waiting)).count(0)
