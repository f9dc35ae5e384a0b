"""A stop precedes every request that is not on the wire yet, also on shared lines.

In virtual time, at any moment between two frames; requests are recorded in the order of arrival.
"""

import asyncio
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

import pytest

from drivers.amplifier import Amplifier
from drivers.errors import CommandRefused
from drivers.protocol.messages import (
    AmplifierState,
    Apply,
    Disarm,
    GetStatus,
    Nak,
    NakCode,
    Reply,
    Request,
    Stage,
    Stop,
)
from drivers.registry import open_backend
from memory_machine import live_in_memory
from model.rig.rig import Rig
from sim.far_ends.wires import Wire
from sim.faults.fault_window import FaultWindow
from virtual_loop import run_virtual
from wires import FarSide, far_side, on_two_amplifiers, tones

LINES = {
    "serial": Wire("serial", speed=115_200, shared=True),
    "modbus+rtu": Wire("modbus-rtu", speed=115_200, shared=True),
}
BUSES = {"can+slcan": Wire("slcan", shared=True)}
RTU_GAP = 0.00175  # s of silence before a frame above 19 200 Bd (Modbus over serial line, 2.5.1.1)
MOMENTS = [number * 0.0007 for number in range(1, 21)]  # s; one of them is in every gap


class Chain:
    """Two armed amplifiers, east and west, and the requests that they received.

    sent_at: times [s] of the host's frames.
    """

    def __init__(self) -> None:
        self.asked: list[tuple[str, Request]] = []
        self.sent_at: list[float] = []

    def begin(self, amplifiers: dict[str, Amplifier], far: FarSide) -> None:
        self.far = far
        self.east, self.west = amplifiers["east"], amplifiers["west"]
        self.forget()

    def forget(self) -> None:
        self.asked.clear()
        self.sent_at.clear()

    @property
    def frames(self) -> int:
        return len(self.sent_at)

    def seen(self, link: str, toward: str, data: bytes) -> None:
        if toward == "amplifier":
            self.sent_at.append(asyncio.get_running_loop().time())

    def kinds(self) -> list[tuple[str, str]]:
        return [(name, type(request).__name__) for name, request in self.asked]

    async def rearm(self) -> None:
        """Disarm, clear and arm both."""
        for one in (self.east, self.west):
            await one.disarm(0.0)
            await asyncio.sleep(0.1)
            await one.clear()
            await one.arm(2.0)


def on_a_line(line: str, rig: Rig, use: Callable[[Chain], Coroutine[Any, Any, None]]) -> None:
    """Use both amplifiers in virtual time, on a line that is silent at first."""
    chain = Chain()

    async def run() -> None:
        live_in_memory()
        async with far_side({**LINES, **BUSES}[line], on_two_amplifiers(rig)) as far:
            for name, device in far.devices.items():
                device.exchange = partial(  # type: ignore[method-assign]
                    note, chain.asked, name, device.exchange
                )
            both = {name: Amplifier(open_backend(url)) for name, url in far.urls.items()}
            for amplifier in both.values():
                await amplifier.open()
                await amplifier.arm(2.0)
            await asyncio.sleep(0.1)
            chain.begin(both, far)
            await use(chain)
            for amplifier in both.values():
                await amplifier.close()

    run_virtual(run(), seen=chain.seen)


def note(
    asked: list[tuple[str, Request]],
    name: str,
    exchange: Callable[[Request], Reply | None],
    request: Request,
) -> Reply | None:
    """Record a request, unless it reads the status, and pass it on."""
    if not isinstance(request, GetStatus):
        asked.append((name, request))
    return exchange(request)


