"""The witness in a soak run, with all bytes, touches and operator commands.

What it knows comes from the wires, the touches, the operator and the faults of the plan; nothing
from the controller but when it opens its links and closes them.
"""

import math
from collections.abc import Mapping, Sequence

from sim.amplifier.contract import Amplifier
from sim.faults.fault_window import FaultWindow
from sim.witness.witness import OperatorCommand, Witness
from soak_contacts import SourceContacts
from virtual_loop import START, VirtualLoop
from witness_config import sense, witness_config

_TOUCH = 0.19  # s; from a touch to its pattern
_HEARTBEAT = 0.055  # s; between two signs of life on an idle line
_RAMP = 0.040  # s; along which what plays may fall silent after the last lift
_ENDED = 1e-6  # s; after a lease has ended


class SoakWitness:
    """A witness on all wires of a run, by amplifiers' URLs; channels: how many each has.

    release [s]: from the last lift to the command of silence, on the slowest wire of them;
    heartbeat [s]: that a sign of life may be late by.
    """

    def __init__(
        self,
        loop: VirtualLoop,
        urls: Mapping[str, str],
        contacts: SourceContacts,
        *,
        channels: int,
        release: float,
        heartbeat: float,
    ) -> None:
        times = {
            "lift": release,
            "release": release + _RAMP,
            "touch": _TOUCH,
            "stop": release,
            "heartbeat": _HEARTBEAT + heartbeat,
        }
        self._loop = loop
        self._witness = Witness(witness_config(urls, channels=channels, times_s=times))
        self._open: set[str] = set()
        self._contacts = contacts
        self._active_faults = 0
        self._witness.contacts(loop.time(), ())
        self.closes()

    def seen(self, link: str, toward: str, data: bytes) -> None:
        """Pass bytes on, unless no host has the link open."""
        if link in self._open:
            self._witness.record_bytes(link, toward, self._loop.time(), data)  # type: ignore[arg-type]

    def opens(self) -> None:
        """A host is about to open all wires."""
        for link in self._witness.wires:
            self._open.add(link)
            self._witness.opened(link, self._loop.time())

    def closes(self) -> None:
        """The host has closed all, or died."""
        for link in self._witness.wires:
            self._open.discard(link)
            self._witness.closed(link, self._loop.time())

    def operator_command(self, what: OperatorCommand) -> None:
        """An operator wants this."""
        self._witness.operator_command(self._loop.time(), what)

    def set_stalled(self, is_stalled: bool) -> None:
        """The control loop stands still from now on, or goes on."""
        self._witness.set_stalled(self._loop.time(), is_stalled)

    def touched(self, *, must_be_felt: bool) -> None:
        """Show the contacts, of which a source has sent a frame."""
        now = self._loop.time()
        self._witness.contacts(now, self._contacts.at(now), is_answerable=must_be_felt)
        if (end := self._contacts.next_end(now)) < math.inf:
            self._loop.call_at(end + _ENDED, self._expire_contacts)

    def inject_fault(self, window: FaultWindow) -> None:
        """A fault begins. What it does to one wire, a controller of all may show on each."""
        self._active_faults += 1
        self._report_disturbance()
        lasts = window.lasts + (window.delay if window.fault == "delay" else 0.0)
        self._loop.call_later(lasts, self._over)

    def sense(self, name: str, amplifier: Amplifier) -> None:
        """Show what an amplifier plays now."""
        sense(self._witness, self._loop.time(), name, amplifier)

    def found(self) -> Sequence[str]:
        """What it has found until now, with the frames around it."""
        return [
            f"{one.time_s - START:.6f} {one.wire} {one.invariant}: {one.sentence}"
            + "".join(f"\n        {frame}" for frame in one.frames)
            for one in self._witness.finish(self._loop.time())
        ]

    @property
    def frames(self) -> int:
        """How many it has seen."""
        return self._witness.frames

    def _expire_contacts(self) -> None:
        now = self._loop.time()
        self._witness.contacts(now, self._contacts.at(now))

    def _over(self) -> None:
        self._active_faults -= 1
        self._report_disturbance()

    def _report_disturbance(self) -> None:
        for link in self._witness.wires:
            self._witness.faults(self._loop.time(), link, are_on=self._active_faults > 0)
