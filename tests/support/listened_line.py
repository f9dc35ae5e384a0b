"""A line in memory (`words_line`) with a witness on it, and what its amplifiers really play."""

import asyncio
from collections.abc import Mapping
from typing import Any

from drivers.codec.can_bus.adapter_text import SLCAN
from drivers.codec.can_bus.segments import unpack_frames
from sim.witness.capture import Direction
from sim.witness.witness import Witness
from words_line import MemoryLine

WIRES = {"can": "slcan", "serial": "serial", "rtu": "modbus-rtu", "tcp": "modbus-tcp"}
"""Kinds of wires of a witness, by those of a line in memory."""


def witness_of(
    lines: Mapping[str, tuple[str, tuple[str, ...]]],
    *,
    power: float = float("inf"),
    times_s: Mapping[str, float] | None = None,
    **limits: Any,
) -> Witness:
    """Return a witness of lines, each a kind and its amplifiers 1, 2, ...; limits: of channels."""
    limits = {"frequency_hz": [20, 1000], "level": 1.0} | limits
    return Witness(
        {
            "wires": {name: WIRES[kind] for name, (kind, _) in lines.items()},
            "amplifiers": {
                amplifier: {
                    **{"wire": name, "address": address, "power": power},
                    "channels": dict.fromkeys(range(16), limits),
                }
                for name, (_, amplifiers) in lines.items()
                for address, amplifier in enumerate(amplifiers, 1)
            },
            "times_s": times_s or {},
        }
    )


class ListenedLine(MemoryLine):
    """A line whose bytes a witness hears: at the amplifiers' end, or at the host's (at_host)."""

    def __init__(
        self,
        witness: Witness,
        name: str,
        kind: str,
        *names: str,
        channels: int = 2,
        at_host: bool = False,
    ) -> None:
        self.witness = witness
        self.name = name
        self._kind = kind
        self._at_host = at_host
        super().__init__(kind, *names, channels=channels)
        witness.opened(name, self.loop.time())

    def write(self, data: bytes) -> None:
        """Send bytes of the host."""
        if self._at_host:
            self.heard("amplifier", data)
        super().write(data)

    def _arrived(self, name: str, data: bytes) -> None:
        if not self._at_host:
            self.heard("amplifier", data)
        super()._arrived(name, data)

    def _send(self, data: bytes) -> None:
        if not self._at_host:
            self.heard("host", data)
            super()._send(data)
            return
        for delay, altered in self.outward(self._handling, data):
            self.later(delay, self._received, altered)

    def _received(self, data: bytes) -> None:
        self.heard("host", data)
        self.line.received(data)

    def heard(self, direction: Direction, data: bytes) -> None:
        """Let the witness hear bytes, frames of a bus as the text of an adapter."""
        if self._kind == "can":
            data = b"".join(map(SLCAN.encode, unpack_frames(data)))
        self.witness.record_bytes(self.name, direction, self.loop.time(), data)

    async def keep_sensing(self) -> None:
        """Let the amplifiers run, and the witness measure what they play, every 2 ms."""
        while True:
            now = self.loop.time()
            for name, far in self.far.items():
                far.tick(now)
                channels = range(far.playback.channels)
                levels = [min(far.playback.level(channel, now), 1.0) for channel in channels]
                self.witness.levels(now, name, levels)
            await asyncio.sleep(0.002)