async def refused(task: "asyncio.Task[Any]") -> None:
    """Require that a request was superseded."""
    with pytest.raises(CommandRefused, match="superseded"):
        await task


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize(
    ("whose", "silencing"), [("east", Stop), ("west", Stop), ("east", Disarm), ("west", Apply)]
)
def test_stop_class_request_is_the_next_frame_at_any_moment(
    line: str, whose: str, silencing: type[Request], coarse_rig: Rig
) -> None:
    """Also between sets and heartbeats of both amplifiers; no token is sent twice."""

    async def use(chain: Chain) -> None:
        amplifier = {"east": chain.east, "west": chain.west}[whose]
        for number, moment in enumerate(MOMENTS):
            chain.forget()
            tokens = {"east": 2 * number + 1, "west": 2 * number + 2}
            others = [
                asyncio.create_task(one())
                for one in (
                    chain.west.heartbeat,
                    partial(chain.east.apply, tones(chain.east, 0.3, token=tokens["east"])),
                    chain.east.heartbeat,
                    partial(chain.west.apply, tones(chain.west, 0.3, token=tokens["west"])),
                )
            ]
            await asyncio.sleep(moment)
            sent = chain.frames
            if silencing is Apply:
                await amplifier.apply(tones(amplifier, 0.0, token=1000 + number))
            else:
                await (amplifier.stop(0.0) if silencing is Stop else amplifier.disarm(0.0))
            await asyncio.gather(*others, return_exceptions=True)
            name, request = chain.asked[sent]
            assert (name, type(request)) == (whose, silencing), f"requested after {moment} s"
            assert not isinstance(request, Apply) or request.command_set.token == 1000 + number
            tokens_of_applies = [
                request.command_set.token
                for _, request in chain.asked
                if isinstance(request, Apply | Stage)
            ]
            assert len(set(tokens_of_applies)) == len(tokens_of_applies)
            if silencing is not Apply:
                await chain.rearm()
            await asyncio.sleep(0.1)

    on_a_line(line, coarse_rig, use)


@pytest.mark.parametrize("whose", ["east", "west"])
def test_stop_preempts_a_request_in_the_rtu_gap(whose: str, coarse_rig: Rig) -> None:
    """A request in the silence before its frame is superseded by a stop of its own amplifier, and
    delayed by that of another."""

    async def use(chain: Chain) -> None:
        await chain.west.heartbeat()
        staged = asyncio.create_task(chain.east.stage(tones(chain.east, 0.3, token=7)))
        await asyncio.sleep(RTU_GAP / 2)
        begin = asyncio.get_running_loop().time()
        amplifier = {"east": chain.east, "west": chain.west}[whose]
        await amplifier.stop()
        assert amplifier.last_sent_at - begin < RTU_GAP
        if whose == "east":
            await refused(staged)
        else:
            assert (await staged).token == 7
        after = [] if whose == "east" else [("east", "Stage")]
        assert chain.kinds() == [("west", "Ping"), (whose, "Stop"), *after]

    on_a_line("modbus+rtu", coarse_rig, use)


def test_broadcast_stop_is_repeated_after_a_possible_collision(coarse_rig: Rig) -> None:
    """On a free line it is sent once; else at once, and again at most 8 ms later."""

    async def use(chain: Chain) -> None:
        await chain.east.stop_on_bus()
        await asyncio.sleep(0.01)  # until it has arrived
        assert chain.kinds() == [("east", "Stop"), ("west", "Stop")]
        assert chain.frames == 1
        chain.far.devices["west"].inject_fault(FaultWindow("hang"))
        beat = asyncio.create_task(chain.west.heartbeat())
        await asyncio.sleep(0.0005)
        chain.forget()
        begin = asyncio.get_running_loop().time()
        await chain.east.stop_on_bus()
        at_once, again = chain.sent_at[:2]
        assert at_once == begin
        assert 0 < again - begin <= 0.0081
        chain.far.devices["west"].recover()
        await beat  # repeated
        assert [what for name, what in chain.kinds() if name == "east"] == ["Stop", "Stop"]

    on_a_line("serial", coarse_rig, use)


