"""Recorded TUIO streams: the datagrams of a sender with their times, in a text file.

    # era-haptics TUIO capture 1
    0.000000 2362756e646c6500...
    0.016667 2362756e646c6500...

Seconds from the start and the datagram in hexadecimal; further lines that begin with # are
comments. Datagrams are kept as they came, malformed ones too.
"""

import asyncio
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from drivers.errors import LinkError, system_message
from model.errors import InputError

HEADER = "# era-haptics TUIO capture 1"
_LINE = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ((?:[0-9a-f]{2})+)")
_LARGEST_DATAGRAM = 65_507  # what fits into one UDP datagram over IPv4


@dataclass(frozen=True, slots=True)
class Datagram:
    """One datagram and when it was sent [s] from the start of the capture."""

    time: float
    payload: bytes


def read_capture(path: Path | str) -> list[Datagram]:
    """Read a capture; raises InputError with file and line, and then nothing of it is used."""
    path = Path(path)
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file, so no TUIO capture") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the whole path, for a name "
            "counts from the folder in which this was started, and look who may read it"
        ) from error
    if not lines or lines[0] != HEADER:
        raise InputError(f"{path}, line 1: no TUIO capture; its first line must be {HEADER!r}")
    datagrams: list[Datagram] = []
    for number, line in enumerate(lines[1:], start=2):
        if line.startswith("#"):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            raise InputError(
                f"{path}, line {number}: {line[:60]!r}; expected seconds, a space and the "
                "datagram in lower-case hexadecimal"
            )
        datagram = Datagram(float(match.group(1)), bytes.fromhex(match.group(2)))
        if len(datagram.payload) > _LARGEST_DATAGRAM:
            raise InputError(
                f"{path}, line {number}: {len(datagram.payload)} bytes do not fit into a datagram"
            )
        if datagrams and datagram.time < datagrams[-1].time:
            raise InputError(f"{path}, line {number}: time runs backwards")
        datagrams.append(datagram)
    if not datagrams:
        raise InputError(f"{path}: the capture is empty")
    return datagrams


def write_capture(path: Path | str, datagrams: Iterable[Datagram]) -> None:
    """Write a capture; times are kept to a microsecond. Raises InputError on an impossible one."""
    lines = [HEADER]
    last = 0.0
    for datagram in datagrams:
        if not (math.isfinite(datagram.time) and datagram.time >= last and datagram.payload):
            raise InputError(
                f"{path}: datagram {len(lines)} at {datagram.time} s: a capture holds datagrams "
                "that are not empty, in order of time from 0 s"
            )
        last = datagram.time
        lines.append(f"{datagram.time:.6f} {datagram.payload.hex()}")
    Path(path).write_text("\n".join(lines) + "\n", encoding="ascii")


async def replay_capture(datagrams: Sequence[Datagram], host: str, port: int) -> None:
    """Send datagrams to a UDP port at their own pace, on the event loop's clock.

    Raises LinkError if nobody listens there.
    """
    loop = asyncio.get_running_loop()
    sender = _Sender()
    try:
        transport, _ = await loop.create_datagram_endpoint(lambda: sender, remote_addr=(host, port))
    except OSError as error:
        raise _nobody_at(host, port, error) from error
    try:
        start = loop.time()
        for datagram in datagrams:
            await asyncio.sleep(max(0.0, start + datagram.time - loop.time()))
            if sender.refused is not None:
                raise _nobody_at(host, port, sender.refused) from sender.refused
            transport.sendto(datagram.payload)
    finally:
        transport.close()


def _nobody_at(host: str, port: int, problem: Exception) -> LinkError:
    return LinkError(
        f"nobody listens on UDP {host}:{port} ({system_message(problem)}); look at the address, "
        "and start the controller first"
    )


class _Sender(asyncio.DatagramProtocol):
    """The UDP end of a replay; keeps the refusal that the network reported."""

    def __init__(self) -> None:
        self.refused: Exception | None = None

    def error_received(self, exc: Exception) -> None:
        """Note that a datagram did not arrive."""
        self.refused = exc
