"""Amplifiers of a rig behind serial servers, and a clock for what reaches them."""

import asyncio
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from drivers.protocol.definition import MESSAGES, read_request
from drivers.protocol.sets import Assembly, is_last, unpack_layers
from drivers.wires.serial_frames import Frame, FrameReader, frame_length, unpack_words
from model.rig.rig import Rig
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.far_ends.serial_amplifiers import SerialAmplifiers

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


class _Server:
    """A serial server of this machine for one host.

    Not a pseudo-terminal: its bytes are carried by a thread of the kernel, of ordinary priority,
    which on a busy machine has no processor for as long as a watchdog lasts, whatever the
    priorities of the daemon and of this program.

    on_data: called with bytes from the host, once `listen` was called.
    """

    def __init__(self, on_data: Callable[[bytes], None]) -> None:
        self._on_data = on_data
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._connected: socket.socket | None = None
        self.url = f"serial+tcp://127.0.0.1:{self._listening.getsockname()[1]}"

    def listen(self) -> None:
        """Accept a host from now on, in the running event loop."""
        self._listening.setblocking(False)
        asyncio.get_running_loop().add_reader(self._listening, self._accept)

    def _accept(self) -> None:
        self._hang_up()
        self._connected, _ = self._listening.accept()
        self._connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connected.setblocking(False)
        asyncio.get_running_loop().add_reader(self._connected, self._read)

    def _read(self) -> None:
        assert self._connected is not None
        with suppress(BlockingIOError):
            data = b""
            with suppress(ConnectionError):
                data = self._connected.recv(4096)
            if data:
                self._on_data(data)
            else:
                self._hang_up()

    def _hang_up(self) -> None:
        if self._connected is not None:
            asyncio.get_running_loop().remove_reader(self._connected)
            self._connected.close()
            self._connected = None

    def write(self, data: bytes) -> None:
        """Write to the host; lost without one, or if it does not read."""
        if self._connected is not None:
            with suppress(BlockingIOError, ConnectionError):
                self._connected.send(data)

    def close(self) -> None:
        """Close both sockets."""
        self._hang_up()
        asyncio.get_running_loop().remove_reader(self._listening)
        self._listening.close()


class _Device:
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
        self._end = SerialAmplifiers({1: SimulatedAmplifier(name, channels=channels)}, self._reply)
        self._line = _Server(self._arrived)
        self._line.listen()
        self.url = self._line.url

    def _arrived(self, data: bytes) -> None:
        now = time.monotonic()
        frames = self._reader.feed(data)
        for frame in frames:
            if frame.kind in (_SET, _COMMIT):
                self.changed_at = now
                self.bytes += frame_length(len(frame.payload))
            elif frame.kind == _STOP:
                self.stopped_at = now
        self._end.receive(data, now)
        for frame in frames:  # after the reply: this is not the amplifier's
            if frame.kind in (_SET, _COMMIT):
                self._note(frame, now)
        if frames:
            self._changed()
        self.used += time.monotonic() - now

    def _reply(self, data: bytes) -> None:
        if time.monotonic() - self.changed_at < QUIET:
            self.bytes += len(data)
        self._line.write(data)

    def _note(self, frame: Frame, now: float) -> None:
        """Note the layers that a set drives, once it plays."""
        _, values = read_request(frame.kind, unpack_words(frame.payload))
        token = values["token"]
        if frame.kind == _SET:
            if not is_last(values):
                self._assembly.keep(values, now)
                return
            stream = self._assembly.whole(values)
            if isinstance(stream, int):
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
        self._line.close()


class FarSide:
    """All amplifiers of a rig; urls by name."""

    def __init__(self, rig: Rig) -> None:
        self._changed = asyncio.Event()
        self._devices: Sequence[_Device] = [
            _Device(
                name,
                1 + max(each.number for each in rig.wiring.values() if each.amplifier == name),
                self._changed.set,
            )
            for name in rig.amplifiers
        ]
        devices = zip(rig.amplifiers, self._devices, strict=True)
        self.urls: Mapping[str, str] = {name: each.url for name, each in devices}

    def close(self) -> None:
        """Close their lines."""
        for each in self._devices:
            each.close()

    def begin(self) -> None:
        """Forget what has arrived."""
        for each in self._devices:
            each.vibrations.clear()
            each.stopped_at, each.bytes, each.used = 0.0, 0, 0.0

    def playing_since(self, count: int) -> float | None:
        """Return when [s] the last amplifier had got sets of so many layers; None until then."""
        found = []
        for each in self._devices:
            layers: frozenset[int] = frozenset()
            for vibration in each.vibrations:
                layers |= vibration.layers
                if len(layers) >= count:
                    found.append(vibration.at)
                    break
        return max(found) if len(found) == len(self._devices) else None

    def stopped_at(self) -> float | None:
        """Return when [s] the last amplifier got a stop; None until then."""
        times = [each.stopped_at for each in self._devices]
        return max(times) if all(times) else None

    def sets(self) -> int:
        """Return how many sets with vibrations have arrived, each on some amplifier."""
        return len({one.token for each in self._devices for one in each.vibrations})

    def wire_time(self) -> float:
        """Return how long [s] the busiest line would take for its bytes of sets and replies."""
        return max(each.bytes for each in self._devices) * BITS / BAUD

    def used(self) -> float:
        """Return how long [s] this program took for what has arrived, in place of amplifiers."""
        return sum(each.used for each in self._devices)

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
        last = max(each.changed_at for each in self._devices)
        if (left := last + QUIET - time.monotonic()) > 0:
            await asyncio.sleep(left)
            await self.quiet()
