"""Serial lines in memory, for virtual time.

Hosts and far ends write real bytes, which arrive after random delays, sometimes in two pieces.
"""

import asyncio
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

from drivers.errors import LinkError
from drivers.ports import PORT_OPENER
from registry import threads
from sim.transport.far_end import TERMINAL_MAKER, PseudoTerminal
from virtual_loop import VirtualLoop

_PASSING = (50e-6, 900e-6)  # s; through driver and adapter
_SPLIT = 0.1  # share of pieces that arrive in two
_BOOT_TEXT = b"\r\nrst:0x1 (POWERON_RESET)\r\n"
_NOTICED = 0.002  # s; until the host notices a hang-up


class MemoryMachine:
    """Ports by name; `make_terminal` is for far ends, the rest for hosts.

    passing [s]: shortest and longest time of bytes on their way; late [s]: how much later what goes
    to the host leaves the far end, by port; attempts: how often each port was to be opened; boots
    [s]: for which a board that restarts whenever its port is opened prints text, and hears nothing.
    """

    def __init__(self, loop: VirtualLoop) -> None:
        self.passing = _PASSING
        self.late: dict[str, float] = {}
        self.attempts = Counter[str]()
        self.boots = 0.0
        self._loop = loop
        self._terminals: dict[str, MemoryTerminal] = {}
        self._open: dict[str, MemoryPort] = {}

    def make_terminal(
        self, on_data: Callable[[bytes], None], *, unpluggable: bool
    ) -> "MemoryTerminal":
        terminal = MemoryTerminal(self, f"/dev/memory{len(self._terminals)}", on_data)
        self._terminals[terminal.port] = terminal
        return terminal

    async def open_port(
        self, name: str, on_data: Callable[[bytes], None], on_loss: Callable[[str], None]
    ) -> "MemoryPort":
        """Open the host's side of a line; LinkError if it is unplugged or open already."""
        self.attempts[name] += 1
        await asyncio.sleep(self._loop.rng.uniform(*self.passing))
        terminal = self._terminals.get(name)
        if terminal is None or not terminal.is_plugged:
            raise LinkError(f"serial port {name} cannot be opened: no such port")
        if name in self._open:
            raise LinkError(f"serial port {name} cannot be opened: in use by another program")
        port = self._open[name] = MemoryPort(self, terminal, on_data, on_loss)
        if self.boots:
            port.hears_from = self._loop.time() + self.boots
            self.later(_NOTICED, port.outward.take, _BOOT_TEXT)  # which no witness judges
        return port

    def be_prompt(self) -> None:
        """Let bytes pass at once, on serial lines and TCP connections."""
        self.passing = self._loop.latency = (0.0, 0.0)

    def kill_host(self) -> None:
        """Close the host's ports without notice, as when its process dies."""
        for port in tuple(self._open.values()):
            port.close()

    def closed(self, name: str) -> None:
        self._open.pop(name, None)

    def deliver(self, link: str, toward: str, data: bytes, to: "_Direction") -> None:
        """Deliver bytes in order, after a delay, perhaps in two pieces."""
        late = self.late.get(link, 0.0) if toward == "host" else 0.0
        if late or to.leaves > self._loop.time():
            # Timers of one moment run in any order; bytes of one line must not.
            to.leaves = max(to.leaves + 1e-9, self._loop.time() + late)
            self._loop.call_at(to.leaves, self._pass, link, toward, data, to)
        else:
            self._pass(link, toward, data, to)

    def _pass(self, link: str, toward: str, data: bytes, to: "_Direction") -> None:
        loop, pieces = self._loop, [data]
        loop.seen(link, toward, data)
        if len(data) > 1 and loop.rng.random() < _SPLIT:
            at = loop.rng.randrange(1, len(data))
            pieces = [data[:at], data[at:]]
        for piece in pieces:
            soonest = to.arrives + 1e-9
            to.arrives = max(soonest, loop.time() + loop.rng.uniform(*self.passing))
            loop.call_at(to.arrives, to.take, piece)

    def later(self, delay: float, callback: Callable[..., None], *args: Any) -> None:
        self._loop.call_later(delay, callback, *args)

    def opened(self, name: str) -> "MemoryPort | None":
        return self._open.get(name)


def live_in_memory() -> MemoryMachine:
    """Connect hosts and far ends of the running virtual loop in memory."""
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    machine = MemoryMachine(loop)
    random.seed(loop.rng.random())  # of tokens, and of numbers on wires
    PORT_OPENER.set(machine.open_port)
    TERMINAL_MAKER.set(machine.make_terminal)
    return machine


class _Direction:
    """One direction of a line, until it is unplugged."""

    def __init__(self, take: Callable[[bytes], None]) -> None:
        self.arrives = self.leaves = 0.0
        self.is_cut = False
        self._take = take

    def take(self, piece: bytes) -> None:
        """Take a piece, unless the line was cut or closed meanwhile."""
        if not self.is_cut:
            self._take(piece)


class MemoryTerminal(PseudoTerminal):
    """The far end's side of a line."""

    def __init__(self, machine: MemoryMachine, name: str, on_data: Callable[[bytes], None]) -> None:
        self.is_plugged = True
        self._machine = machine
        self._name = name
        self._on_data = on_data
        self.inward = _Direction(on_data)

    @property
    def port(self) -> str:
        return self._name

    def plug_in(self) -> None:
        if not self.is_plugged:
            self.is_plugged = True
            self.inward = _Direction(self._on_data)

    def listen(self) -> None:
        """Bytes arrive without it."""

    def unplug(self) -> None:
        if not self.is_plugged:
            return
        self.is_plugged = False
        self.inward.is_cut = True
        port = self._machine.opened(self._name)
        if port is not None:
            port.hang_up()

    def close(self) -> None:
        self.unplug()

    def write(self, data: bytes) -> None:
        """Send to the host; without an open port, bytes are lost."""
        port = self._machine.opened(self._name)
        if self.is_plugged and port is not None:
            self._machine.deliver(self._name, "host", data, port.outward)


class MemoryPort:
    """The host's side of a line."""

    def __init__(
        self,
        machine: MemoryMachine,
        terminal: MemoryTerminal,
        on_data: Callable[[bytes], None],
        on_loss: Callable[[str], None],
    ) -> None:
        self._machine = machine
        self._terminal = terminal
        self._on_loss = on_loss
        self._is_closed = self._is_hung_up = False
        self.outward = _Direction(on_data)
        self.hears_from = 0.0

    @property
    def is_blocked(self) -> bool:
        return False

    def poll(self) -> None:
        """All that has come was handed over."""

    def write(self, data: bytes) -> None:
        if self._is_closed or self._is_hung_up:
            raise LinkError(f"serial line {self._terminal.port} was lost")
        if threads.now() < self.hears_from:
            return
        self._machine.deliver(self._terminal.port, "amplifier", data, self._terminal.inward)

    def hang_up(self) -> None:
        """Cut the line; the host notices a little later."""
        self._is_hung_up = self.outward.is_cut = True
        self._machine.closed(self._terminal.port)
        self._machine.later(_NOTICED, self._notice)

    def close(self) -> None:
        if not self._is_closed:
            self._is_closed = self.outward.is_cut = True
            if not self._is_hung_up:
                self._machine.closed(self._terminal.port)

    async def wait_closed(self) -> None:
        """Return at once."""

    def _notice(self) -> None:
        if not self._is_closed:
            self._on_loss(f"serial line {self._terminal.port} was lost (it hung up)")
