"""The amplifiers' side of a serial line: a pseudo-terminal in front of simulated amplifiers.

Several share a line as on RS-485, each with its own address; then none speaks unasked. A line that
is unplugged is another pseudo-terminal once it is there again: its URL names a link to it.

Not modelled: noise, parity, two that speak at once.
"""

import asyncio
import contextlib
import os
import tempfile
import tty
from collections.abc import Sequence
from pathlib import Path

from drivers.errors import LinkError
from drivers.protocol.definition import PROTOCOL
from drivers.protocol.messages import Commit, Event, Nak, Reply, Stop
from drivers.protocol.payload import Malformed
from drivers.protocol.serial_codec import decode_request, encode_event, encode_reply
from drivers.protocol.serial_frame import Frame, FrameCounters, FrameReader, encode_frame
from sim.line import Line
from sim.station import Station

_READ_MAX = 4096


class SerialEnd:
    """A pseudo-terminal on which stations answer, each at the address that is its number.

    baud: bytes take as long as at this speed; None for no time at all. unpluggable: the port is
    named by a link that outlives the pseudo-terminal.
    """

    def __init__(
        self, stations: Sequence[Station], *, baud: int | None = None, unpluggable: bool = False
    ) -> None:
        alone = len(stations) == 1
        self._stations = {
            PROTOCOL.serial.address if alone else station.number: station for station in stations
        }
        self._first = stations[0]
        self._baud = baud or PROTOCOL.serial.baud
        faults = self._first.faults
        self._inward = Line(self._arrived, toward="amplifier", faults=faults, bits_per_second=baud)
        self._outward = Line(self._write, toward="host", faults=faults, bits_per_second=baud)
        self._events = 0
        self._master = self._slave = -1
        self._reader = FrameReader()
        self.dropped_replies = 0
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._plug_in()
        if unpluggable:
            self._folder = tempfile.TemporaryDirectory(prefix="era-serial-")
            self._link()

    @property
    def port(self) -> str:
        """The path of the host's side."""
        if self._folder is not None:
            return str(Path(self._folder.name) / "port")
        return os.ttyname(self._slave)

    @property
    def urls(self) -> dict[str, str]:
        """The URL of each amplifier, by its name."""
        first = PROTOCOL.serial.address
        return {
            station.name: f"serial://{self.port}?baud={self._baud}"
            + (f"&address={number}" if number != first else "")
            for number, station in self._stations.items()
        }

    @property
    def counters(self) -> FrameCounters:
        """What came in, frames by their fate."""
        return self._reader.counters

    def start(self) -> None:
        """Answer from now on, in the running event loop."""
        self._listen()
        if self._folder is not None:
            self._first.on_plug(self._plug)
        if len(self._stations) == 1:
            self._first.listen(self._tell)

    def close(self) -> None:
        """Hang up; to be called in the event loop that it was started in."""
        self._unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def _plug_in(self) -> None:
        try:
            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkError(
                f"the system gives no pseudo-terminal ({error.strerror}); close programs that hold "
                "some, or raise their number"
            ) from error
        # The slave stays open here, so that a host may come and go without a hang-up.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)

    def _link(self) -> None:
        link = Path(self.port)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))

    def _listen(self) -> None:
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def _unplug(self) -> None:
        self._inward.close()
        self._outward.close()
        if self._master < 0:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def _plug(self, is_plugged: bool) -> None:
        """The line has come, or gone."""
        if not is_plugged:
            self._unplug()
            Path(self.port).unlink(missing_ok=True)
        elif self._master < 0:
            self._plug_in()
            self._link()
            self._listen()

    def _readable(self) -> None:
        try:
            data = os.read(self._master, _READ_MAX)
        except BlockingIOError:  # another wake-up took the bytes
            return
        self._inward.send(data)

    def _arrived(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            if frame.is_reply:  # an echo is no request
                continue
            if frame.address == PROTOCOL.serial.broadcast:
                self._broadcast(frame)
            elif frame.address in self._stations:
                reply = self._answer(frame, self._stations[frame.address])
                if reply is not None:
                    self._outward.send(encode_frame(encode_reply(reply, frame)))

    def _answer(self, frame: Frame, station: Station) -> Reply | None:
        try:
            request = decode_request(frame)
        except Malformed as problem:
            return Nak(problem.code, problem.channel) if station.is_answering else None
        return station.exchange(request)

    def _broadcast(self, frame: Frame) -> None:
        with contextlib.suppress(Malformed):
            request = decode_request(frame)
            if isinstance(request, Commit | Stop):
                for station in self._stations.values():
                    station.broadcast(request)

    def _tell(self, event: Event) -> None:
        if self._first.is_answering:
            self._events = (self._events + 1) & 0xFFFF
            frame = encode_event(event, address=PROTOCOL.serial.address, sequence=self._events)
            self._outward.send(encode_frame(frame))

    def _write(self, data: bytes) -> None:
        if self._master < 0:
            return
        try:
            complete = os.write(self._master, data) == len(data)
        except BlockingIOError:
            complete = False
        if not complete:  # nobody reads; an amplifier does not wait for its host
            self.dropped_replies += 1
