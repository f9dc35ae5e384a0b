"""Courses of a daemon with clients, in virtual time: arming and leases, stops, layouts, strengths.

A step `era.METHOD` is a call of a client; `hang` and `recovers` are of amplifiers. What is required
`is` of the daemon at once, of the `status`, or in events that a client `hears`.
"""

import asyncio
import contextlib
import json
import math
import os
import re
import signal
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from operator import attrgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import numpy as np
import pytest

from controller.api.client import AsyncClient
from controller.api.jsonrpc import ErrorCode, RpcError
from controller.api.link import Notification
from controller.api.methods import ArmParams, StatusResult, TouchParams
from controller.api.schema import ApiMessage
from controller.api.server import Connection
from controller.cli.status_text import show_status
from controller.demo.demonstration import layout_of_people
from controller.operation.operation_states import ENERGISED, Operation
from controller.sources.touch import Touch, TouchFrame
from drivers.protocol.definition import QUANTITIES
from kit.clock import in_virtual_time
from kit.courses import Planted, Step, Taken, courses, follow
from kit.fingers import answers_take
from kit.plates import TWO_AMPLIFIERS, make_paper_rig
from model.arrays import FloatArray
from model.errors import InputError
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from processes.daemons import (
    PATIENCE,
    READY,
    DaemonBench,
    daemon_at,
    daemon_table,
    error_code,
    far_end,
    until_state,
)
from registry import threads
from sim.faults import FaultWindow

PLACES = {
    "pad": (0.1, 0.1),
    "beside": (0.25, 0.1),
    "west": (0.08, 0.1),
    "east": (0.22, 0.1),
    "left": (0.03, 0.11),
    "right": (0.216, 0.0572),
}
"""Places [m] by name."""
SEATS = ("left", "right")
"""Where two people sit."""
FADE, WINDOW, STEP = 0.100, 0.050, 0.001  # s
LOWER = 10 ** (-6 / 20)  # of -6 dB
STEEPEST = (1 - LOWER) * math.pi / 2 * STEP / FADE
"""Largest change of an envelope of 1 along the raised cosine, within a step."""
LEVEL_STEP = 1 / QUANTITIES["level"].per_unit


@cache
def phased_table() -> LocalizationTable:
    """For two vibrations at once, of levels that a step on the wire does not round by much."""
    frequencies, rig = np.arange(60.0, 301.0, 20.0), make_paper_rig(12, 9)
    rig = replace(rig, promised_thresholds=(rig.threshold,))
    return build_table(rig, frequencies=frequencies, drive_mode="phased")