def test_stop_preempts_an_arm_that_listens_on_can(
    coarse_rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An arm listens for another host, here longer than opening takes; a stop supersedes it."""
    monkeypatch.setattr("drivers.backends.can_bus.node._HOST_HEARTBEAT", 0.2)

    async def use(chain: Chain) -> None:
        await chain.east.close()
        await chain.east.open()
        arming = asyncio.create_task(chain.east.arm(2.0))
        await asyncio.sleep(0.005)
        chain.forget()
        begin = asyncio.get_running_loop().time()
        await chain.east.stop()
        assert chain.east.last_sent_at == begin
        await refused(arming)
        assert chain.kinds() == [("east", "Stop")]

    on_a_line("can+slcan", coarse_rig, use)


@pytest.mark.parametrize("line", LINES)
@pytest.mark.parametrize(
    ("silencing", "first"),
    [(Disarm, None), (Apply, Nak(NakCode.BUSY))],
    ids=["no answer", "busy"],
)
def test_stop_precedes_retries_of_stop_class_requests(
    line: str, silencing: type[Request], first: Reply | None, coarse_rig: Rig
) -> None:
    """A stop is sent within 8 ms, and 10 ms more where a reply is missing, before the retry."""

    async def use(chain: Chain) -> None:
        east = chain.far.devices["east"]
        usual: Callable[[Request], Reply | None] = east.exchange
        given = [first]

        def answer(request: Request) -> Reply | None:
            if isinstance(request, silencing) and given:
                chain.asked.append(("east", request))
                return given.pop()
            return usual(request)

        east.exchange = answer  # type: ignore[method-assign]
        silent = (
            chain.east.disarm()
            if silencing is Disarm
            else chain.east.apply(tones(chain.east, 0.0, token=7))
        )
        waiting = asyncio.create_task(silent)
        await asyncio.sleep(0.004)  # it is sent
        begin = asyncio.get_running_loop().time()
        async with asyncio.timeout(1):
            status = await chain.east.stop()
            await asyncio.gather(waiting, return_exceptions=True)
        assert status.state is AmplifierState.QUICK_STOP_ACTIVE
        assert [kind for _, kind in chain.kinds()] == [
            silencing.__name__,
            "Stop",
            silencing.__name__,
        ]
        assert chain.sent_at[1] - begin <= 0.0181
        await chain.west.heartbeat()

    on_a_line(line, coarse_rig, use)


@pytest.mark.parametrize("line", LINES)
def test_joining_amplifier_waits_for_a_pending_reply(line: str, coarse_rig: Rig) -> None:
    """West's first request waits for east's reply, with which it would collide."""

    async def use(chain: Chain) -> None:
        await chain.west.close()
        answered: list[float] = []

        async def beat() -> None:
            await chain.east.heartbeat()
            answered.append(asyncio.get_running_loop().time())

        for moment in MOMENTS[:8]:
            chain.forget()
            beating = asyncio.create_task(beat())
            await asyncio.sleep(moment)
            await chain.west.open()
            await beating
            assert chain.kinds()[:2] == [("east", "Ping"), ("west", "Hello")]
            assert chain.sent_at[1] >= answered.pop()
            await chain.west.close()
            await asyncio.sleep(0.05)

    on_a_line(line, coarse_rig, use)


def test_stop_precedes_a_reading_of_sensors(coarse_rig: Rig) -> None:
    """At any moment of a measurement the stop follows the request that is on the line, if any."""

    async def use(chain: Chain) -> None:
        for moment in MOMENTS[::4]:
            reading = asyncio.create_task(chain.east.measure([110.0], 0.02))
            await asyncio.sleep(moment)
            before = len(chain.asked)
            await chain.east.stop()
            after = [kind for _, kind in chain.kinds()[before:]]
            late = 1 if after and after[0] != "Stop" else 0  # on the line at that moment
            assert after[late] == "Stop", after
            await asyncio.gather(reading, return_exceptions=True)
            await chain.rearm()
            chain.forget()

    on_a_line("serial", coarse_rig, use)
