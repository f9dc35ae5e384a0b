"""One amplifier of protocol 3, whatever its wire: who it is, and its requests."""

import asyncio
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from drivers import clock
from drivers.contents import Layer
from drivers.errors import (
    CommandError,
    CommandRefused,
    LinkDegraded,
    LinkError,
    LinkTimeout,
    Preempted,
)
from drivers.guard.budget import COMMIT_DELAY
from drivers.host.comparison import MAX_CONTRADICTIONS, name_of, problem_of
from drivers.host.feeding import Feeding
from drivers.host.jobs import Priority
from drivers.host.joint_start import JointStart
from drivers.host.ledger import Ledger
from drivers.host.line import ATTEMPTS, REPLY_TIMEOUT, Line
from drivers.protocol.definition import is_newer_token
from drivers.protocol.records import Values
from drivers.protocol.serial_payload import speaks
from drivers.protocol.sets import LayerSet, pack_layers, parts
from drivers.protocol.table import FAULTS, MAX_WORDS, MESSAGES, QUANTITIES, STATES, VERSION
from registry.limits import GuardLimits

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
STOP_RAMP = 0.005  # s; the shortest without a step
DISARM_RAMP = 0.05  # s; long enough to avoid a click
OPEN_TIMEOUT = 0.5  # s; for boards that restart when their port is opened
CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire
_SECOND_REPLY = 0.02  # s; for one of another amplifier at the same address
LISTENING = 0.3  # s; to an amplifier that is found armed
_INTERVAL = 0.005  # s; between attempts to stop, in addition to the ramp
_RAMP, _WATCHDOG = QUANTITIES["ramp"], QUANTITIES["watchdog"]
_ENABLED = STATES["OPERATION_ENABLED"]
_LATCHED = tuple(STATES[name] for name in ("QUICK_STOP_ACTIVE", "FAULT_REACTION_ACTIVE", "FAULT"))
PART_BYTES = 2 * MAX_WORDS
"""Of the longest part of a set."""
_logger = logging.getLogger(__name__)
_POSITIVE = ("frequency_step", "level_step", "phase_step")


@dataclass(frozen=True, slots=True)
class Stopped:
    """What became of a stop: confirmed silent, or until when [s] it may play, and why.

    may_play_until: infinite without a watchdog that is known.
    """

    is_confirmed: bool
    may_play_until: float
    cause: str = ""


@dataclass(frozen=True, slots=True)
class Staged:
    """A set that an amplifier has staged, or plays at once: as the wire has it.

    is_exact: to the word; until: when [s] it must have been committed.
    """

    token: int
    layers: tuple[LayerSet, ...]
    is_exact: bool
    until: float