@dataclass
class Served(Taken):
    """A daemon that is ready, with two clients, era and other.

    shown: the status that was read last; heard: the data of the last event; began [s]: the last
    mark; asked: when an answer was asked for, of those that take a time.
    """

    folder: Path = Path()
    patch: pytest.MonkeyPatch = field(default_factory=pytest.MonkeyPatch)
    options: Mapping[str, Any] = field(default_factory=dict)
    stack: AsyncExitStack = field(default_factory=AsyncExitStack)
    bench: DaemonBench = field(init=False)
    era: AsyncClient = field(init=False)
    other: AsyncClient = field(init=False)
    shown: StatusResult = field(init=False, repr=False)
    heard: SimpleNamespace = field(init=False, repr=False)
    events: list[Notification] = field(default_factory=list)
    held: "list[asyncio.Task[None]]" = field(default_factory=list)
    going_on: asyncio.Event = field(default_factory=asyncio.Event)
    began: float = 0.0
    asked: Sequence[float] = ()

    @property
    def operation(self) -> Operation:
        """What the supervisor knows."""
        return self.bench.daemon.supervisor.operation

    @property
    def is_energised(self) -> bool:
        """Whether the daemon takes the amplifiers for armed."""
        return self.operation.state in ENERGISED

    @property
    def amplifiers(self) -> str:
        """The state of the first amplifier."""
        return self.bench.far.summary().state

    @property
    def is_loud(self) -> bool:
        """Whether the first amplifier plays."""
        return any(self.bench.far.summary().levels)

    @property
    def feels(self) -> list[str | None]:
        """What the fingers feel."""
        return [each.feels for each in self.bench.daemon.publisher.view.contact_statuses()]

    @property
    def levels(self) -> list[float]:
        """Of the fingers shown [dB SL]."""
        return [round(each.level_db_sl or 0.0, 1) for each in self.shown.contacts]

    @property
    def held_back(self) -> list[str | None]:
        """Why the fingers shown feel nothing, each reason once; a silent plate says the same."""
        reasons = list(dict.fromkeys(each.held_back for each in self.shown.contacts))
        if self.shown.state == "OPERATION_ENABLED":
            assert reasons == [self.shown.silence_reason]
        return reasons

    @property
    def effects(self) -> list[str | None]:
        """Of the fingers shown."""
        return [each.effect for each in self.shown.contacts]

    @property
    def losses(self) -> dict[str, str]:
        """Of the amplifiers shown: whether each is lost, closed with another or present."""
        return {
            each.name: ("lost" if each.lost else "") + ("closed" if each.closed_with_lost else "")
            or "present"
            for each in self.shown.amplifiers
        }

    async def starts(self) -> None:
        """Start a daemon, which becomes ready, and connect the clients."""
        of_rig = {"changes": self.options["changes"]}
        far = await self.stack.enter_async_context(far_end(self.folder, **of_rig))
        made = daemon_at(far, self.folder, **self.options)
        self.bench = await self.stack.enter_async_context(made)
        for client in ("era", "other"):
            await self.connects(client, "test")
        await until_state(self.era, READY)

    async def connects(self, client: str, name: str) -> None:
        """Connect a client by this name."""
        made = await self.stack.enter_async_context(await self.bench.client(name))
        setattr(self, client, made)

    async def restarts(self) -> None:
        """End the daemon and start another."""
        self.lifts()
        await self.stack.aclose()
        await self.starts()

    async def reaches(self, state: str) -> None:
        """Wait until the daemon is in a state."""
        await until_state(self.era, state)

    def _differ(self, expected: Mapping[str, object]) -> dict[str, object]:
        """Those values of expressions, or of the status shown, that are not as expected."""
        shown = StatusResult.model_fields.keys() - dir(type(self))
        found = {
            what: self.value(f"shown.{what}" if what.partition(".")[0] in shown else what)
            for what in expected
        }
        return {what: each for what, each in found.items() if each != expected[what]}

    async def status(self, **expected: object) -> None:
        """Read the status, and require values of it."""
        self.shown = await self.era.status()
        assert not self._differ(expected), self._differ(expected)

    async def becomes(self, **expected: object) -> None:
        """Read the status until it has these values."""
        async with asyncio.timeout(PATIENCE):
            self.shown = await self.era.status()
            while self._differ(expected):
                await asyncio.sleep(0.01)
                self.shown = await self.era.status()

    async def stays(self, seconds: float, **expected: object) -> None:
        """Require values of the status for so long."""
        end = threads.now() + seconds
        while threads.now() < end:
            await self.status(**expected)
            await asyncio.sleep(0.01)

    async def until(self, **expected: object) -> None:
        """Wait until properties have these values."""
        async with asyncio.timeout(PATIENCE):
            while self._differ(expected):  # noqa: ASYNC110
                await asyncio.sleep(0.005)

    def between(self, least: float, most: float, what: str) -> None:
        """Require that a value is within these bounds."""
        assert least <= self.value(what) <= most

    def shows(self, *patterns: str) -> None:
        """Require that `era status` prints a match of each pattern."""
        for pattern in patterns:
            assert re.search(pattern, show_status(self.shown)), show_status(self.shown)

    async def hears(self, topic: str, **expected: object) -> None:
        """Wait for the next event of a topic, and require its data."""
        while not (found := [each for each in self.events if each.topic == topic]):
            event = await self.era.next_event(timeout=PATIENCE)
            assert event is not None, f"no event of {topic}"
            self.events.append(event)
        self.events.remove(found[0])
        self.heard = SimpleNamespace(**found[0].data)
        assert found[0].data.items() >= expected.items(), found[0].data

    async def hears_at_last(self, topic: str, **expected: object) -> None:
        """Wait for an event of a topic with these data."""
        await self.hears(topic)
        while not vars(self.heard).items() >= expected.items():
            await self.hears(topic)

    async def hears_of_the_last_stop(self) -> None:
        """Let a client stop, and the other hear of it."""
        await self.hears_at_last("state", epoch=(await self.other.stop()).epoch)

    async def refused(self, code: str, step: Step) -> None:
        """Require that the daemon refuses a step with this code."""
        assert await error_code(self.take(step)) is ErrorCode[code]

    async def refuses_saying(self, text: str, step: Step) -> None:
        """Require that a step is refused by the daemon, or by its client, with this text."""
        with pytest.raises((RpcError, InputError), match=text):
            await self.take(step)

    async def requests(self, method: str, params: Mapping[str, object]) -> None:
        """Let era request a method with any parameters."""
        unchecked = SimpleNamespace(model_dump_json=lambda **_: json.dumps(params))
        await self.era.request(method, cast(ApiMessage, unchecked))

    async def renews(self) -> None:
        """Renew the lease, as its client does."""
        await self.era.renew(self.operation.lease.token)

    def expires(self) -> None:
        """Let the lease be over."""
        supervisor = self.bench.daemon.supervisor
        assert supervisor.operation.lease is not None
        lease = replace(supervisor.operation.lease, expires_at=0.0)
        supervisor.current.value = replace(supervisor.operation, lease=lease)

    async def uses(self) -> None:
        """Arm as the other client for a minute, which is never reached."""
        async with self.other.armed("other", lease_s=60):
            raise AssertionError("must not be armed")

    async def arms_within(self) -> None:
        """Arm as the server does for a client."""
        client = cast(Any, SimpleNamespace(has_left=False))
        await self.bench.daemon.api.arm(client, ArmParams(owner="me", lease_s=60))

    def arming_waits(self) -> None:
        """Let the amplifiers be armed only when it goes on."""
        arm = self.bench.daemon.controller.arm

        async def slow() -> None:
            await self.going_on.wait()
            await arm()

        self.patch.setattr(self.bench.daemon.controller, "arm", slow)

    def skips(self, *methods: str, work: Callable[..., None] = lambda *_: None) -> None:
        """Let methods of the daemon do nothing from now on, or this work."""
        for owner, _, method in (each.rpartition(".") for each in methods):
            self.patch.setattr(attrgetter(owner)(self.bench.daemon), method, work)

    def fails(self, *methods: str) -> None:
        """Let methods of the daemon fail from now on."""
        self.skips(*methods, work=Mock(side_effect=Planted(*methods)))

    def hang(self, amplifier: str = "main") -> None:
        """Let an amplifier reply no more."""
        self.bench.far.devices[amplifier].inject_fault(FaultWindow(fault="hang"))

    def recovers(self, amplifier: str = "main") -> None:
        """Let it reply again."""
        self.bench.far.devices[amplifier].recover()

    def is_exchanged(self, serial_number: str) -> None:
        """Have another amplifier in place of the first."""
        self.bench.far.device.identity["serial_number"] = serial_number

    def holds(self, **fingers: Sequence[str]) -> None:
        """Let clients, by source where one is named, report fingers at these places from now on."""
        for client, places in fingers.items():
            self.held.append(asyncio.create_task(self._holds(client, places)))

    async def _holds(self, client: str, places: Sequence[str]) -> None:
        name, _, source = client.partition(".")
        given = {"source": source} if source else {}
        with contextlib.suppress(ConnectionError):
            while True:
                await getattr(self, name).touch([PLACES[each] for each in places], **given)
                await asyncio.sleep(0.02)

    def lifts(self) -> None:
        """Let no client report fingers any more."""
        while self.held:
            self.held.pop().cancel()

    async def touches(self, *places: str) -> None:
        """Report fingers several times, or an empty plate."""
        for _ in range(4):
            await self.era.touch([PLACES[each] for each in places])
            await asyncio.sleep(0.05)

    async def touches_with(self, *radii: float | None) -> None:
        """Report touches of these radii [m], 5 cm apart."""
        touches = [
            {"id": number, "x_m": 0.05 * number, "y_m": 0.1, "radius_m": radius}
            for number, radius in enumerate(radii, start=1)
        ]
        given = TouchParams.model_validate({"source": "pad", "touches": touches})
        await self.era.request("touch", given)

    async def plays(self, effect: Any, at: str, **more: Any) -> None:
        """Play an effect, or points, at a place."""
        await self.era.play(effect, PLACES[at], **more)

    def writes(self, **layouts: str) -> None:
        """Write layouts."""
        for name, text in layouts.items():
            (self.folder / f"{name}.yaml").write_text(text, "utf-8")

    async def reloads(self, edit: Mapping[str, str], refused: str = "") -> None:
        """Reload with a configuration that is edited, which is done unless a reason is named."""
        path = self.folder / "daemon.yaml"
        original = text = path.read_text("utf-8")
        for old, new in edit.items():
            assert old in text
            text = text.replace(old, new)
        path.write_text(text, "utf-8")
        verdict = await self.era.reload()
        path.write_text(original, "utf-8")
        assert verdict.reloaded is not bool(refused)
        assert refused in verdict.reasons[0]

    def signals(self, name: str) -> None:
        """Send a signal to the daemon."""
        os.kill(os.getpid(), signal.Signals[name])

    async def clock_jumps(self, seconds: float) -> None:
        """Let the wall clock be so far off, which the status shows."""
        self.patch.undo()
        real = time.time
        self.patch.setattr(time, "time", lambda: real() + seconds)
        assert (await self.era.status()).unix_time_s == pytest.approx(time.time(), abs=60)

    def marks(self) -> None:
        """Begin to measure a time."""
        self.began = threads.now()

    def since(self, least: float, most: float) -> None:
        """Require that so much time [s] has passed since the mark."""
        assert least <= threads.now() - self.began <= most

    def answers_take(self, seconds: float) -> None:
        """Let answers of the thread take so long."""
        self.asked = answers_take(self.patch, seconds)


