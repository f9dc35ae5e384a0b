"""Recorded TUIO streams: the datagrams of a sender with their times, in a text file.

    # era-haptics TUIO capture 1
    0.000000 2362756e646c6500...
    0.016667 2362756e646c6500...

Seconds from the start and the datagram in hexadecimal; further lines that start with # are
comments. Malformed datagrams are kept as received.
"""

import asyncio
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from controller.sources.datagrams import MAX_DATAGRAM
from drivers.errors import LinkError, system_message
from model.errors import InputError
from registry.files import read_regular

HEADER = "# era-haptics TUIO capture 1"
_LINE = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ((?:[0-9a-f]{2})+)", re.ASCII | re.IGNORECASE)
MAX_BYTES = 16 << 20  # 100 s of ten fingers at 100 Hz; of one finger a quarter of an hour


@dataclass(frozen=True, slots=True)
class RecordedDatagram:
    """One datagram and when it was sent [s] from the start of the capture."""

    time: float
    payload: bytes


def read_capture(path: Path | str) -> list[RecordedDatagram]:
    """Read a capture; raises InputError with file and line."""
    path = Path(path)
    lines = _lines(path)
    if lines[0] != HEADER:
        raise InputError(f"{path}, line 1: must be {HEADER!r} for a TUIO capture")
    datagrams: list[RecordedDatagram] = []
    for number, line in enumerate(lines[1:], start=2):
        if line.startswith("#") or not line.strip():
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise InputError(
                f"{path}, line {number}: must be seconds, a space and the datagram in "
                f"hexadecimal, got {line[:60]!r}"
            )
        datagram = RecordedDatagram(float(match.group(1)), bytes.fromhex(match.group(2)))
        if len(datagram.payload) > MAX_DATAGRAM:
            raise InputError(
                f"{path}, line {number}: datagram must have at most {MAX_DATAGRAM} bytes, got "
                f"{len(datagram.payload)}"
            )
        if datagrams and datagram.time < datagrams[-1].time:
            raise InputError(f"{path}, line {number}: times must not decrease")
        datagrams.append(datagram)
    if not datagrams:
        raise InputError(f"{path}: capture must contain datagrams")
    return datagrams


def _lines(path: Path) -> list[str]:
    """Read the lines of a capture; raises InputError."""
    try:
        content = read_regular(path, MAX_BYTES)
        return content.decode("utf-8-sig").replace("\r\n", "\n").removesuffix("\n").split("\n")
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check the path, which is relative to the "
            "working directory, and its permissions"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: must be a TUIO capture, got a binary file") from error


async def replay_capture(datagrams: Sequence[RecordedDatagram], host: str, port: int) -> None:
    """Send datagrams to a UDP port at their recorded pace, on the event loop's clock.

    Raises LinkError if the port is closed.
    """
    loop = asyncio.get_running_loop()
    sender = _ReplaySocket()
    try:
        transport, _ = await loop.create_datagram_endpoint(lambda: sender, remote_addr=(host, port))
    except OSError as error:
        raise _refusal(host, port, error) from error
    try:
        start = loop.time()
        for datagram in datagrams:
            await asyncio.sleep(max(0.0, start + datagram.time - loop.time()))
            if sender.refused is not None:
                raise _refusal(host, port, sender.refused) from sender.refused
            transport.sendto(datagram.payload)
    finally:
        transport.close()


def _refusal(host: str, port: int, problem: Exception) -> LinkError:
    return LinkError(
        f"cannot send to UDP {host}:{port} ({system_message(problem)}); check the address, and "
        "start the controller first"
    )


class _ReplaySocket(asyncio.DatagramProtocol):
    """The UDP end of a replay; keeps an error that the network reported."""

    def __init__(self) -> None:
        self.refused: Exception | None = None

    def error_received(self, exc: Exception) -> None:
        """Keep the error."""
        self.refused = exc
