"""Who judges a soak run: the fingers that are on the plate, the witness, and bounds under faults.

Fingers are by the touch frames alone and docs/reference/touch.md. What the witness knows comes from
the wires, the touches, the operator and the faults of the plan; nothing from the controller but
when it opens its links and closes them. It excuses wires with faults: what must hold whatever fails
is checked by what the simulated amplifiers really play, with bounds that the fault table and the
timeouts of a link add up to.
"""

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

from drivers.protocol.records import Values
from drivers.protocol.table import MESSAGES, STATES
from sim.amplifier.contract import Amplifier
from sim.bench.bench import Bench
from sim.faults.fault_window import FaultWindow
from virtual_loop import START
from witness_config import LoopWitness, sense

CONTACT_TIMEOUT = 0.150  # s; a source without news for so long has lost its fingers
_GLIMPSE = 0.005  # s; a finger that is gone sooner may have come and gone between two cycles,
_TAP = 0.060  # s; and then counts for so long, so that a tap is felt

FrameTouches: TypeAlias = Sequence[tuple[int, float, float]]
"""Of one frame: id, x, y, where 0 to 1 is the plate."""


class SourceContacts:
    """The contacts of every source, by source and id; times [s]."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[float, frozenset[tuple[str, int]]]] = {}
        self._until: dict[str, float] = {}  # by source: end of its contacts
        self._since: dict[tuple[str, int], float] = {}
        self._taps: dict[tuple[str, int], float] = {}  # when those end that are lifted already

    def frame(self, source: str, stamp: float, touches: FrameTouches, now: float) -> None:
        """A frame has been delivered, and replaces what its source has said before."""
        last = {number: (x, y) for number, x, y in touches}
        numbers = frozenset(
            (source, number)
            for number, (x, y) in last.items()
            if 0 <= x <= 1 and 0 <= y <= 1  # NaN is not
        )
        ended, were = self._now.get(source, (-math.inf, frozenset[tuple[str, int]]()))
        were = were if now < ended else frozenset()
        for key in were - numbers:
            if stamp - self._since[key] < _GLIMPSE:
                self._taps[key] = self._since[key] + _TAP
        self._since |= dict.fromkeys(numbers - were, stamp)
        end = min(stamp, now) + CONTACT_TIMEOUT if math.isfinite(stamp) else -math.inf
        self._now[source] = end, numbers
        before = min(self._until.get(source, -math.inf), now)
        self._until[source] = max(end if numbers else -math.inf, before)

    @property
    def last(self) -> float:
        """When the plate is or was touched last, as far as is known."""
        return max([*self._until.values(), *self._taps.values()], default=-math.inf)

    def at(self, now: float) -> frozenset[tuple[str, int]]:
        """All that are on the plate."""
        taps = {key for key, end in self._taps.items() if now < end}
        return frozenset(taps).union(*(keys for end, keys in self._now.values() if now < end))

    def next_end(self, now: float) -> float:
        """When the first source is overdue if nothing more is heard; infinity if none can be."""
        ends = [end for end, keys in self._now.values() if keys]
        return min((end for end in (*ends, *self._taps.values()) if end > now), default=math.inf)


_TOUCH = 0.19  # s; from a touch to its pattern
_HEARTBEAT = 0.055  # s; between two signs of life on an idle line
_RAMP = 0.040  # s; along which what plays may fall silent after the last lift
_ENDED = 1e-6  # s; after a lease has ended


class SoakWitness(LoopWitness):
    """A witness on all wires of a run, by amplifiers' URLs; channels: how many each has.

    It hears only what a host hears that has the wires open.
    release [s]: from the last lift to the command of silence, on the slowest wire of them;
    heartbeat [s]: that a sign of life may be late by.
    """

    def __init__(
        self,
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
        super().__init__(urls, channels=channels, times_s=times)
        self._contacts = contacts
        self._active_faults = 0
        self.contacts(self.loop.time(), ())
        self.closes()

    def seen(self, link: str, toward: str, data: bytes) -> None:
        """Hear bytes, unless no host has the link open."""
        if self._is_open:
            super().seen(link, toward, data)

    def opens(self) -> None:
        """A host is about to open all wires."""
        self._is_open = True
        super().opens()

    def closes(self) -> None:
        """The host has closed all, or died."""
        self._is_open = False
        super().closes()

    def touched(self, *, must_be_felt: bool) -> None:
        """Show the contacts, of which a source has sent a frame."""
        now = self.loop.time()
        self.contacts(now, self._contacts.at(now), is_answerable=must_be_felt)
        if (end := self._contacts.next_end(now)) < math.inf:
            self.loop.call_at(end + _ENDED, self._expire_contacts)

    def inject_fault(self, window: FaultWindow) -> None:
        """A fault begins. What it does to one wire, a controller of all may show on each."""
        self._active_faults += 1
        self.disturb()
        lasts = window.lasts + (window.delay if window.fault == "delay" else 0.0)
        self.loop.call_later(lasts, self._over)

    def sense(self, name: str, amplifier: Amplifier) -> None:
        """Show what an amplifier plays now."""
        sense(self, self.loop.time(), name, amplifier)

    def found(self) -> Sequence[str]:
        """What it has found until now, with the frames around it."""
        return [
            f"{one.time_s - START:.6f} {one.wire} {one.invariant}: {one.sentence}"
            + "".join(f"\n        {frame}" for frame in one.frames)
            for one in self.finish(self.loop.time())
        ]

    def _expire_contacts(self) -> None:
        now = self.loop.time()
        self.contacts(now, self._contacts.at(now))

    def _over(self) -> None:
        self._active_faults -= 1
        self.disturb(are_on=self._active_faults > 0)


AUDIBLE = 1e-3  # of full stroke; below it a ramp counts as ended
WATCHDOG = 0.25 + 0.005  # s; then every channel is silent
# s; three unanswered requests, then the watchdog, and a heartbeat that was on its way.
RELEASE_WITH_FAULTS = 3 * 0.15 + WATCHDOG + 0.1
TOGETHER = 0.6  # s; until all are silent after one of them has a fault
STEP = 0.020  # s; check interval while a channel vibrates
IDLE_STEP = 1.0
# Those with a ramp to silence of their own end what the watchdog would.
_SILENCING_REQUESTS = ("Disarm", "Stop")
_FAULTED = (STATES["FAULT"], STATES["FAULT_REACTION_ACTIVE"])


class Checks:
    """Checks of a bench; `violations`: those found, each with its time.

    begin [s]: when the plan's time began; sense: called with every amplifier at each check.
    """

    def __init__(
        self,
        bench: Bench,
        *,
        begin: float,
        contacts: SourceContacts,
        sense: Callable[[str, Amplifier], None],
    ) -> None:
        self.violations: list[str] = []
        self._bench = bench
        self._begin = begin
        self._contacts = contacts
        self._sense = sense
        self._fed = dict.fromkeys(bench.amplifiers, -math.inf)
        self._faulted: dict[str, float] = {}
        self._loop = asyncio.get_running_loop()
        self._next = self._loop.call_later(IDLE_STEP, self._watch)
        for name, amplifier in bench.amplifiers.items():
            amplifier.listeners.append(lambda event, at, name=name: self._received(name, event, at))

    def violate(self, what: str) -> None:
        """Record a violation."""
        if len(self.violations) < 20:
            self.violations.append(f"{self._loop.time() - self._begin:.6f} {what}")

    def check(self) -> None:
        """Advance the bench to now, and check it."""
        now = self._loop.time()
        self._bench.advance(now)
        for name, amplifier in self._bench.amplifiers.items():
            playback = amplifier.playback
            level = max(min(playback.level(each, now), 1.0) for each in range(playback.channels))
            if not level <= AUDIBLE:
                self._check_loud(name, level, now)
            self._sense(name, amplifier)

    def exchanged(self, name: str, request: str) -> None:
        """Note that an amplifier has carried out a request."""
        now = self._loop.time()
        if request == "Arm":
            self._faulted.pop(name, None)
        if MESSAGES[request].feeds or request in _SILENCING_REQUESTS:
            self._fed[name] = now
        if self._due() < self._next.when():
            self._watch()

    def close(self) -> None:
        """Stop checking."""
        self._next.cancel()

    def _watch(self) -> None:
        """Check periodically, more often while a channel vibrates."""
        self._next.cancel()
        self.check()
        self._next = self._loop.call_at(self._due(), self._watch)

    def _due(self) -> float:
        """When to check next: the amplifiers have nothing to wake them but this."""
        now, amplifiers = self._loop.time(), self._bench.amplifiers.values()
        plays = any(
            tone.silent_from > now
            for each in amplifiers
            for output in each.outputs
            for tone in output
        )
        return min(now + (STEP if plays else IDLE_STEP), *(each.next_event for each in amplifiers))

    def _received(self, name: str, event: Values, at: float) -> None:
        if event["state"] in _FAULTED:
            self._faulted.setdefault(name, at)
        else:
            self._faulted.pop(name, None)

    def _check_loud(self, name: str, level: float, now: float) -> None:
        bounds = {"it was fed": (self._fed[name], WATCHDOG)}
        bounds["the last finger"] = (self._contacts.last, RELEASE_WITH_FAULTS)
        for other in self._faulted.keys() - {name}:
            bounds[f"the fault of {other}"] = (self._faulted[other], TOGETHER)
        for what, (since, bound) in bounds.items():
            if now - since > bound:
                self.violate(f"{name} plays at {level:.4f} {now - since:.4f} s after {what}")