@asynccontextmanager
async def served(
    *amplifiers: str, more: str = "", layouts: Mapping[str, str] | None = None, seats: bool = False
) -> AsyncIterator[Served]:
    """A daemon that is ready; amplifiers: with a second one, side, if any are named.

    more: further lines of its file; layouts: their texts by name; seats: whether it has the layout
    of two people.
    """
    if seats:
        people = layout_of_people(make_paper_rig(12, 9).plate, dict.fromkeys(SEATS))
        layouts = {"panel": json.dumps(people)}
    used = ", ".join(f"{name}: {name}.yaml" for name in layouts or {})
    options = {
        "more": f"layouts: {{{used}}}\n{more}" if used else more,
        "changes": TWO_AMPLIFIERS if amplifiers else (),
        "table": lambda rig: phased_table() if seats else daemon_table(),
    }
    with TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        made = Served(folder=Path(folder), patch=patch, options=options)
        made.writes(**layouts or {})
        await made.starts()
        try:
            yield made
        finally:
            made.lifts()
            await made.stack.aclose()


COURSES = courses(Path(__file__).with_name("courses.yaml"))


@pytest.mark.parametrize("name", COURSES)
def test_daemon_keeps_to_its_course(name: str) -> None:
    """Every step is as it is in the file."""
    follow(COURSES[name], served)


