"""One amplifier of protocol 3, whatever its wire: who it is, and its requests."""

import asyncio
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers import clock
from drivers.contents import Layer
from drivers.errors import CommandError, CommandRefused, DriverError, LinkDegraded, LinkError
from drivers.host.comparison import MAX_CONTRADICTIONS, name_of, problem_of
from drivers.host.feeding import Feeding
from drivers.host.ledger import Ledger
from drivers.host.line import Line, Priority
from drivers.protocol.definition import is_newer_token
from drivers.protocol.records import Values
from drivers.protocol.serial_payload import speaks
from drivers.protocol.sets import LayerSet, pack_layers, parts
from drivers.protocol.table import FAULTS, MESSAGES, QUANTITIES, STATES, VERSION
from registry.limits import GuardLimits

WATCHDOG = 0.25  # s; five heartbeats of 50 ms
STOP_RAMP = 0.005  # s; the shortest without a step
DISARM_RAMP = 0.05  # s; long enough to avoid a click
OPEN_TIMEOUT = 0.5  # s; for boards that restart when their port is opened
CONFIRM_TIMEOUT = 0.3  # s; three replies of the slowest wire
LISTENING = 0.3  # s; to an amplifier that is found armed
_INTERVAL = 0.005  # s; between attempts to stop, in addition to the ramp
_RAMP, _WATCHDOG = QUANTITIES["ramp"], QUANTITIES["watchdog"]
_ENABLED = STATES["OPERATION_ENABLED"]
_LATCHED = tuple(STATES[name] for name in ("QUICK_STOP_ACTIVE", "FAULT_REACTION_ACTIVE", "FAULT"))
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
    """A set that an amplifier has staged: as the wire has it; is_exact: to the word."""

    token: int
    layers: tuple[LayerSet, ...]
    is_exact: bool


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
        identity = await self._request("Hello", {}, Priority.OTHER, timeout=OPEN_TIMEOUT)
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

    async def stage(self, token: int, layers: Sequence[Layer]) -> Staged:
        """Stage a set under a token, admitted by the ledger when its turn on the line has come.

        Raises CommandRefused with the reason; Preempted where a stop came first.
        """
        cuts: list[Values] = []

        def first() -> tuple[str, Values]:
            admitted = self.ledger.admit(layers, clock.now())
            stream = pack_layers(admitted)
            if len(stream) > self.capabilities["set_words"]:
                max_words = self.capabilities["set_words"]
                raise CommandRefused(
                    f"a set must have at most {max_words} words, got {len(stream)}"
                )
            cuts[:] = parts(stream, session=self.session, token=token, now=False)
            self._admitted = Staged(token, admitted, is_exact=True)
            return "Set", cuts[0]

        priority = (
            Priority.SET
            if any(layer.tones or layer.renew for layer in layers)
            else (Priority.SILENCE)
        )
        taken = await self.line.submit(self, priority, first)
        for part in cuts[1:]:
            taken = await self._request("Set", part, priority)
        staged = self._admitted
        if staged is None or staged.token != token or not (taken["staged"] or taken["played"]):
            raise CommandRefused(f"amplifier {self.name}: set {token} was not staged")
        self._admitted = Staged(token, staged.layers, is_exact=bool(taken["exact"]))
        return self._admitted

    async def commit(self, token: int) -> Values:
        """Play the staged set; returns the status, which shows its tokens."""
        values = {"session": self.session, "token": token}
        return await self._request("Commit", values, Priority.SET)

    async def silence(self, ramp: float) -> Values:
        """Let all layers fall silent along a ramp [s]; it stays armed."""
        values = {"session": self.session, "ramp": _RAMP.to_wire(ramp)}
        return await self._request("Silence", values, Priority.SILENCE)

    async def disarm(self, ramp: float = DISARM_RAMP) -> Values:
        """Ramp [s] to silence, then switch the high voltage off."""
        return await self._request("Disarm", {"ramp": _RAMP.to_wire(ramp)}, Priority.SILENCE)

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

    async def read_status(self) -> Values:
        """Read the status, which feeds nothing."""
        return await self._request("GetStatus", {}, Priority.OTHER)

    async def clear(self, latch: int | None = None) -> Values:
        """Acknowledge the stop or fault with this latch, None for the last one."""
        if latch is None:
            latch = (await self.read_status())["latch"]
        return await self._request("Clear", {"latch": latch}, Priority.CLEAR)

    async def stop(self, ramp: float = STOP_RAMP, *, timeout: float = CONFIRM_TIMEOUT) -> Stopped:
        """Stop along a ramp [s], latched; repeated until it is confirmed, or for a time [s].

        Confirmed by a status in a latched state whose latch is newer than every one seen before,
        with the levels of all channels at zero: another one may be old, kept on its way.
        """
        cause = ""
        try:
            async with asyncio.timeout(timeout):
                while True:
                    before = self.latch
                    try:
                        values = {"ramp": _RAMP.to_wire(ramp)}
                        status = await self._request("Stop", values, Priority.STOP)
                        while is_stopping(status, before):
                            if self._is_silent(status):
                                return Stopped(True, clock.now())
                            await asyncio.sleep(_INTERVAL)
                            status = await self.read_status()
                    except DriverError as error:
                        cause = str(error)
                    await asyncio.sleep(ramp + _INTERVAL)
        except TimeoutError:
            cause = cause or f"silence was not reported within {timeout:g} s"
        return Stopped(False, self.feeding.may_play_until, cause)

    def note_sent(self, name: str, values: Values, now: float) -> None:
        """Note a request that may have reached it."""
        message = MESSAGES.get(name)
        if message is None:
            return
        if message.feeds and (name == "Arm" or values["session"] == self.session):
            self.feeding.may = now
        admitted = self._admitted
        if name == "Commit" and admitted is not None and values["token"] == admitted.token:
            self.ledger.sent(admitted.token, admitted.layers, now)
            self._admitted = None

    def note_heard(self) -> None:
        """Note that it has replied, whatever."""
        self.silence_cause = None

    def note_silence(self, cause: str) -> None:
        """Note that it has not replied to all attempts of a request."""
        self.silence_cause = cause

    def note_event(self, values: Values) -> None:
        """Hand an event on."""
        for listener in self.listeners:
            listener(values)

    def note_other_host(self) -> None:
        """Note that another host drives it: it must feed the watchdog within its longest time."""
        self._other_host_at = clock.now()

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
        self, name: str, values: Values, priority: Priority, *, timeout: float = 0.03
    ) -> Values:
        sent_at = 0.0

        def make() -> tuple[str, Values]:
            nonlocal sent_at
            sent_at = clock.now()
            return name, values

        reply = await self.line.submit(self, priority, make, timeout=timeout)
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
        self._ledger.resolve(status["token"], now)
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
