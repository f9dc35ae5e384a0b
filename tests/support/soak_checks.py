"""What must hold of every soak run whatever fails, by what the simulated amplifiers really play.

All else is the witness's, which excuses wires with faults. Bounds are what the fault table and the
timeouts of a link add up to.
"""

import asyncio
import math
from collections.abc import Callable

from drivers.protocol.records import Values
from drivers.protocol.table import MESSAGES, STATES
from sim.amplifier.contract import Amplifier
from sim.bench.bench import Bench
from soak_contacts import SourceContacts

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
        if self._plays() and self._next.when() > now + STEP:
            self._watch()

    def close(self) -> None:
        """Stop checking."""
        self._next.cancel()

    def _watch(self) -> None:
        """Check periodically, more often while a channel vibrates."""
        self._next.cancel()
        self.check()
        self._next = self._loop.call_later(STEP if self._plays() else IDLE_STEP, self._watch)

    def _plays(self) -> bool:
        now = self._loop.time()
        return any(
            tone.silent_from > now
            for amplifier in self._bench.amplifiers.values()
            for output in amplifier.outputs
            for tone in output
        )

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
