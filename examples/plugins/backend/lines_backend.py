"""A backend for amplifiers with lines of JSON over TCP, at lines://HOST:PORT.

A backend only converts messages to the format and units of its wire; retries, tokens, order and
states belong to the `Amplifier` above it.
"""

import asyncio
import json
from contextlib import suppress
from typing import Any, NoReturn
from urllib.parse import urlsplit

from era_haptics.plugins.backends import (
    Achieved,
    AmplifierState,
    Apply,
    Arm,
    Capabilities,
    Clear,
    CommandError,
    Commit,
    Disarm,
    DriveCommand,
    Fault,
    FaultList,
    FaultRecord,
    Feature,
    GetCaps,
    GetFaults,
    GetStatus,
    Hello,
    Identity,
    LinkError,
    LinkTimeout,
    Nak,
    NakCode,
    Ping,
    Reply,
    Request,
    Stage,
    Status,
    Stop,
    WireBackend,
    now,
    require_safe,
)

HERTZ, LEVEL, DEGREES, SECONDS = 0.05, 1e-4, 0.01, 1e-3  # what one is worth on this wire
PLAIN: dict[type[Request], str] = {
    Hello: "hello",
    GetCaps: "capabilities",
    GetFaults: "faults",
    GetStatus: "status",
}


class LinesBackend(WireBackend):
    """Carries requests over a TCP connection, one line each way."""

    def __init__(self, url: str) -> None:
        super().__init__()
        try:
            place = urlsplit(url)
            host, port = place.hostname, place.port
        except ValueError:
            host = port = None
        if not host or not port or place.path or place.query or place.fragment:
            raise CommandError(f"URL must be lines://HOST:PORT, got {url!r}")
        self._url, self._host, self._port = url, host, port
        self._line: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._number = 0

    async def open(self) -> None:
        """Connect; the amplifier serves one host at a time."""
        if self._line is not None:
            return
        try:
            self._line = await asyncio.wait_for(
                asyncio.open_connection(self._host, self._port), timeout=2.0
            )
        except OSError as error:  # a timeout is one, too
            raise LinkError(
                f"no reply from {self._url} ({str(error) or 'timeout'}); check that the "
                "amplifier is switched on, and its address"
            ) from error

    async def close(self) -> None:
        """Close the connection."""
        line, self._line = self._line, None
        if line is not None:
            _, writer = line
            writer.close()
            with suppress(OSError):  # the connection was lost before
                await writer.wait_closed()

    async def exchange(self, request: Request, *, timeout: float) -> Reply:
        """Send a request and wait for the reply with its number."""
        require_safe(request)
        if self._line is None:
            raise LinkError(f"{self._url} is not open")
        reader, writer = self._line
        question = encode(request)
        if question is None:
            return Nak(NakCode.UNKNOWN_TYPE)  # this wire has no envelopes
        self._number += 1
        try:
            async with asyncio.timeout(timeout):
                writer.write(json.dumps({"id": self._number, **question}).encode() + b"\n")
                self._last_sent_at = now()
                self._counters.frames_out += 1
                await writer.drain()
                while True:
                    reply = await self._reply_to(request, reader)
                    if reply is not None:
                        return reply
        except TimeoutError:
            raise LinkTimeout(f"no answer from {self._url} within {timeout * 1e3:g} ms") from None
        except OSError as error:
            raise LinkError(f"{self._url} is lost: {error}") from error

    async def _reply_to(self, request: Request, reader: asyncio.StreamReader) -> Reply | None:
        """Read a line; return None for a damaged or late one, which is counted."""
        try:
            line = await reader.readline()
        except ValueError:  # longer than any reply
            self._counters.invalid_frames += 1
            return None
        if not line.endswith(b"\n"):
            raise ConnectionResetError("the amplifier has hung up")
        self._counters.frames_in += 1
        try:
            reply = json.loads(line, parse_constant=refuse)
            if reply["id"] == self._number:
                return read(request, reply)
            self._counters.unexpected_frames += 1
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError):
            self._counters.invalid_frames += 1
        return None


def refuse(constant: str) -> NoReturn:
    """Refuse NaN and Infinity, which are not JSON."""
    raise ValueError(constant)


def encode(request: Request) -> dict[str, Any] | None:
    """Encode a request; None for one that the wire does not have."""
    if type(request) in PLAIN:
        return {"ask": PLAIN[type(request)]}
    match request:
        case Arm(watchdog, session):
            return {"ask": "arm", "watchdog": round(watchdog / SECONDS), "session": session}
        case Ping(session):
            return {"ask": "ping", "session": session}
        case Clear(latch):
            return {"ask": "clear", "latch": latch}
        case Disarm(ramp):
            return {"ask": "disarm", "ramp": round(ramp / SECONDS)}
        case Stop(ramp):
            return {"ask": "stop", "ramp": round(ramp / SECONDS)}
        case Commit(token, session):
            return {"ask": "commit", "session": session, "token": token}
        case Stage(wanted, session) | Apply(wanted, session):
            return {
                "ask": "stage" if isinstance(request, Stage) else "apply",
                "session": session,
                "token": wanted.token,
                "ramp": round(wanted.ramp / SECONDS),
                "valid_for": round(wanted.valid_for / SECONDS),
                "commands": [
                    (
                        one.channel,
                        int(one.keep_phase),
                        round(one.frequency / HERTZ),
                        round(one.level / LEVEL),
                        (round(one.phase / DEGREES) + 18000) % 36000 - 18000,
                    )
                    for one in wanted.commands
                ],
            }
    return None


def read(request: Request, reply: dict[str, Any]) -> Reply:
    """Decode a reply; raises ValueError, TypeError or LookupError for an invalid one."""
    if "refused" in reply:
        return Nak(NakCode(reply["refused"]), reply["channel"])
    match request:
        case Hello():
            return Identity(
                reply["vendor"],
                reply["product"],
                reply["serial_number"],
                reply["firmware"],
                versions=(2,),
            )
        case GetCaps():
            (lowest, highest), (shortest, longest) = reply["frequency"], reply["watchdog"]
            return Capabilities(
                channels=reply["channels"],
                frequency_min=lowest * HERTZ,
                frequency_max=highest * HERTZ,
                frequency_step=HERTZ,
                level_max=1.0,
                level_step=LEVEL,
                phase_step=DEGREES,
                ramp_max=reply["longest_ramp"] * SECONDS,
                watchdog_min=shortest * SECONDS,
                watchdog_max=longest * SECONDS,
                envelope_knots=0,
                features=Feature.WHOLE,
                voices=reply["voices"],
            )
        case GetFaults():
            return FaultList(
                tuple(
                    FaultRecord(Fault(kind), None, age * SECONDS) for kind, age in reply["faults"]
                )
            )
        case Stage() | Apply() | Commit():
            return Achieved(
                reply["token"],
                tuple(
                    DriveCommand(
                        channel,
                        frequency * HERTZ,
                        level * LEVEL,
                        phase * DEGREES,
                        keep_phase=keep_phase == 1,
                    )
                    for channel, keep_phase, frequency, level, phase in reply["commands"]
                ),
            )
    return Status(
        state=AmplifierState(reply["state"]),
        fault=Fault(reply["fault"]),
        token=reply["token"],
        high_voltage=reply["high_voltage"],
        temperature=25.0,
        watchdog_left=reply["watchdog_left"] * SECONDS,
        levels=tuple(level * LEVEL for level in reply["levels"]),
        latch=reply["latch"],
    )
