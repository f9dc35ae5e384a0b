"""The amplifier that is judged: requests by name, sets for it, and levels read back in time."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers import clock
from drivers.conformance.client import Answer, Client, When
from drivers.conformance.expected import Bounds, alone, steady, within
from drivers.conformance.findings import Late, Optional, Violation, expect, expect_equal
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import Command, Envelope, LayerSet, pack_layers, parts
from drivers.protocol.table import MESSAGES, QUANTITIES, STATES, STATUS_FLAGS, has_feature

LEVEL = 0.2
"""Level of driven channels unless another is given: perceptible, and far from any limit."""
SLACK = 0.002  # s; of times in milliseconds
DRIFT = 1e-3  # of a time; of the amplifier's clock
FULL = QUANTITIES["level"].per_unit
NAMES = {number: name for name, number in STATES.items()}
_SAMPLES, _EACH = 12, 0.02  # of a transition; s for which one must be in time
_NARROW = 0.006  # s; of the uncertainty of a sample, beyond two exchanges
_SETTLED = 1.2  # s; the longest ramp, and what a state may take
_TOLERANCE = 0.002  # of full level
_MAX_WATCHDOG_USE = 0.8
MAX_ATTEMPTS = 10
"""Of a check, or a case of one, for which this machine was late."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Values of a reply, and when the request was carried out."""

    values: Values
    when: When

    def __getitem__(self, name: str) -> Any:
        """Return a value."""
        return self.values[name]