class Amplifier:
    """An amplifier on a line that is open; a `Member` of it.

    limits: configured. serial_number: the expected one, None for any.
    """

    def __init__(
        self,
        line: Line,
        address: int,
        limits: GuardLimits,
        *,
        name: str,
        serial_number: str | None = None,
    ) -> None:
        self.line, self.address, self.name = line, address, name
        self.limits, self._serial_number = limits, serial_number
        self.identity: Values = {}
        self.capabilities: Values = {}
        self.session = 0
        self.latch: int | None = None
        """Newest latch that a status has shown."""
        self.status: Values | None = None
        """The last one."""
        self.feeding = Feeding()
        self.silence_cause: str | None = None
        """Why it is degraded: it did not reply to a request, and may still play."""
        self.listeners: list[Callable[[Values], None]] = []
        self._ledger: Ledger | None = None
        self._admitted: Staged | None = None
        self._contradictions = 0
        self._other_host_at = -math.inf  # when it was heard last
        self._are_several = False
        line.members[address] = self

    @property
    def ledger(self) -> Ledger:
        """Its ledger, known once it is identified."""
        if self._ledger is None:
            raise CommandError(f"amplifier {self.name} must be opened first")
        return self._ledger

    async def open(self) -> None:
        """Identify it and leave it disarmed; a latched stop or fault stays.

        Raises LinkError for another amplifier or version, or another host that drives it.
        """
        await self.identify()
        status = await self.read_status()
        if status["state"] == _ENABLED:
            await self._listen_for_another_host(status)
            await self.disarm(STOP_RAMP)

    async def identify(self) -> None:
        """Read identity and capabilities; raises LinkError."""
        self._are_several = False
        try:
            identity = await self._request("Hello", {}, Priority.OTHER, timeout=OPEN_TIMEOUT)
            await asyncio.sleep(_SECOND_REPLY)
        except LinkTimeout:
            self._check_alone()
            raise
        self._check_alone()
        if not speaks(identity, VERSION):
            spoken = [str(version) for version in range(16) if speaks(identity, version)]
            raise LinkError(
                f"amplifier {self.name} speaks protocol {', '.join(spoken) or 'none'}, needs "
                f"{VERSION}; update it"
            )
        serial = identity["serial_number"]
        if self._serial_number not in (None, serial):
            raise LinkError(
                f"amplifier {self.name}: serial number must be {self._serial_number}, got {serial}"
                "; connect the expected amplifier, or restart with this one"
            )
        can = await self._request("GetCaps", {}, Priority.OTHER, timeout=OPEN_TIMEOUT)
        for name in _POSITIVE:
            if not can[name] > 0:
                raise LinkError(f"amplifier {self.name}: {name} must be above 0, got {can[name]}")
        if can["watchdog_min"] > can["watchdog_max"]:
            raise LinkError(f"amplifier {self.name}: watchdog_min must be below watchdog_max")
        self._ledger = Ledger(self.limits, can)
        self.identity, self.capabilities, self._serial_number = identity, can, serial

    def _check_alone(self) -> None:
        """Raise LinkError where several replied."""
        if self._are_several:
            raise LinkError(
                f"amplifier {self.name}: several amplifiers reply at address {self.address} on "
                f"{self.line.name}; give each its own: era amp address --serial-number"
            )

    async def arm(self, session: int, watchdog: float = WATCHDOG) -> Values:
        """Switch the high voltage on at level zero; watchdog [s]. Returns the status."""
        wire = _WATCHDOG.to_wire(watchdog)
        low, high = (self.capabilities[f"watchdog_{end}"] for end in ("min", "max"))
        if not low <= wire <= high:
            bounds = f"{_WATCHDOG.from_wire(low):g} to {_WATCHDOG.from_wire(high):g}"
            raise CommandError(f"watchdog must be {bounds} s, got {watchdog:g} s")
        self.feeding.watchdog = max(self.feeding.watchdog, watchdog)
        values = {"session": session, "watchdog": wire}
        status = await self._request("Arm", values, Priority.ARM)
        self.session, self.feeding.watchdog = session, watchdog
        self._contradictions = 0
        self.ledger.forget()
        return status

    async def stage(self, token: int, layers: Sequence[Layer], *, now: bool = False) -> Staged:
        """Stage a set under a token, or play it at once.

        It is admitted by the ledger when its turn on the line has come. Raises CommandRefused with
        the reason; Preempted where a stop came first.
        """
        cuts: list[Values] = []

        def first() -> tuple[str, Values]:
            if not cuts:
                moment = clock.now()
                admitted = self.ledger.admit(layers, moment, delay=self._commit_delay)
                stream = pack_layers(admitted)
                if len(stream) > self.capabilities["set_words"]:
                    limit = self.capabilities["set_words"]
                    text = f"a set must have at most {limit} words, got {len(stream)}"
                    raise CommandRefused(text)
                cuts[:] = parts(stream, session=self.session, token=token, now=now)
                until = moment + self._commit_delay
                self._admitted = Staged(token, admitted, is_exact=True, until=until)
            return "Set", cuts[0]

        is_silent = not any(layer.tones or layer.renew for layer in layers)
        priority = Priority.SILENCE if is_silent else Priority.SET
        taken = await self.line.submit(self, priority, first)
        for part in cuts[1:]:
            taken = await self.line.submit(self, priority, self._made("Set", part, token))
        staged = self._admitted
        if staged is None or staged.token != token or not (taken["staged"] or taken["played"]):
            raise Preempted(f"amplifier {self.name}: set {token} was not staged")
        if taken["played"]:
            self._confirm(token)
        return replace(staged, is_exact=bool(taken["exact"]))

    async def commit(self, token: int, *, start: JointStart | None = None) -> Values:
        """Play the staged set; returns the status, which shows its tokens.

        start: together with the commits of other lines.
        Raises Preempted where a stop or disarm came first, CommandRefused where it is too late for
        what the ledger has admitted.
        """
        values = {"session": self.session, "token": token}
        make = self._made("Commit", values, token)
        return await self._request("Commit", values, Priority.SET, make=make, start=start)

    def _made(self, name: str, values: Values, token: int) -> Callable[[], tuple[str, Values]]:
        """Return what makes a request of the set that is admitted, as long as it is."""

        def make() -> tuple[str, Values]:
            self.check_admitted(token)
            return name, values

        return make

    def check_admitted(self, token: int) -> None:
        """Raise Preempted or CommandRefused unless a set may be played now."""
        admitted = self._admitted
        if admitted is None or admitted.token != token:
            raise Preempted(f"amplifier {self.name}: a stop, disarm or newer set came first")
        if clock.now() > admitted.until:
            raise CommandRefused(
                f"amplifier {self.name}: set {token} must be committed within "
                f"{self._commit_delay:.3g} s; the wire is too slow or too busy"
            )

    @property
    def _commit_delay(self) -> float:
        """Longest time [s] from the admission of a set until it is committed."""
        waiting = len(self.line.members) * self.line.wire.round_trip("Set", PART_BYTES)
        return max(COMMIT_DELAY, ATTEMPTS * waiting)

    def _confirm(self, token: int) -> None:
        """Note that the amplifier plays the set with this token, as it says."""
        self.ledger.resolve(token, clock.now())
        if self._admitted is not None and self._admitted.token == token:
            self._admitted = None

    async def silence(self, ramp: float) -> Values:
        """Let all layers fall silent along a ramp [s]; it stays armed."""
        values = {"session": self.session, "ramp": self.wire_ramp(ramp)}
        return await self._request("Silence", values, Priority.SILENCE)

    async def disarm(self, ramp: float = DISARM_RAMP) -> None:
        """Ramp [s] to silence, then switch the high voltage off; read back until it is silent.

        Raises CommandRefused if it is not silent soon after the ramp, or still armed.
        """
        status = await self._request("Disarm", {"ramp": self.wire_ramp(ramp)}, Priority.SILENCE)
        end = clock.now() + ramp + CONFIRM_TIMEOUT
        while status["state"] == _ENABLED or not self._is_silent(status):
            if clock.now() > end or status["state"] == _ENABLED:
                raise CommandRefused(f"amplifier {self.name} is not silent after a disarm")
            await asyncio.sleep(_INTERVAL)
            status = await self.read_status(Priority.SILENCE)

    async def ping(self) -> Values:
        """Feed the watchdog; returns the status. Raises CommandRefused if it is not armed."""
        status = await self._request("Ping", {"session": self.session}, Priority.HEARTBEAT)
        if status["state"] != _ENABLED:
            fault = name_of(FAULTS, status["fault"])
            raise CommandRefused(
                f"amplifier {self.name} is no longer armed, fault {fault}; once the cause is gone, "
                "clear and arm again"
            )
        return status

    async def read_status(self, priority: Priority = Priority.OTHER) -> Values:
        """Read the status, which feeds nothing."""
        return await self._request("GetStatus", {}, priority)

    async def clear(self, latch: int | None = None) -> Values:
        """Acknowledge the stop or fault with this latch, None for the newest that was shown."""
        if latch is None:
            latch = (await self.read_status())["latch"] if self.latch is None else self.latch
        return await self._request("Clear", {"latch": latch}, Priority.CLEAR)

    async def stop(self, ramp: float = STOP_RAMP, *, timeout: float = CONFIRM_TIMEOUT) -> Stopped:
        """Stop along a ramp [s], latched; repeated until it is confirmed, or for a time [s].

        The time counts from when the first is sent. Confirmed by a status in a latched state whose
        latch is newer than every one seen before, with the levels of all channels at zero: another
        one may be old, kept on its way.
        """
        cause, is_sent = "", False
        values = {"ramp": self.wire_ramp(ramp)}
        members = len(self.line.members)
        # On a line that others share each has three exchanges: a stop and two statuses.
        timeout += ATTEMPTS * members * self.line.wire.round_trip("GetStatus", PART_BYTES // 4)
        waiting = timeout * (members + 1)  # on a line that others keep busy
        try:
            async with asyncio.timeout(waiting) as limit:

                def make() -> tuple[str, Values]:
                    nonlocal is_sent
                    if not is_sent:
                        limit.reschedule(asyncio.get_running_loop().time() + timeout)
                    is_sent = True
                    return "Stop", values

                while True:
                    before = self.latch
                    try:
                        status = await self._request("Stop", values, Priority.STOP, make=make)
                        while is_stopping(status, before):
                            if self._is_silent(status):
                                return Stopped(True, clock.now())
                            await asyncio.sleep(_INTERVAL)
                            status = await self.read_status(Priority.STOP)
                    except Exception as error:  # whatever it is, the stop goes on
                        cause = str(error) or type(error).__name__
                    await asyncio.sleep(_RAMP.from_wire(values["ramp"]) + _INTERVAL)
        except TimeoutError:
            cause = cause or f"silence was not reported within {timeout:g} s"
        return Stopped(False, self.feeding.may_play_until, cause)

    def wire_ramp(self, ramp: float) -> int:
        """Return the nearest ramp that the amplifier has: silence is never refused for it."""
        highest = self.capabilities.get("ramp_max", _RAMP.maximum)
        if math.isnan(ramp):
            return _RAMP.to_wire(STOP_RAMP)
        return min(_RAMP.to_wire(min(max(ramp, 0.0), _RAMP.high)), int(highest))

    def note_sent(self, name: str, values: Values, now: float) -> None:
        """Note a request that may have reached it."""
        message = MESSAGES.get(name)
        if message is None:
            return
        if message.feeds and (name == "Arm" or values["session"] == self.session):
            self.feeding.may = now
        admitted = self._admitted
        if message.name in ("Stop", "Disarm", "Silence", "Arm"):
            self._admitted = None
        elif admitted is not None and values.get("token") == admitted.token:
            is_last = name == "Set" and values["now"] and values["index"] == values["parts"] - 1
            if name == "Commit" or is_last:
                self.ledger.sent(admitted.token, admitted.layers, now)

    def note_heard(self) -> None:
        """Note that it has replied, whatever."""
        self.silence_cause = None

    def note_silence(self, cause: str) -> None:
        """Note that it has not replied to all attempts of a request."""
        self.silence_cause = cause

    def note_event(self, values: Values) -> None:
        """Hand an event on."""
        for listener in self.listeners:
            try:
                listener(values)
            except Exception:
                _logger.exception("amplifier %s: a listener failed", self.name)

    def note_other_host(self) -> None:
        """Note that another host drives it: it must feed the watchdog within its longest time."""
        self._other_host_at = clock.now()

    def note_several(self) -> None:
        """Note that others have its address too; `identify` says so."""
        self._are_several = True

    def check_other_host(self) -> None:
        """Raise LinkError if another host drives it."""
        if clock.now() - self._other_host_at <= _WATCHDOG.high:
            raise self._driven_by_another()

    def check_request(self, name: str) -> None:
        """Raise LinkError for what plays or feeds, while degraded or beside another host."""
        message = MESSAGES.get(name)
        if message is None or not message.feeds:
            return
        self.check_other_host()
        if self.silence_cause is not None:
            raise LinkDegraded(
                f"{self.silence_cause}. The amplifier may play its last set until its watchdog has "
                "passed; nothing new is played until it replies"
            )

    async def _request(
        self,
        name: str,
        values: Values,
        priority: Priority,
        *,
        timeout: float = REPLY_TIMEOUT,
        make: Callable[[], tuple[str, Values]] | None = None,
        start: JointStart | None = None,
    ) -> Values:
        """Send a request, and note the status that its reply may be; make: of each attempt."""
        sent_at = 0.0

        def made() -> tuple[str, Values]:
            nonlocal sent_at
            sent_at = clock.now()
            return (name, values) if make is None else make()

        reply = await self.line.submit(self, priority, made, timeout=timeout, start=start)
        if name == "Hello" or MESSAGES[name].reply is not MESSAGES["GetStatus"].reply:
            return reply
        self._note_status(name, values, reply, sent_at)
        return reply

    def _note_status(self, name: str, values: Values, status: Values, sent_at: float) -> None:
        """Note a status; raises CommandRefused once it contradicts what was sent twice."""
        now = clock.now()
        if self.latch is None or is_newer_token(status["latch"], self.latch):
            self.latch = status["latch"]
        self.status = status
        if self._ledger is None:
            return
        if name in ("Stop", "Disarm", "Silence"):
            self._ledger.silenced(_RAMP.from_wire(values["ramp"]), sent_at, now)
            return
        self._confirm(status["token"])
        fed = name != "Arm" and MESSAGES[name].feeds
        if fed or name == "Arm":
            self.feeding.since = sent_at
        if not self.session or name in ("Arm", "Clear") or status["state"] != _ENABLED:
            return
        problem = problem_of(status, self._ledger, self.feeding, sent_at=sent_at, now=now, fed=fed)
        self._contradictions = 0 if problem is None else self._contradictions + 1
        if problem is not None and self._contradictions >= MAX_CONTRADICTIONS:
            raise CommandRefused(
                f"amplifier {self.name} contradicts its requests: {problem}; look for a derated or "
                "broken channel, an exchanged cable or firmware, then clear and arm again"
            )

    def _is_silent(self, status: Values) -> bool:
        """Whether a status has the levels of all channels, and all are zero."""
        known = self.capabilities.get("channels")
        return known == len(status["levels"]) and not any(status["levels"])

    async def _listen_for_another_host(self, status: Values) -> None:
        """Wait for a watchdog that rises unasked; raises LinkError."""
        end = clock.now() + LISTENING
        left = status["watchdog_left"]
        while clock.now() < end and status["state"] == _ENABLED:
            await asyncio.sleep(LISTENING / 10)
            status = await self.read_status()
            self.check_other_host()
            if status["watchdog_left"] > left:
                raise self._driven_by_another()
            left = status["watchdog_left"]

    def _driven_by_another(self) -> LinkError:
        return LinkError(f"amplifier {self.name} is driven by another host; end that one first")


def is_stopping(status: Values, before: int | None) -> bool:
    """Whether a status shows that a stop was carried out since a latch was the newest."""
    if before is None or status["state"] not in _LATCHED:
        return False
    return status["latch"] > 0 and is_newer_token(status["latch"], before)
