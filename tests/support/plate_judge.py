"""Who judges a chain beside the witness: the fingers on its plate, and bounds that always hold.

Fingers are by the touch frames alone and docs/reference/touch.md. The witness excuses wires with
faults: what must hold whatever fails is judged by what the simulated amplifiers really play, with
bounds that the fault table and the timeouts of a link add up to.
"""

import asyncio
import math
from functools import partial

from controller.sources.touch import TouchFrame
from drivers.protocol.definition import MESSAGES, STATES
from drivers.protocol.records import Values
from rig_on_wire import FarSide, after_each
from virtual_loop import START
from witness_config import LoopWitness, sense

CONTACT_TIMEOUT = 0.150  # s; a source without news for so long has lost its fingers
_GLIMPSE = 0.005  # s; a finger that is gone sooner may have come and gone between two cycles,
_TAP = 0.060  # s; and then counts for so long, so that a tap is felt


class SourceContacts:
    """The contacts of every source, by source and id; times [s]."""

    def __init__(self) -> None:
        self._now: dict[str, tuple[float, frozenset[tuple[str, int]]]] = {}
        self._until: dict[str, float] = {}  # by source: end of its contacts
        self._since: dict[tuple[str, int], float] = {}
        self._taps: dict[tuple[str, int], float] = {}  # when those end that are lifted already

    def take(self, frame: TouchFrame, now: float) -> None:
        """Take a frame that has been delivered, and replaces what its source has said before."""
        source, stamp = frame.source, frame.time
        last = {touch.id: (touch.x, touch.y) for touch in frame.touches}
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
        lasts = frame.timeout or CONTACT_TIMEOUT
        end = min(stamp, now) + lasts if math.isfinite(stamp) else -math.inf
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


_ENDED = 1e-6  # s; after contacts have ended
AUDIBLE = 1e-3  # of full stroke; below it a ramp counts as ended
WATCHDOG = 0.25  # s; of armed amplifiers
_SILENCING = 0.005  # s; then every channel is silent
# s; three unanswered requests, then the watchdog, and a heartbeat that was on its way.
RELEASE_WITH_FAULTS = 3 * 0.15 + WATCHDOG + _SILENCING + 0.1
TOGETHER = 0.6  # s; until all are silent after one of them has a fault
STEP = 0.020  # s; check interval while a channel vibrates
IDLE_STEP = 1.0
# Those with a ramp to silence of their own end what the watchdog would.
_SILENCING_REQUESTS = ("Disarm", "Stop")
_FAULTED = (STATES["FAULT"], STATES["FAULT_REACTION_ACTIVE"])


class PlateJudge:
    """Judges what plays at the far ends, and lets the witness sense it and know of the contacts.

    step [s]: between two looks while a channel vibrates; watchdog [s]: of armed amplifiers; what
    plays without fingers is judged once there has been one. violations: those found, each with its
    time; contacts: all that are on the plate.
    """

    def __init__(
        self,
        far: FarSide,
        witness: LoopWitness,
        *,
        step: float = STEP,
        watchdog: float = WATCHDOG,
    ) -> None:
        self.violations: list[str] = []
        self.contacts = SourceContacts()
        self._bench = far.bench
        self._witness = witness
        self._step = step
        self._watchdog = watchdog
        self._fed = dict.fromkeys(far.devices, -math.inf)
        self._faulted: dict[str, float] = {}
        self._loop = asyncio.get_running_loop()
        self._next = self._loop.call_later(IDLE_STEP, self._watch)
        self._expiry: asyncio.TimerHandle | None = None
        for name, device in far.devices.items():
            after_each(device, partial(self._exchanged, name))
            device.listeners.append(partial(self._received, name))

    def violate(self, what: str) -> None:
        """Record a violation."""
        if len(self.violations) < 20:
            self.violations.append(f"{self._loop.time() - START:.6f} {what}")

    def touched(self, frame: TouchFrame, *, must_be_felt: bool) -> None:
        """Note a frame of a source; must_be_felt: whether new contacts must lead to a pattern."""
        self.contacts.take(frame, self._loop.time())
        self._show_contacts(must_be_felt=must_be_felt)

    def _show_contacts(self, *, must_be_felt: bool = False) -> None:
        now = self._loop.time()
        self._witness.contacts(now, self.contacts.at(now), is_answerable=must_be_felt)
        end = self.contacts.next_end(now) + _ENDED
        if self._expiry is not None:
            self._expiry.cancel()
            self._expiry = None
        if end < math.inf:
            self._expiry = self._loop.call_at(end, self._show_contacts)

    def check(self) -> None:
        """Advance the bench to now, and check it."""
        now = self._loop.time()
        self._bench.advance(now)
        for name, amplifier in self._bench.amplifiers.items():
            playback = amplifier.playback
            level = max(min(playback.level(each, now), 1.0) for each in range(playback.channels))
            if not level <= AUDIBLE:
                self._check_loud(name, level, now)
            sense(self._witness, now, name, amplifier)

    def loudest(self, name: str, within: float, looks: int) -> float:
        """Highest level that an amplifier plays within a time [s] without a request, in looks."""
        now, playback = self._loop.time(), self._bench.amplifiers[name].playback
        self._bench.advance(now)
        return max(
            playback.level(channel, now + within * number / looks)
            for number in range(looks)
            for channel in range(playback.channels)
        )

    def close(self) -> None:
        """Stop checking."""
        self._next.cancel()
        if self._expiry is not None:
            self._expiry.cancel()

    def _exchanged(self, name: str, request: str, *_: object) -> None:
        """Note that an amplifier has carried out a request."""
        now = self._loop.time()
        if request == "Arm":
            self._faulted.pop(name, None)
        if MESSAGES[request].feeds or request in _SILENCING_REQUESTS:
            self._fed[name] = now
        if self._due() < self._next.when():
            self._watch()

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
        step = self._step if plays else IDLE_STEP
        return min(now + step, *(each.next_event for each in amplifiers))

    def _received(self, name: str, event: Values, at: float) -> None:
        if event["state"] in _FAULTED:
            self._faulted.setdefault(name, at)
        else:
            self._faulted.pop(name, None)

    def _check_loud(self, name: str, level: float, now: float) -> None:
        bounds = {"it was fed": (self._fed[name], self._watchdog + _SILENCING)}
        if self.contacts.last > -math.inf:
            bounds["the last finger"] = (self.contacts.last, RELEASE_WITH_FAULTS)
        for other in self._faulted.keys() - {name}:
            bounds[f"the fault of {other}"] = (self._faulted[other], TOGETHER)
        for what, (since, bound) in bounds.items():
            if now - since > bound:
                self.violate(f"{name} plays at {level:.4f} {now - since:.4f} s after {what}")
