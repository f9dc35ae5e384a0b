"""Far ends without I/O, served in the running event loop on pseudo-terminals and TCP ports.

The host opens one side of a pseudo-terminal, the far end the other. Symbolic links give them other
paths.
"""

import asyncio
import math
import os
import socket
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Self, TypeAlias, cast
from urllib.parse import urlsplit

from drivers.errors import LinkError
from drivers.protocol.definition import HELLO, NAK, REQUESTS, decode_request, nak_of
from drivers.protocol.records import Refusal
from drivers.protocol.sets import is_earlier_part
from drivers.urls import ADDRESS_MAX
from model.errors import InputError
from registry import files, threads
from sim.amplifier.simulated_amplifier import SimulatedAmplifier
from sim.bench.amplifier_device import AmplifierDevice
from sim.faults import Faults
from sim.transport.simulated_line import LineDelays, TwoWayLine

TERMINAL_SCHEMES = ("serial", "modbus+rtu", "can+slcan")


def links_by_amplifier(options: Sequence[str], *, amplifiers: Sequence[str]) -> dict[str, Path]:
    """The links of amplifiers by name; options: `NAME=PATH`, or `PATH` for the first amplifier.

    Raises InputError.
    """
    links: dict[str, Path] = {}
    for text in options:
        name, equals, path = text.partition("=")
        if not equals:
            name, path = amplifiers[0], text
        if name not in amplifiers:
            raise InputError(
                f"--link {text}: amplifier must be one of {', '.join(amplifiers)}, such as "
                f"--link {amplifiers[0]}=/tmp/{amplifiers[0]}"
            )
        if name in links or not path:
            raise InputError(f"--link {text}: must be NAME=PATH, once per amplifier")
        links[name] = Path(path)
    return links


@contextmanager
def linked_urls(urls: Mapping[str, str], links: Mapping[str, Path]) -> Iterator[dict[str, str]]:
    """URLs of amplifiers with their pseudo-terminals under other paths, both by name.

    Amplifiers on the same line share its link. Raises InputError for a wire without a
    pseudo-terminal.
    """
    with ExitStack() as stack:
        paths: dict[str, str] = {}
        for name, link in links.items():
            parts = urlsplit(urls[name])
            if parts.scheme not in TERMINAL_SCHEMES or parts.netloc:
                raise InputError(
                    f"--link {link}: amplifier {name} must be on a pseudo-terminal, got "
                    f"{urls[name]}"
                )
            if parts.path in paths:
                raise InputError(f"--link {link}: the line of {name} has one; give one per line")
            paths[parts.path] = stack.enter_context(linked(link, to=parts.path))
        yield {name: _moved(url, paths) for name, url in urls.items()}


def _moved(url: str, paths: Mapping[str, str]) -> str:
    """The URL with the link of its pseudo-terminal, if it has one."""
    terminal = urlsplit(url).path
    if terminal not in paths:
        return url
    return url.replace(terminal, paths[terminal], 1)


@contextmanager
def linked(link: Path, *, to: str) -> Iterator[str]:
    """A symbolic link to a path in this context; yields its absolute path. Raises InputError."""
    with _lock(link):
        if not link.is_symlink() and link.exists():
            raise InputError(f"--link {link}: exists and is no symbolic link; choose another path")
        temporary = link.with_name(f".{link.name}.{os.getpid()}")
        try:
            temporary.symlink_to(to)
            temporary.replace(link)
        except OSError as problem:
            raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None
        try:
            yield str(link.absolute())
        finally:
            # Another program may have replaced it meanwhile.
            if link.is_symlink() and str(link.readlink()) == to:
                link.unlink()


@contextmanager
def _lock(link: Path) -> Iterator[None]:
    """Lock a link against other programs; the lock ends with its process, even if killed."""
    path = link.with_name(f".{link.name}.lock")
    try:
        file = path.open("wb")
    except OSError as problem:
        raise InputError(f"--link {link}: cannot be made: {problem.strerror}") from None
    with file:
        try:
            files.lock(file)
        except BlockingIOError:
            raise InputError(
                f"--link {link}: in use by another amplifier; choose another path"
            ) from None
        yield


_READ_MAX = 4096


