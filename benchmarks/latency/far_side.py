"""Amplifiers of a rig on pseudo-terminals, and a clock for what reaches them."""

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from drivers.codec.serial_line.frame import Frame, FrameReader, frame_length, unpack_words
from drivers.protocol.sets import Assembly, unpack_layers
from drivers.protocol.table import MAX_WORDS, MESSAGES, read_request
from model.rig.rig import Rig
from sim.amplifier.contract import Amplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers
from sim.transport.pseudo_terminal import make_terminal

BAUD = 921_600
BITS = 10  # of a byte on the line: start, eight, stop
QUIET = 0.03  # s; without a set, after which none is under way
_SET, _COMMIT, _STOP = (MESSAGES[name].number for name in ("Set", "Commit", "Stop"))


@dataclass(frozen=True)
class Vibration:
    """A set that drives layers, on one amplifier, from a time [s]: the arrival of its last byte."""

    token: int
    at: float
    layers: frozenset[int]


class _Terminal:
    """One amplifier.

    bytes: on its line until now, of sets and commits with their replies; used [s]: its own time for
    them.
    """

    def __init__(self, name: str, channels: int, changed: Callable[[], None]) -> None:
        self.vibrations: list[Vibration] = []
        self.stopped_at = self.changed_at = 0.0  # s; when the last stop, and set, arrived
        self.bytes, self.used = 0, 0.0
        self._changed = changed
        self._reader, self._assembly = FrameReader(), Assembly()
        self._staged: dict[int, frozenset[int]] = {}
        self._end = SerialAmplifiers({1: Amplifier(name, channels=channels)}, self._reply)
        self._terminal = make_terminal(self._arrived)
        self._terminal.listen()
        self.url = f"serial://{self._terminal.port}?baud={BAUD}"

    def _arrived(self, data: bytes) -> None:
        now = time.monotonic()
        frames = self._reader.feed(data)
        for frame in frames:
            if frame.kind in (_SET, _COMMIT):
                self.changed_at = now
                self.bytes += frame_length(len(frame.payload))
                self._note(frame, now)
            elif frame.kind == _STOP:
                self.stopped_at = now
        if frames:
            self._changed()
        self._end.receive(data, now)
        self.used += time.monotonic() - now

    def _reply(self, data: bytes) -> None:
        if time.monotonic() - self.changed_at < QUIET:
            self.bytes += len(data)
        self._terminal.write(data)

    def _note(self, frame: Frame, now: float) -> None:
        """Note the layers that a set drives, once it plays."""
        _, values = read_request(frame.kind, unpack_words(frame.payload))
        token = values["token"]
        if frame.kind == _SET:
            stream = self._assembly.add(values, now, MAX_WORDS * values["parts"])
            if stream is None:
                return
            driven = (
                each.layer
                for each in unpack_layers(stream)
                if any(command.is_driven for command in each.commands)
            )
            self._staged[token] = frozenset(driven)
            if not values["now"]:
                return
        layers = self._staged.pop(token, None)
        if layers:
            self.vibrations.append(Vibration(token, now, layers))

    def close(self) -> None:
        self._terminal.close()


class FarSide:
    """All amplifiers of a rig; urls by name."""

    def __init__(self, rig: Rig) -> None:
        self._changed = asyncio.Event()
        self._terminals: Sequence[_Terminal] = [
            _Terminal(
                name,
                1 + max(each.number for each in rig.wiring.values() if each.amplifier == name),
                self._changed.set,
            )
            for name in rig.amplifiers
        ]
        terminals = zip(rig.amplifiers, self._terminals, strict=True)
        self.urls: Mapping[str, str] = {name: each.url for name, each in terminals}

    def close(self) -> None:
        """Close the terminals."""
        for each in self._terminals:
            each.close()

    def begin(self) -> None:
        """Forget what has arrived."""
        for each in self._terminals:
            each.vibrations.clear()
            each.stopped_at, each.bytes, each.used = 0.0, 0, 0.0

    def playing_since(self, count: int) -> float | None:
        """Return when [s] the last amplifier had got sets of so many layers; None until then."""
        found = []
        for each in self._terminals:
            layers: frozenset[int] = frozenset()
            for vibration in each.vibrations:
                layers |= vibration.layers
                if len(layers) >= count:
                    found.append(vibration.at)
                    break
        return max(found) if len(found) == len(self._terminals) else None

    def stopped_at(self) -> float | None:
        """Return when [s] the last amplifier got a stop; None until then."""
        times = [each.stopped_at for each in self._terminals]
        return max(times) if all(times) else None

    def sets(self) -> int:
        """Return how many sets with vibrations have arrived, each on some amplifier."""
        return len({one.token for each in self._terminals for one in each.vibrations})

    def wire_time(self) -> float:
        """Return how long [s] the busiest line would take for its bytes of sets and replies."""
        return max(each.bytes for each in self._terminals) * BITS / BAUD

    def used(self) -> float:
        """Return how long [s] this program took for what has arrived, in place of amplifiers."""
        return sum(each.used for each in self._terminals)

    async def until(self, arrived: Callable[[], float | None], timeout: float) -> float | None:
        """Wait until something has arrived; None after a timeout [s]."""
        end = time.monotonic() + timeout
        while (found := arrived()) is None:
            self._changed.clear()
            try:
                async with asyncio.timeout(end - time.monotonic()):
                    await self._changed.wait()
            except TimeoutError:
                return None
        return found

    async def quiet(self) -> None:
        """Wait until no set is under way."""
        last = max(each.changed_at for each in self._terminals)
        if (left := last + QUIET - time.monotonic()) > 0:
            await asyncio.sleep(left)
            await self.quiet()