def envelope(bench: DaemonBench, finger: str, frequency: float, at: FloatArray) -> FloatArray:
    """Amplitude of one tone at a fingertip [m/s²] at times [s], under a Hann window."""
    records, _ = bench.far.bench.records(at[0] - WINDOW, at[-1] + WINDOW)
    felt = records[finger]
    turned = np.exp(-2j * np.pi * frequency * felt.times) * (felt.accelerations @ felt.weights)
    weights = np.cos(np.pi * np.clip((felt.times - at[:, None]) / WINDOW, -0.5, 0.5)) ** 2
    return np.asarray(np.abs(weights @ turned) / weights.sum(axis=1))


@in_virtual_time
async def test_plate_plays_on_when_the_name_of_a_client_cannot_be_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The control loop reads strengths that the API has set, and calls no code of the API."""

    def fail(client: Connection) -> str:
        raise AssertionError("name of a client read in the control loop")

    async with served(seats=True) as daemon:
        era, controller = daemon.era, daemon.bench.daemon.controller

        async def hold(*places: str) -> None:
            """Hold fingers of a touch source of the daemon for 0.4 s."""
            plate = daemon.bench.daemon.config.rig.plate
            touches = []
            for number, place in enumerate(places):
                x, y = PLACES[place]
                touches.append(Touch(number, x / plate.length, 1 - y / plate.width))
            for _ in range(20):
                controller.cycle.deliver(TouchFrame("panel", threads.now(), tuple(touches)))
                await asyncio.sleep(0.02)

        await era.arm("test", lease_s=60)
        await hold("left")
        await era.strength(name="left", gain_db=-6)
        await hold("left")
        alone = [contact.level_db_sl for contact in (await era.status()).contacts]
        with monkeypatch.context() as broken:
            broken.setattr(Connection, "name", property(fail), raising=False)
            await hold("left", "right")
        both = [contact.level_db_sl for contact in (await era.status()).contacts]
        assert alone == pytest.approx([14.0], abs=0.2)
        assert both == pytest.approx([14.0, 20.0], abs=0.2)


@in_virtual_time
async def test_gain_of_a_source_is_felt_at_its_finger_alone_along_a_fade() -> None:
    """6 dB less within 100 ms and back, monotone and as steep as a raised cosine; others as before.

    On the amplifier exactly, at the skin as the plate follows.
    """
    async with served(seats=True) as daemon:
        bench, era = daemon.bench, daemon.era
        bench.far.bench.place_fingers({each: PLACES[each] for each in SEATS}, now=threads.now())
        await era.arm("test", lease_s=60)
        daemon.holds(**{f"era.{each}": [each] for each in SEATS})
        await asyncio.sleep(1.0)
        tones = {each.effect: each.frequency_hz for each in (await era.status()).contacts}
        planner = bench.daemon.controller.cycle.planner
        (sent,) = [
            n
            for n, one in planner.slots.by_layer.items()
            if "right" in one.content.key.finger.source
        ]
        settled_at = planner.slots.by_layer[sent].settled_at
        for gain, first, last in ((-6.0, 1.0, LOWER), (0.0, LOWER, 1.0)):
            set_at = threads.now()
            await era.strength(name="left", gain_db=gain)
            await asyncio.sleep(0.02)
            led = np.arange(threads.now(), set_at + 0.2, STEP)
            moving = [
                np.array([abs(tone.transition.at(time)) for time in led])
                for channel in bench.far.amplifier.outputs
                for tone in channel
                if tone.frequency == pytest.approx(tones["left"], abs=0.01)
            ]
            await asyncio.sleep(0.4)
            at = np.arange(set_at, set_at + 0.3, STEP)
            for name, frequency in tones.items():
                found = envelope(bench, name or "", frequency or 0.0, at)
                if name == "left":
                    moving.append(found)
                    reached = found[round((FADE + WINDOW / 2 + 0.01) / STEP) :]
                    assert 20 * np.log10(reached / found[0]) == pytest.approx(gain or 6.0, abs=0.2)
                    assert 20 * np.log10(found[-1] / found[0]) == pytest.approx(gain or 6, abs=0.05)
                else:
                    assert 20 * np.log10(found / found[0]) == pytest.approx(0.0, abs=0.1)
            assert planner.slots.by_layer[sent].settled_at == settled_at  # not sent again
            assert len(moving) == 5
            for course in moving:
                changes = np.diff(course / course[-1] * last) * math.copysign(1, last - first)
                rounded = LEVEL_STEP / np.abs(course).min() / (1 - LOWER)
                slack = 0.1 if course is moving[-1] else 0.01 + rounded
                assert -slack * STEEPEST <= changes.min()
                assert changes.max() <= (1 + slack) * STEEPEST