class PseudoTerminal:
    """The far end's side of a serial line: a pseudo-terminal of the system. Raises LinkError.

    on_data: called with bytes from the host; unpluggable: the port is a symbolic link, which
    outlives each pseudo-terminal. Bytes that a host does not read are lost.
    """

    def __init__(self, on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> None:
        self._on_data = on_data
        self._master = -1
        self._slave = -1
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self.plug_in()
        if unpluggable:
            self._folder = tempfile.TemporaryDirectory(prefix="era-line-")
            self._link()

    @property
    def port(self) -> str:
        """The path of the host's side."""
        if self._folder is not None:
            return str(Path(self._folder.name) / "port")
        return os.ttyname(self._slave)

    def plug_in(self) -> None:
        """Create the line if it is unplugged; raises LinkError."""
        if self._master >= 0:
            return
        try:
            import tty  # not on Windows

            self._master, self._slave = os.openpty()
        except OSError as error:
            raise LinkError(
                f"cannot create a pseudo-terminal: {error.strerror}; close programs that use some, "
                "or raise kernel.pty.max"
            ) from error
        # Kept open, so that hosts may disconnect without a hang-up.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        if self._folder is not None:
            self._link()

    def listen(self) -> None:
        """Read from now on, in the running event loop."""
        asyncio.get_running_loop().add_reader(self._master, self._readable)

    def unplug(self) -> None:
        """Remove the line."""
        if self._master < 0:
            return
        asyncio.get_running_loop().remove_reader(self._master)
        if self._folder is not None:
            # Before closing: another program can then get the same number, and its bytes.
            Path(self.port).unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)
        self._master = -1
        self._slave = -1

    def plug(self, is_plugged: bool) -> None:
        """Unplug the line, or plug it in and read again."""
        if is_plugged:
            self.plug_in()
            self.listen()
        else:
            self.unplug()

    def close(self) -> None:
        """Release all resources."""
        self.unplug()
        if self._folder is not None:
            self._folder.cleanup()

    def write(self, data: bytes) -> None:
        """Write to the host; discarded while unplugged."""
        if self._master < 0:
            return
        with suppress(BlockingIOError):
            os.write(self._master, data)

    def _link(self) -> None:
        link = Path(self.port)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))

    def _readable(self) -> None:
        try:
            data = os.read(self._master, _READ_MAX)
        except BlockingIOError:  # another wake-up took the bytes
            return
        self._on_data(data)


TERMINAL_MAKER: ContextVar[Callable[..., PseudoTerminal]] = ContextVar(
    "TERMINAL_MAKER", default=PseudoTerminal
)
"""The factory in this context."""


def make_terminal(on_data: Callable[[bytes], None], *, unpluggable: bool = False) -> PseudoTerminal:
    """Create a serial line; see `PseudoTerminal`."""
    return TERMINAL_MAKER.get()(on_data, unpluggable=unpluggable)


HOST = "127.0.0.1"
_MAX_CONNECTIONS = 16
_MAX_UNSENT = 16384  # bytes; then a client that does not read is disconnected


class FarEnd(ABC):
    """The amplifiers' side of a wire, without I/O; by default nothing is due by itself."""

    @property
    def next_event(self) -> float:
        """Time [s] of the next tick; infinite: never."""
        return math.inf

    @abstractmethod
    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""

    def tick(self, now: float) -> None:  # noqa: B027
        """Process everything due by a time [s]."""

    def close(self) -> None:  # noqa: B027
        """Send nothing more."""


AmplifierPort: TypeAlias = SimulatedAmplifier | AmplifierDevice
"""An amplifier as far ends serve it: alone, or on a bench with faults."""


def carry_out(
    amplifier: AmplifierPort,
    kind: int,
    words: Sequence[int],
    now: float,
    *,
    is_for_all: bool = False,
    address_max: int = ADDRESS_MAX,
) -> tuple[int, Sequence[int]]:
    """Carry out a request, by type and words, at a time [s]; returns type and words of its reply.

    A refusal is a Nak. No words: the request has no reply, like a part of a set other than the
    last. is_for_all: whether the request is for all amplifiers, which do not reply; address_max: of
    the wire.
    """
    if kind == HELLO:
        return HELLO, REQUESTS["Hello"].reply.pack(amplifier.identity)
    try:
        name, values = decode_request(kind, words)
        if is_for_all and not REQUESTS[name].is_broadcast:
            raise Refusal(f"{name} must be for one amplifier")
        if name == "SetAddress" and values["address"] > address_max:
            raise Refusal(f"address must be 1 to {address_max}, got {values['address']}")
        reply = amplifier.handle(name, values, now)
    except Refusal as refusal:
        return NAK, () if is_earlier_part(kind, words) else nak_of(refusal, kind)
    if is_for_all:
        amplifier.withdraw_status()
    return kind, REQUESTS[name].reply.pack(reply) if reply else ()


SendBytes = Callable[[bytes], None]
MakeEnd = Callable[[SendBytes], FarEnd]
"""Makes a far end from its function to send bytes; no bytes end the connection."""


