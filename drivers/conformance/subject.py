"""The amplifier that is judged: requests by name, each status compared with what it must show."""

import asyncio
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drivers import clock
from drivers.conformance.client import Answer, Client, When
from drivers.conformance.expected import ENABLED, NAMES, OFF, Expected
from drivers.conformance.findings import Late, Optional, Violation, expect, expect_equal
from drivers.conformance.material import Material, layer
from drivers.protocol.records import Refusal, Values
from drivers.protocol.sets import LayerSet, pack_layers, parts
from drivers.protocol.table import MESSAGES, STATES

LEVEL = 0.2
"""Level of driven channels unless another is given: perceptible, and far from any limit."""
MAX_ATTEMPTS = 10
"""Of a check, or a case of one, for which this machine was late."""
_SAMPLES, _EACH = 12, 0.02  # of a transition; s for which one must be in time
_NARROW = 0.006  # s; of the uncertainty of a sample, beyond two exchanges
_SETTLED = 1.2  # s; the longest ramp, and what a state may take
_MAX_WATCHDOG_USE = 0.8
_POLL = 0.0005  # s
_MOVING = STATES["SWITCHED_ON"], STATES["FAULT_REACTION_ACTIVE"]
_STATUSES = [name for name, each in MESSAGES.items() if "levels" in each.reply.names]


@dataclass(frozen=True, slots=True)
class Reply:
    """Values of a reply, and when the request was carried out."""

    values: Values
    when: When

    def __getitem__(self, name: str) -> Any:
        """Return a value."""
        return self.values[name]


