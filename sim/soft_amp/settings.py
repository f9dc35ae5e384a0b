"""Settings of a software amplifier, and the line on which hosts reach it."""

import math
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from pathlib import Path

from model.errors import InputError

MAX_CHANNELS = 32
"""Channels of two amplifiers; the protocol allows 16 per amplifier."""

CHANNELS_OF_AMPLIFIER = 16


class Law(StrEnum):
    """Function from the wanted force to the sample, in the order of `enum law`."""

    LINEAR = "linear"
    SQUARE = "square"


class Protocol(IntEnum):
    """Protocol of the line, numbered as in `enum protocol`."""

    SERIAL = 0
    MODBUS = 1


@dataclass(frozen=True)
class SoftAmplifierSettings:
    """A software amplifier.

    device: name or number of a device of PortAudio; rate [Hz] and block [frames]: None for the
    defaults of the device; limit: largest sample, 0..1; max_gaps: gaps in the sound per second
    above which a fault is latched. Raises InputError.
    """

    device: str
    channels: int
    protocol: Protocol
    serial_number: str
    rate: int | None = None
    block: int | None = None
    law: Law = Law.LINEAR
    limit: float = 1.0
    max_gaps: int = 3

    def __post_init__(self) -> None:
        if not 2 <= self.channels <= MAX_CHANNELS:
            raise InputError(f"--channels must be 2 to {MAX_CHANNELS}, got {self.channels}")
        if self.channels > CHANNELS_OF_AMPLIFIER and self.channels % 2:
            raise InputError(
                f"--channels above {CHANNELS_OF_AMPLIFIER} must be even, since they are two "
                f"amplifiers of half as many, got {self.channels}"
            )
        min_limit = math.sqrt(0.5) if self.law == Law.SQUARE else 0.0
        if not min_limit < self.limit <= 1:
            raise InputError(
                f"--limit must be above {min_limit:.3g} and at most 1 with this law, got "
                f"{self.limit:g}"
            )
        if self.rate is not None:
            check_rate(self.rate, what="--rate")

    @property
    def amplifiers(self) -> int:
        """Number of amplifiers, at addresses 1 and 2."""
        return 1 if self.channels <= CHANNELS_OF_AMPLIFIER else 2


def check_rate(rate: float, *, what: str) -> int:
    """Return a sample rate [Hz] that suits the engine; raises InputError."""
    if rate % 1000 or not 8000 <= rate <= 192_000:
        raise InputError(
            f"{what}: sample rate must be a multiple of 1000 Hz from 8000 to 192000, got {rate:g} "
            "Hz; use 48000 Hz"
        )
    return int(rate)


_LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class SoftAmplifierLine:
    """A line; terminal, listening: its descriptors, -1 for none. url: of the first amplifier."""

    url: str
    terminal: int = -1
    listening: int = -1

    def urls(self, amplifiers: int, *, protocol: Protocol) -> list[str]:
        """The URL of each amplifier."""
        if protocol is Protocol.MODBUS:
            return [f"{self.url}/{unit}" for unit in range(1, amplifiers + 1)]
        urls = [self.url]
        for address in range(2, amplifiers + 1):
            urls.append(f"{self.url}?address={address}")
        return urls


@contextmanager
def terminal_place(link: Path | None) -> Iterator[SoftAmplifierLine]:
    """A pseudo-terminal, and a symbolic link to it in this context; raises InputError."""
    import tty  # not on Windows

    from sim.transport.terminal_links import linked  # loads asyncio, which the help does without

    with ExitStack() as stack:
        near, far = os.openpty()
        stack.callback(os.close, near)
        # Kept open, so that a host that closes it does not hang up the line.
        stack.callback(os.close, far)
        tty.setraw(far)
        os.set_blocking(near, False)
        path = os.ttyname(far)
        if link is not None:
            path = stack.enter_context(linked(link, to=path))
        yield SoftAmplifierLine(f"serial://{path}", terminal=near)


@contextmanager
def tcp_place(port: int, *, protocol: Protocol) -> Iterator[SoftAmplifierLine]:
    """A port of this machine alone, 0 for any; raises InputError."""
    try:
        listening = socket.create_server((_LOOPBACK, port), backlog=4)
    except OSError as problem:
        raise InputError(
            f"port {port}: cannot listen: {problem.strerror}; choose another"
        ) from None
    with listening:
        listening.setblocking(False)
        scheme = "serial+tcp" if protocol is Protocol.SERIAL else "modbus+tcp"
        url = f"{scheme}://{_LOOPBACK}:{listening.getsockname()[1]}"
        yield SoftAmplifierLine(url, listening=listening.fileno())