class TimedFarEnd:
    """A far end with its timer."""

    def __init__(self, end: FarEnd) -> None:
        self._end = end
        self._timer: asyncio.TimerHandle | None = None

    def receive(self, data: bytes, now: float) -> None:
        """Take bytes from the host at a time [s]."""
        self._end.receive(data, now)
        self.schedule()

    def schedule(self) -> None:
        """Have it ticked when its next event is due."""
        self._cancel()
        due = self._end.next_event
        if due < math.inf:
            self._timer = asyncio.get_running_loop().call_at(due, self._tick)

    def close(self) -> None:
        """Close it and stop its timer."""
        self._end.close()
        self._cancel()

    def _cancel(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def _tick(self) -> None:
        self._end.tick(threads.now())
        self.schedule()


class TerminalEnd:
    """A pseudo-terminal in front of a far end, as an asynchronous context.

    device: injects the faults of the wire (by default, of frames); delays: see `TwoWayLine`;
    unpluggable: see `make_terminal`.
    """

    def __init__(
        self,
        device: AmplifierDevice,
        make_end: MakeEnd,
        *,
        faults: Faults | None = None,
        delays: LineDelays | None = None,
        byte_time: float = 0.0,
        unpluggable: bool = False,
    ) -> None:
        self._line = TwoWayLine(
            to_amplifier=lambda data, now: self._served.receive(data, now),
            to_host=lambda data: self._terminal.write(data),
            faults=device.faults if faults is None else faults,
            delays=delays,
            byte_time=byte_time,
        )
        self._served = TimedFarEnd(make_end(self._line.outward.send))
        self._terminal = make_terminal(self._line.inward.send, unpluggable=unpluggable)
        self.port = self._terminal.port
        """The path of the host's side."""
        self._plug_listeners = device.plug_listeners if unpluggable else []

    async def __aenter__(self) -> Self:
        """Serve in the running event loop."""
        self._terminal.listen()
        self._plug_listeners.append(self._plug)
        return self

    async def __aexit__(self, *error: object) -> None:
        """Close."""
        self._plug_listeners.remove(self._plug)
        self._line.close()
        self._served.close()
        self._terminal.close()

    def _plug(self, is_plugged: bool) -> None:
        self._line.close()
        self._terminal.plug(is_plugged)


class TcpEnd:
    """A TCP port on the loopback interface, 0 for any, as an asynchronous context.

    make_end: of each connection; device, faults and delays: see `TerminalEnd`. An unplugged port
    closes its connections, unlike a cable. Entering it raises LinkError if the port is in use.
    """

    def __init__(
        self,
        device: AmplifierDevice,
        make_end: MakeEnd,
        *,
        faults: Faults | None = None,
        delays: LineDelays | None = None,
        port: int = 0,
    ) -> None:
        self.port = port
        self.delays = delays
        self.faults = device.faults if faults is None else faults
        self.make_end = make_end
        self.connections: set[_TcpClient] = set()
        self._device = device
        self._server: asyncio.Server | None = None

    @property
    def is_open(self) -> bool:
        """Whether it takes one more connection."""
        return self._device.is_plugged and len(self.connections) < _MAX_CONNECTIONS

    async def __aenter__(self) -> Self:
        """Listen."""
        loop = asyncio.get_running_loop()
        try:
            self._server = await loop.create_server(lambda: _TcpClient(self), HOST, self.port)
        except OSError as error:
            raise LinkError(
                f"port {self.port}: cannot listen: {error.strerror or error}; choose another, or "
                "0 for any"
            ) from error
        self.port = int(self._server.sockets[0].getsockname()[1])
        self._device.plug_listeners.append(self._plug)
        return self

    async def __aexit__(self, *error: object) -> None:
        """Stop listening and close the connections."""
        self._device.plug_listeners.remove(self._plug)
        self._plug(False)
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()

    def _plug(self, is_plugged: bool) -> None:
        if not is_plugged:
            for connection in tuple(self.connections):
                connection.transport.abort()


class _TcpClient(asyncio.Protocol):
    """One client; damaged data are lost, because TCP detects them."""

    def __init__(self, port: TcpEnd) -> None:
        self._port = port

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        if not self._port.is_open:
            self.transport.abort()
            return
        self._port.connections.add(self)
        open_socket: socket.socket = transport.get_extra_info("socket")
        open_socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MAX_UNSENT)
        self._line = TwoWayLine(
            to_amplifier=lambda data, now: self._served.receive(data, now),
            to_host=self._send,
            faults=self._port.faults,
            delays=self._port.delays,
            finds_damage=True,
        )
        self._served = TimedFarEnd(self._port.make_end(self._line.outward.send))

    def data_received(self, data: bytes) -> None:
        self._line.inward.send(data)

    def connection_lost(self, exc: Exception | None) -> None:
        if self in self._port.connections:
            self._port.connections.remove(self)
            self._line.close()
            self._served.close()

    def _send(self, data: bytes) -> None:
        if self.transport.is_closing():
            return
        self.transport.write(data)
        if not data:
            self.transport.close()
        elif self.transport.get_write_buffer_size() > _MAX_UNSENT:
            self.transport.abort()