class Subject:
    """An identified amplifier at the far end of a client; level: of driven channels, at most."""

    def __init__(self, client: Client, identity: Values, can: Values, level: float) -> None:
        self.client, self.identity, self.can = client, identity, can
        self.channels = range(can["channels"])
        self.layers = range(can["layers"])
        limits = can["limits"]
        low = max(can["frequency_min"], *(one["frequency_min"] for one in limits))
        high = min(can["frequency_max"], *(one["frequency_max"] for one in limits))
        self.lowest, self.highest = low, high  # on every channel
        self.frequency = min(max(QUANTITIES["frequency"].to_wire(110.0), low), high)
        self.other = next(each for each in (self.frequency + 800, low, high) if each <= high)
        self.level = min(
            level, can["level_max"] / FULL, *(one["level_max"] / FULL for one in limits)
        )
        self.session = self.token = self.latch = 0
        self.watchdog = 0.0
        self.exchange_time = math.inf
        self.fed: When | None = None  # when the watchdog was fed last; None: it may expire
        channels, layers = can["channels"], can["layers"]
        rows = {"GetStatus": 9 + channels + layers, "GetAchieved": 4 + 4 * channels}
        rows |= dict.fromkeys(_STATUSES, rows["GetStatus"])
        rows |= {"Set": 3, "GetCaps": 18 + 3 * channels, "GetMeasured": 1 + 2 * channels}
        client.reply_words = {MESSAGES[name].number: words for name, words in rows.items()}

    # Requests

    async def answer(self, name: str, values: Mapping[str, object]) -> Answer:
        """Send a request and return what became of it."""
        return await self.answer_to(name, MESSAGES[name].request.pack(values))

    async def answer_to(self, name: str, words: Sequence[int]) -> Answer:
        """Send a request with these words."""
        self.check_fed()
        answer = await self.client.exchange(MESSAGES[name].number, words)
        self.check_fed()  # or it may have been carried out after the watchdog
        took = answer.when.latest - answer.when.earliest
        self.exchange_time = min(self.exchange_time, took)
        return answer

    async def request(self, name: str, **values: object) -> Reply:
        """Send a request that must be carried out."""
        answer = await self.answer(name, values)
        if answer.code:
            where = "" if answer.channel is None else f" of channel {answer.channel}"
            what = f"{name} {_brief(values)}"
            raise Violation(what, expected="carried out", seen=answer.code + where)
        if name in ("Stop", "Disarm"):
            self.starve()
        elif MESSAGES[name].feeds and self.fed is not None:
            self.fed = answer.when
        return self.read(name, answer)

    def read(self, name: str, answer: Answer) -> Reply:
        """Read the words of a reply."""
        try:
            values = MESSAGES[name].reply.unpack(answer.words, is_strict=False)
        except Refusal as error:
            raise Violation(f"reply to {name}", expected="as in the table", seen=error) from None
        if "levels" in values:
            expect_equal(values["channels"], len(self.channels), "number of levels in Status")
            expect_equal(values["layers"], len(self.layers), "number of layers in Status")
            self.latch = values["latch"]
        return Reply(values, answer.when)

    async def refused(
        self, code: str | Sequence[str], name: str, *, channel: int | None = None, **values: object
    ) -> None:
        """Require that a request is refused with a code, which names a channel or none."""
        words = MESSAGES[name].request.pack(values)
        what = f"{name} {_brief(values)}"
        await self.refused_words(code, name, words, channel=channel, what=what)

    async def refused_words(
        self,
        code: str | Sequence[str],
        name: str,
        words: Sequence[int],
        *,
        what: str,
        channel: int | None = None,
    ) -> None:
        """Require that these words are refused."""
        codes = (code,) if isinstance(code, str) else code
        answer = await self.answer_to(name, words)
        seen = answer.code or "carried out"
        expect(answer.code in codes, what, expected=f"refused with {' or '.join(codes)}", seen=seen)
        if self.client.kind not in ("rtu", "tcp") or answer.code not in (
            "UNKNOWN_TYPE",
            "BAD_LENGTH",
        ):
            expect_equal(answer.channel, channel, f"channel of the refusal of {what}")

    async def status(self) -> Reply:
        """Read the status; feeds the watchdog where that is due."""
        if self._is_hungry:
            return await self.request("Ping", session=self.session)
        return await self.request("GetStatus")

    async def arm(self, watchdog: float = 2.0) -> Reply:
        """Arm under a new session with a watchdog [s], or the nearest that is possible."""
        self.session = self.client.session = self.client.session % 0xFFFF + 1
        low, high = self.can["watchdog_min"], self.can["watchdog_max"]
        milliseconds = min(max(round(1000 * watchdog), low), high)
        self.watchdog = milliseconds / 1000
        reply = await self.request("Arm", session=self.session, watchdog=milliseconds)
        expect_equal(NAMES[reply.values["state"]], "OPERATION_ENABLED", "state after Arm")
        self.fed, self.token = reply.when, 0
        return reply

    @property
    def other_session(self) -> int:
        """A session that is not the one that is held."""
        return (self.session + 0x54) % 0xFFFF + 1

    def check_fed(self) -> None:
        """Raise Late where this machine may have starved the watchdog."""
        if self._since_fed > self.watchdog * _MAX_WATCHDOG_USE:
            raise Late("the watchdog was not fed in time")

    @property
    def _since_fed(self) -> float:
        return 0.0 if self.fed is None else clock.now() - self.fed.earliest

    @property
    def _is_hungry(self) -> bool:
        return self._since_fed > self.watchdog / 4

    def starve(self) -> None:
        """From now on the watchdog may expire."""
        self.fed = None

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched."""
        self.starve()
        await self.request("Stop", ramp=0)
        _, status = await self.until(is_silent, "silence after a Stop with ramp 0")
        await self.request("Clear", latch=status["latch"])
        status = (await self.request("GetStatus")).values
        expect_equal(NAMES[status["state"]], "SWITCH_ON_DISABLED", "state after Clear")

    def has(self, feature: str) -> bool:
        """Whether it states a feature."""
        return has_feature(self.can, feature)

    def require(self, feature: str) -> None:
        """Raise Optional without a feature."""
        if not self.has(feature):
            raise Optional(f"it states no {feature}")

    # Sets

    def tone(
        self,
        channel: int = 0,
        fraction: float = 1.0,
        phase: float = 0.0,
        *,
        frequency: int = 0,
        keep: bool = False,
        skip: bool = False,
        onset: Envelope | None = None,
        ending: Envelope | None = None,
    ) -> Command:
        """Make a command at a fraction of the test level; frequency in steps, 0 for the usual."""
        return Command(
            channel,
            frequency or self.frequency,
            round(fraction * self.level * FULL),
            QUANTITIES["phase"].to_wire(phase),
            *(keep, skip, onset, ending),
        )

    def envelope(self, step: float, *amplitudes: complex) -> Envelope:
        """Make an envelope of knots in fractions of the test level, or the nearest step [s]."""
        low, high = self.can["envelope_step_min"], self.can["envelope_step_max"]
        steps = min(max(QUANTITIES["envelope_step"].to_wire(step), low), high)
        knots = [
            (
                round(abs(each) * self.level * FULL),
                QUANTITIES["phase"].to_wire(math.degrees(math.atan2(each.imag, each.real))),
            )
            for each in amplitudes
        ]
        return Envelope(steps, tuple(knots))

    def apart(self, number: int) -> int:
        """Return a frequency of a layer of its own, so that layers do not interfere."""
        return int(min(self.frequency + 40 * number, self.highest - len(self.layers) + number))

    def next_token(self) -> int:
        """Return the next token."""
        self.token = self.token % 0xFFFF + 1
        return self.token

    def parts(self, *layers: LayerSet, token: int | None = None, now: bool = True) -> list[Values]:
        """Make the parts of a set; token: None for the next."""
        token = self.next_token() if token is None else token
        return [*parts(pack_layers(layers), session=self.session, token=token, now=now)]

    async def play(self, *layers: LayerSet, token: int | None = None) -> When:
        """Play a set at once; returns when it was committed."""
        taken = None
        for part in self.parts(*layers, token=token):
            taken = await self.request("Set", **part)
        assert taken is not None  # noqa: S101  a set has a part
        expect_equal((taken["played"], taken["staged"]), (1, 0), "played, staged of a set")
        return taken.when

    async def stage(self, *layers: LayerSet, token: int | None = None) -> int:
        """Stage a set; returns its token."""
        made = self.parts(*layers, token=token, now=False)
        for part in made:
            taken = await self.request("Set", **part)
        expect_equal((taken["played"], taken["staged"]), (0, 1), "played, staged of a staged set")
        return int(made[0]["token"])

    async def commit(self, token: int) -> Reply:
        """Commit a staged set."""
        return await self.request("Commit", session=self.session, token=token)

    # Expectations

    @property
    def ramp(self) -> int:
        """A ramp [ms] that is long against an exchange."""
        required = max(200, math.ceil(30_000 * min(self.exchange_time, 0.03)))
        return int(min(required, self.can["ramp_max"]))

    @property
    def tolerance(self) -> float:
        """Of a level: two steps, or 0.002 of full level if that is more."""
        return float(max(2 * self.can["level_step"] / FULL, _TOLERANCE))

    async def pause_until(self, time: float) -> None:
        """Wait until a time [s], feeding the watchdog."""
        while (left := time - clock.now()) > 0:
            if self._is_hungry:
                await self.request("Ping", session=self.session)
                continue
            await asyncio.sleep(min(left, self.watchdog / 8 or left))

    async def until(
        self,
        is_met: Callable[[Values], bool],
        what: str,
        *,
        timeout: float = _SETTLED,
        pause: float = 0.0005,
    ) -> tuple[When, Values]:
        """Read statuses until one is as required; returns when that became so, and the status.

        The earliest time is unknown, minus infinity, where the first status is as required.
        """
        earliest, due = -math.inf, clock.now() + timeout
        while True:
            reply = await self.status()
            if is_met(reply.values):
                return When(earliest, reply.when.latest), reply.values
            earliest = reply.when.earliest
            expect(clock.now() < due, what, expected=f"within {timeout:g} s", seen=_shown(reply))
            await asyncio.sleep(pause)

    async def in_time(self, case: Callable[[], Awaitable[None]]) -> None:
        """Try a case until this machine was in time, from rest; raises Late in the end."""
        for _ in range(MAX_ATTEMPTS - 1):
            try:
                return await case()
            except Late:
                await self.rest()
        await case()
        return None

    async def expect_not_fed(self, by: str) -> None:
        """Require that the watchdog was not fed by something since it was fed last."""
        assert self.fed is not None  # noqa: S101
        reply = await self.request("GetStatus")
        high = self.watchdog - (reply.when.earliest - self.fed.latest) + SLACK
        left, limit = reply["watchdog_left"] / 1000, f"at most {high:.3f} s"
        expect(left <= high, f"watchdog_left after {by}", expected=limit, seen=left)

    async def expect_levels(self, *levels: float, why: str) -> Values:
        """Require the first channels at these fractions of the test level, all others silent."""
        reply = await self.status()
        expected = [level * self.level for level in levels]
        expected += [0.0] * (len(self.channels) - len(expected))
        for channel, level in enumerate(expected):
            self._expect_level(reply.values, channel, level, level, why)
        return reply.values

    async def follow(
        self,
        bounds: Mapping[int, Bounds],
        commit: When,
        duration: float,
        why: str,
        *,
        since: float = 0.0,
    ) -> None:
        """Require levels along curves in fractions of the test level, others silent.

        duration, since [s]: what is followed, from the commit on; raises Late where this machine
        was too slow to see them.
        """
        await self.pause_until(commit.earliest + since)
        end, seen = commit.earliest + duration, 0
        pause = max((duration - since) / (2 * _SAMPLES) - min(self.exchange_time, 1.0), 0.0)
        while clock.now() < end:
            reply = await self.status()
            self.expect_at(reply, bounds, commit, why)
            width = reply.when.latest - reply.when.earliest + commit.latest - commit.earliest
            is_narrow = width <= _NARROW + 2 * self.exchange_time
            seen += is_narrow
            await asyncio.sleep(pause * is_narrow)
        time = duration - since
        if seen < max(min(_SAMPLES / 3, time / _EACH, time / (4 * self.exchange_time)), 2):
            raise Late(f"only {seen} samples of {why} were in time")

    async def course(
        self, bounds: Mapping[int, Bounds], duration: float, why: str, *sets: LayerSet
    ) -> None:
        """Require the levels that follow the last of these sets, from silence on; see `follow`."""

        async def case() -> None:
            await self.rest()
            await self.arm()
            for one in sets:
                started = await self.play(one)
            await self.follow(bounds, started, duration, why)

        await self.in_time(case)

    def expect_at(self, reply: Reply, bounds: Mapping[int, Bounds], commit: When, why: str) -> None:
        """Require the levels of a status that was read in a known interval."""
        earliest = reply.when.earliest - commit.latest
        latest = reply.when.latest - commit.earliest
        for channel in self.channels:
            low, high = within(bounds.get(channel, alone(steady(0j))), earliest, latest)
            text = f"{why}, {1e3 * earliest:.1f} to {1e3 * latest:.1f} ms after it began"
            self._expect_level(reply.values, channel, low * self.level, high * self.level, text)

    def _expect_level(
        self, values: Values, channel: int, low: float, high: float, why: str
    ) -> None:
        level = values["levels"][channel] / FULL
        is_met = low - self.tolerance <= level <= min(high, 1.0) + self.tolerance
        required = f"{low:.4f}" if high - low < 1e-4 else f"{low:.4f} to {high:.4f}"
        expect(is_met, f"level of channel {channel} ({why})", expected=required, seen=level)


_STATUSES = tuple(name for name, each in MESSAGES.items() if "levels" in each.reply.names)


def passed(first: When, second: When) -> tuple[float, float]:
    """Return the least and largest time between two moments [s]."""
    return second.earliest - first.latest, second.latest - first.earliest


def is_silent(status: Values) -> bool:
    """Whether all channels are silent, and the state is one of silence."""
    moving = (STATES["SWITCHED_ON"], STATES["FAULT_REACTION_ACTIVE"])
    return not any(status["levels"]) and status["state"] not in moving


def flag(status: Values, name: str) -> bool:
    """Whether a flag of a status is set."""
    return bool(status["flags"] >> STATUS_FLAGS[name] & 1)


def layer(
    number: int,
    *commands: Command,
    ramp: int = 0,
    valid_for: int = 0,
    after: bool = False,
    renew: bool = False,
) -> LayerSet:
    """Make what one layer is to play; ramp, valid_for in ms."""
    return LayerSet(number, ramp, valid_for, commands, after, renew)


def _brief(values: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in values.items() if name != "stream"}


def _shown(reply: Reply) -> str:
    values = reply.values
    return f"{NAMES.get(values['state'], values['state'])}, levels {values['levels']}"