class Subject(Material):
    """An identified amplifier at the far end of a client; level: of driven channels, at most.

    expected: what it must show, None until it was brought to rest. token: of the last set made.
    """

    def __init__(self, client: Client, identity: Values, can: Values, level: float) -> None:
        super().__init__(can, level)
        self.client, self.identity = client, identity
        self.session = self.token = 0
        self.expected: Expected | None = None
        self.is_starving = True
        self.exchange_time = math.inf
        self.heard_at = clock.now()
        channels, layers = can["channels"], can["layers"]
        rows = dict.fromkeys(_STATUSES, 9 + channels + layers)
        rows |= {"GetAchieved": 4 + 4 * channels, "Set": 3}
        rows |= {"GetCaps": 18 + 3 * channels, "GetMeasured": 1 + 2 * channels}
        client.reply_words = {MESSAGES[name].number: words for name, words in rows.items()}

    @property
    def shown(self) -> Expected:
        """What it must show."""
        assert self.expected is not None  # noqa: S101
        return self.expected

    # Requests

    async def answer(self, name: str, *words: int, **values: object) -> Answer:
        """Send a request by its words or values and return what became of it."""
        self._check_fed()
        sent = MESSAGES[name].request.pack(values) if values else words
        answer = await self.client.exchange(MESSAGES[name].number, sent)
        self._check_fed()  # or it may have been carried out after the watchdog
        took = answer.when.latest - answer.when.earliest
        self.exchange_time = min(self.exchange_time, took)
        self.heard_at = answer.when.latest
        return answer

    async def request(self, name: str, **values: object) -> Reply:
        """Send a request that must be carried out; its reply must show what is expected."""
        answer = await self.answer(name, **values)
        if answer.code:
            where = "" if answer.channel is None else f" of channel {answer.channel}"
            raise Violation(
                f"{name} {_brief(values)}", expected="carried out", seen=answer.code + where
            )
        reply = Reply(self._read(name, answer.words), answer.when)
        if self.expected is None:
            return reply
        if name == "Set":
            self.expected.taken(values, reply.values, reply.when)
        self.expected.carried_out(name, values, reply.when)
        self.is_starving = self.is_starving or name in ("Stop", "Disarm")
        if name in _STATUSES:
            self.expected.check(reply.values, reply.when)
        return reply

    def _read(self, name: str, words: Sequence[int]) -> Values:
        try:
            values = MESSAGES[name].reply.unpack(words, is_strict=False)
        except Refusal as error:
            raise Violation(f"reply to {name}", expected="as in the table", seen=error) from None
        if "levels" in values:
            seen = values["channels"], values["layers"]
            required = len(self.channels), len(self.layers)
            expect_equal(seen, required, "number of levels and tokens in Status")
        return values

    async def refused(
        self,
        code: str,
        name: str,
        *words: int,
        what: str = "",
        channel: int | None = None,
        **values: object,
    ) -> None:
        """Require that a request is refused with a code, which names a channel or none."""
        answer = await self.answer(name, *words, **values)
        what = what or f"{name} {words or _brief(values)}"
        expect_equal(answer.code or "carried out", code, f"refusal of {what}")
        is_exception = self.client.kind in ("rtu", "tcp") and code in ("UNKNOWN_TYPE", "BAD_LENGTH")
        if not is_exception:
            expect_equal(answer.channel, channel, f"channel of the refusal of {what}")

    async def status(self) -> Reply:
        """Read the status; feeds the watchdog where that is due."""
        if self._is_hungry:
            return await self.ping()
        return await self.request("GetStatus")

    async def ping(self) -> Reply:
        """Feed the watchdog."""
        return await self.request("Ping", session=self.session)

    async def arm(self, watchdog: float = 2.0) -> Reply:
        """Arm under a new session with a watchdog [s], or the nearest that is possible."""
        self.session = self.client.session = self.client.session % 0xFFFF + 1
        low, high = self.can["watchdog_min"], self.can["watchdog_max"]
        self.token, self.is_starving = 0, False
        milliseconds = min(max(round(1000 * watchdog), low), high)
        return await self.request("Arm", session=self.session, watchdog=milliseconds)

    async def clear(self) -> Reply:
        """Acknowledge the last stop or fault."""
        return await self.request("Clear", latch=self.shown.latch)

    @property
    def other_session(self) -> int:
        """A session that is not the one that is held."""
        return (self.session + 0x54) % 0xFFFF + 1

    def _check_fed(self) -> None:
        """Raise Late where this machine may have starved the watchdog."""
        if self._since_fed > _MAX_WATCHDOG_USE:
            raise Late("the watchdog was not fed in time")

    @property
    def _since_fed(self) -> float:
        """Share of the watchdog time that has passed."""
        if self.is_starving or self.expected is None or self.expected.state != ENABLED:
            return 0.0
        return (clock.now() - self.expected.fed.earliest) / self.expected.watchdog

    @property
    def _is_hungry(self) -> bool:
        return self._since_fed > 0.25

    def starve(self) -> None:
        """From now on the watchdog may expire."""
        self.is_starving = True

    async def rest(self) -> None:
        """Bring it to silence, disarmed, nothing latched."""
        self.expected, due = None, clock.now() + _SETTLED
        stopped = await self.request("Stop", ramp=0)
        while any(stopped["levels"]) or stopped["state"] in _MOVING:
            seen = f"{NAMES.get(stopped['state'])}, levels {stopped['levels']}"
            what = "silence after a Stop with ramp 0"
            expect(clock.now() < due, what, expected=f"within {_SETTLED:g} s", seen=seen)
            await asyncio.sleep(_POLL)
            stopped = await self.request("GetStatus")
        await self.request("Clear", latch=stopped["latch"])
        status = await self.request("GetStatus")
        expect_equal(NAMES.get(status["state"]), OFF, "state after Clear")
        self.expected = Expected(self.can, status.values, status.when)

    # Sets

    def parts(self, *layers: LayerSet, token: int | None = None, now: bool = True) -> list[Values]:
        """Make the parts of a set; token: None for the next."""
        self.token = self.token % 0xFFFF + 1 if token is None else token
        if self.expected is not None:
            self.expected.sets.setdefault(self.token, layers)
        return [*parts(pack_layers(layers), session=self.session, token=self.token, now=now)]

    async def play(self, *layers: LayerSet, token: int | None = None) -> Reply:
        """Play a set at once."""
        return [await self.request("Set", **each) for each in self.parts(*layers, token=token)][-1]

    async def stage(self, *layers: LayerSet, token: int | None = None) -> int:
        """Stage a set; returns its token."""
        for part in self.parts(*layers, token=token, now=False):
            await self.request("Set", **part)
        return self.token

    async def commit(self, token: int) -> Reply:
        """Commit a staged set."""
        return await self.request("Commit", session=self.session, token=token)

    # In time

    @property
    def ramp(self) -> int:
        """A ramp [ms] that is long against an exchange."""
        required = max(200, math.ceil(30_000 * min(self.exchange_time, 0.03)))
        return int(min(required, self.can["ramp_max"]))

    async def pause(self, duration: float) -> None:
        """Wait for a time [s], feeding the watchdog."""
        end = clock.now() + duration
        while (left := end - clock.now()) > 0:
            if self._is_hungry:
                await self.ping()
                continue
            is_fed = self.is_starving or self.shown.state != ENABLED
            await asyncio.sleep(left if is_fed else min(left, self.shown.watchdog / 8))
        self.heard_at = end

    async def settle(self, pause: float = _POLL) -> Reply:
        """Read statuses until it is silent and in a state that lasts."""
        due = clock.now() + self.shown.watchdog + _SETTLED
        while True:
            reply = await self.status()
            if not any(reply["levels"]) and reply["state"] not in (*_MOVING, STATES[ENABLED]):
                return reply
            seen = f"{NAMES.get(reply['state'])}, levels {reply['levels']}"
            expect(clock.now() < due, "silence", expected="in time", seen=seen)
            await asyncio.sleep(pause)

    async def follow(self, duration: float | None = None) -> None:
        """Read statuses for a time [s] from the last change on, None until all is settled.

        Raises Late where this machine was too slow to see what happens.
        """
        began = self.shown.began
        end = self.shown.settled_at(clock.now()) + 0.01
        end = end if duration is None else began.earliest + duration
        time, seen = end - self.heard_at, 0
        pause = max(time / (2 * _SAMPLES) - min(self.exchange_time, 1.0), 0.0)
        while clock.now() < end:
            reply = await self.status()
            width = reply.when.latest - reply.when.earliest + began.latest - began.earliest
            is_narrow = width <= _NARROW + 2 * self.exchange_time
            seen += is_narrow
            await asyncio.sleep(pause * is_narrow)
        if seen < max(min(_SAMPLES / 3, time / _EACH, time / (4 * self.exchange_time)), 2):
            raise Late(f"only {seen} statuses were in time")
        await self.status()

    async def in_time(self, case: Callable[[], Awaitable[object]]) -> None:
        """Try a case, each time from rest, until this machine was in time."""
        for attempt in range(1, MAX_ATTEMPTS + 1):
            await self.rest()
            try:
                await case()
                return
            except Late:
                if attempt == MAX_ATTEMPTS:
                    raise

    async def course(self, *steps: LayerSet | float) -> None:
        """Play sets and pause [s] from silence on, and follow the last set until all is settled."""

        async def case() -> None:
            await self.arm()
            for step in steps:
                if isinstance(step, LayerSet):
                    await self.play(step)
                else:
                    await self.pause(step)
            await self.follow()

        await self.in_time(case)

    async def require_interference(self) -> None:
        """Raise Optional where levels do not show that tones of one frequency cancel."""
        halves = [self.tone(0, 0.5, phase) for phase in (0.0, 180.0)]
        await self.play(*(layer(at, each) for at, each in enumerate(halves)))
        level = (await self.request("GetStatus"))["levels"][0]
        await self.play(*map(layer, range(2)))
        if level:
            raise Optional("its levels do not show that tones of one frequency interfere")
        self.shown.is_exact = True


def _brief(values: Mapping[str, object]) -> dict[str, object]:
    return {name: value for name, value in values.items() if name != "stream"}
