"""Fingers on a layout in virtual time: real bytes on a wire, a plate in time, what is felt.

The chain has a supervisor, and events of the daemon are steps of its courses. TUIO is as a sender
makes it, by python-osc: captures of it, and a panel of a daemon.
"""

import asyncio
import itertools
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
import pytest
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from scipy.signal import hilbert

from controller.daemon.plate_view import PlateView
from controller.effects.effect import Region
from controller.effects.kinds import Buzz
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.operation.operation_states import DaemonEvent, DaemonState, Lease, Trigger
from controller.operation.supervisor import Supervisor
from controller.play.intent import CLICK, FingerTarget, Target
from controller.play.joint_answers import answered, selection_of
from controller.play.layer_sets import Sets
from controller.play.reports import PlayReport
from controller.play.selected_contents import (
    Content,
    ContentKey,
    FingerSensation,
    Question,
    Selection,
)
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.play.slots import Slots
from controller.sources.touch import Contact, Touch, TouchFrame
from controller.sources.tuio_capture import RecordedDatagram
from drivers.errors import CommandRefused, LinkError
from drivers.host.set_admission import StagedSet
from drivers.protocol.sets import LayerSet
from examples.make_touches import tuio_datagram, write_capture
from kit.chain import Chain, Position, set_chain
from kit.clock import run_virtual
from kit.courses import Acted, Planted, Step, fits
from kit.plates import smooth_rig
from kit.wires import after_each
from model.answer.answer import Limits
from model.answer.answer_report import Timing
from model.arrays import FloatArray
from model.config.fields import Rectangle
from model.errors import InputError
from model.finger import detection_threshold
from model.rig.rig import Channel, Rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire

LEFT, RIGHT, ABOVE = (0.126, 0.081), (0.234, 0.049), (0.069, 0.208)
"""Places on the paper's plate, 11 to 23 cm apart."""

LAYOUT = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="low"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="high"),
        Region("above", Rectangle(0.0, 0.13, 0.3, 0.09), on_press="any"),
    ),
    {"low": Buzz(level=14.0), "high": Buzz(level=14.0), "any": Buzz(level=14.0)},
    elsewhere=None,
)


def asked(
    targets: Sequence[tuple[Contact, Target]],
    before: Mapping[ContentKey, Content] = MappingProxyType({}),
) -> Question:
    """A question for fingers that feel what lasts, among no others."""
    fingers = tuple([FingerTarget(contact, target) for contact, target in targets])
    return Question(tuple([finger.contact for finger in fingers]), fingers, (), playing=before)


def chosen_for(
    targets: Sequence[tuple[Contact, Target]],
    capabilities: PlaybackCapabilities,
    *,
    before: Mapping[ContentKey, Content] = MappingProxyType({}),
) -> Selection:
    """What is chosen for fingers that feel what lasts, among no others."""
    question = asked(targets, before)
    found = answered(table(), question, question.lasting, capabilities)
    return selection_of(table(), question, found, question.lasting)


def answers_take(patch: pytest.MonkeyPatch, *seconds: float) -> list[float]:
    """Let answers of the thread take these times [s], the last one as often as it is asked.

    Returns when [s] each was asked for.
    """
    loop, asked = asyncio.get_running_loop(), list[float]()

    def slowly(loop: Any, executor: Any, work: Callable[[], Any]) -> "asyncio.Future[Any]":
        future = loop.create_future()
        loop.call_later(
            seconds[min(len(asked), len(seconds) - 1)], lambda: future.set_result(work())
        )
        asked.append(loop.time())
        return future

    patch.setattr(type(loop), "run_in_executor", slowly)
    return asked


@cache
def table() -> LocalizationTable:
    """The paper's plate at 29 frequencies."""
    return build_table(smooth_rig(), frequencies=np.linspace(40.0, 320.0, 29))


def playable(layers: int = 8) -> PlaybackCapabilities:
    """What amplifiers of that plate can play, of so many layers, with ramps alone."""
    return PlaybackCapabilities(
        "phased",
        ("phased",),
        Limits((40.0, 320.0), table().full_levels),
        RAMPS_ONLY,
        layers=layers,
    )


@dataclass
class Fingers(Chain):
    """Fingers by id, and what was sent and reported for them.

    committed: time [s], token and layers of every set and silence (no layers), as the amplifier
    carries them out.
    """

    def __post_init__(self) -> None:
        """Note what requests of the host change."""
        super().__post_init__()
        self.committed = self.far_end.committed

    @property
    def player(self) -> EffectPlayer:
        """What the layout makes of the fingers."""
        player = self.controller.intent_source
        assert isinstance(player, EffectPlayer)
        return player

    def play(self, effect: str, id: int = 1) -> None:
        """Play an effect at a finger, as a client does."""
        (contact,) = [each for each in self.applied[-1].contacts if each.key.id == id]
        self.player.play(effect, contact, threads.now(), level_db_sl=None)
        self.controller.cycle.request_update()

    def reached(
        self, *, over: float = 0.25
    ) -> Iterator[tuple[int, FloatArray, FloatArray, FloatArray]]:
        """By finger weights (p,) of its points, amplitudes (f, p) of its own tones, and of others.

        Of the last seconds, over threshold; its own are of the frequency reported for it.
        """
        now, bench = asyncio.get_running_loop().time(), self.far.bench
        bench.advance(now)
        targets = self.applied[-1].targets if self.applied else ()
        own = {each.contact.key.id: each.frequency for each in targets}
        for name, felt in bench.felt(now - over, now).items():
            thresholds = detection_threshold(np.array(felt.frequencies), bench.rig.threshold)
            amplitudes = felt.amplitude / thresholds[:, None]
            is_own = np.isclose(felt.frequencies, own.get(int(name)) or 0.0, atol=0.2)
            yield int(name), felt.weights, amplitudes[is_own], amplitudes[~is_own]

    def contrasts(self, *, over: float = 0.25) -> Mapping[int, float]:
        """Level of each finger's content over all others there [dB], of the last seconds.

        As the table defines it: mean of the own tone over the tip, over the loudest point of the
        rest.
        """
        return {
            id: _db((own[0] @ weights / weights.sum()) ** 2) - _loudest(others)
            for id, weights, own, others in self.reached(over=over)
            if len(own) == 1 and len(others)
        }

    def levels_db_sl(self, *, foreign: bool = False) -> Mapping[int, float]:
        """Level [dB SL] at each finger's loudest point; foreign: of what is not its own alone."""
        return {
            id: _loudest(others if foreign else np.concatenate([own, others]))
            for id, _, own, others in self.reached()
        }


def _loudest(amplitudes: FloatArray) -> float:
    """Level [dB SL] of tones (f, p) at the loudest point, -90 if there are none."""
    return _db((amplitudes**2).sum(axis=0).max(initial=1e-9))


def _db(power: float) -> float:
    return float(10 * np.log10(power))


Placed = TypeVar("Placed", bound=Fingers)


@asynccontextmanager
async def fingers_on(
    table: LocalizationTable,
    layout: SurfaceLayout,
    *,
    of: type[Placed] = Fingers,  # type: ignore[assignment]
    at: Mapping[int, Position] = MappingProxyType({}),
    held: float = 0.0,
    layers: int = 8,
    amplifiers: Sequence[str] = ("main",),
    breaks: str | None = None,
) -> AsyncIterator[Placed]:
    """Fingers on a layout, armed, with four ERAs on amplifiers in turn.

    of: their class; at: those that are held for a time [s] first; breaks: the only rule that
    the planted fault breaks.
    """
    rig, count = smooth_rig(), len(amplifiers)
    wired = [(era, Channel(amplifiers[n % count], n // count)) for n, era in enumerate(rig.wiring)]
    async with of.armed(
        SimulatedWire("serial", speed=921_600, unpluggable=True),
        replace(rig, wiring=dict(wired), amplifiers=dict.fromkeys(amplifiers, "memory://")),
        table,
        intent_source=EffectPlayer(layout),
        timing=Timing(table),
        capabilities={"layers": layers},
        breaks=breaks,
    ) as fingers:
        fingers.at = {**at}
        await fingers.hold(held)
        yield fingers


@dataclass
class Hands(Acted, Fingers):
    """Fingers that take the steps of courses; what is new has come since the last mark.

    layouts: those that may be chosen, by name; patch: undone at the end; questions [s]: when
    answers of the thread were asked for, since it is set how long they take; failures: of answers.
    """

    layouts: Mapping[str, SurfaceLayout] = field(default_factory=dict)
    patch: pytest.MonkeyPatch = field(default_factory=pytest.MonkeyPatch)
    questions: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)
    refusals: list[float] = field(default_factory=list)
    marked_at: float = 0.0
    marked: tuple[int, int] = (0, 0)
    before: PlayReport | None = None

    def marks(self) -> None:
        """Let what comes from now on be new."""
        self.marked_at, self.before = threads.now(), self.applied[-1] if self.applied else None
        self.marked = len(self.applied), len(self.committed)

    def down(self, fingers: Mapping[int, str | Position]) -> None:
        """Have fingers at places, beside others that are down."""
        self.at |= places_of(fingers)

    def up(self, *ids: int) -> None:
        """Lift fingers."""
        for id in ids:
            del self.at[id]

    async def moves(self, seconds: float, dx: float, dy: float, *ids: int) -> None:
        """Hold all fingers for a time; these, or all, move so far [m] meanwhile."""
        began = {id: self.at[id] for id in ids or self.at}

        def move(since: float) -> None:
            way = since / seconds
            self.at |= {id: (x + way * dx, y + way * dy) for id, (x, y) in began.items()}

        await self.hold(seconds, move)

    def spreads(self, count: int) -> None:
        """Have so many fingers 5 cm apart or more, numbered from one on."""
        self.controller.cycle.tracker.max_fingers = count
        places = [(0.04 + 0.055 * (n % 5), 0.035 + 0.05 * (n // 5)) for n in range(count)]
        self.at = dict(enumerate(places, start=1))

    def has_layout(self, name: str) -> None:
        """Choose another layout."""
        self.player.replace(self.layouts[name])
        self.controller.cycle.request_update()

    def answers_take(self, *seconds: float) -> None:
        """Let answers of the thread take these times, the last one as often as it is asked."""
        self.questions = answers_take(self.patch, *seconds)

    def answers_fail(self, text: str, *, is_refused: bool = False) -> None:
        """Let answers fail by a bug, or be refused by the table, until all works again."""

        def fail(*_: Any, **__: Any) -> None:
            self.failures.append(text)
            raise InputError(text) if is_refused else Planted(text)

        self.patch.setattr("controller.play.chooser.answered", fail)

    def threads_fail(self) -> None:
        """Let the system have no thread left until all works again."""

        def exhausted(*_: object) -> None:
            raise RuntimeError("can't start new thread")

        self.patch.setattr(type(asyncio.get_running_loop()), "run_in_executor", exhausted)

    def all_works(self) -> None:
        """Undo what has been set of answers and threads."""
        self.patch.undo()

    def refuses_layers(self, why: str, least: int) -> None:
        """Let the ledger refuse so many layers that vibrate, or more."""
        slots = self.controller.cycle.planner.slots
        check = slots.check

        def refuse(asked: Mapping[str, StagedSet]) -> CommandRefused | None:
            begun = [each for each in asked["main"].requested if not each.renew]
            if sum(any(tone.level for tone in each.tones) for each in begun) < least:
                return check(asked)
            self.refusals.append(threads.now() - self.marked_at)
            return CommandRefused(why)

        self.patch.setattr(slots, "check", refuse)

    def is_degraded(self) -> None:
        """Let the amplifier be one that does not reply but may play, until all works again."""
        members = self.controller.group.members
        self.patch.setattr(type(members), "degraded", ("main",))

    def refuses_once(self) -> None:
        """Let the amplifier refuse the next set."""
        group = self.controller.group

        async def refuse(*_: Any, **__: Any) -> None:
            self.patch.undo()
            raise CommandRefused("not now")

        self.patch.setattr(group, "play", refuse)

    def renews_not(self, layer: int) -> None:
        """Let a layer not be renewed any more."""
        renewals = Slots.renewals

        def others(slots: Slots, now: float) -> Sets:
            due = renewals(slots, now).layers
            return Sets({number: each for number, each in due.items() if number != layer})

        self.patch.setattr(Slots, "renewals", others)

    def falls_silent_within(self, seconds: float, *layers: int) -> None:
        """Require that layers are silent so long after the mark, by what the amplifier plays."""
        voices = [each for every in self.far_end.amplifier.outputs for each in every]
        ends = [each.silent_from - self.marked_at for each in voices if each.layer in layers]
        assert ends
        assert max(ends) <= seconds, ends

    def comes(self, layer: int, *times: str) -> None:
        """Require that the first new sets of a layer come so long after the mark."""
        found = [time for time, one in self.new_layers if one.layer == layer]
        assert fits(found[: len(times)], [*times]), found

    def status(self, **wanted: Any) -> None:
        """Require what the status says of each finger."""
        reports = [*self.applied[-1:], *self.silenced[-1:]]
        report = max(reports, key=lambda each: each.time, default=None)
        view = PlateView(self.player.effect_of, self.controller.cycle.tracker.contacts, report)
        for key, each in wanted.items():
            found = {one.id: getattr(one, key) for one in view.statuses_now(table())}
            assert fits(found, each), (key, found)

    @property
    def new(self) -> list[PlayReport]:
        """New reports of what plays."""
        return self.applied[self.marked[0] :]

    @property
    def new_commits(self) -> list[tuple[float, Sequence[LayerSet]]]:
        """New sets, and how long after the mark [s] they were committed; of a silence no layers."""
        commits = self.committed[self.marked[1] :]
        return [(time - self.marked_at, layers) for time, _, layers in commits]

    @property
    def new_layers(self) -> list[tuple[float, LayerSet]]:
        """Each layer of them."""
        return [(time, one) for time, layers in self.new_commits for one in layers]

    @property
    def changes(self) -> list[list[int]]:
        """Layers of each new set that changes what plays: of no renewal, and of no ending."""
        return [
            sorted(one.layer for one in layers)
            for _, layers in self.new_commits
            if not any(one.renew or any(each.ending for each in one.commands) for one in layers)
        ]

    @property
    def first_set_after(self) -> float:
        """How long after the mark the first new set was committed."""
        return self.new_commits[0][0]

    @property
    def driven(self) -> dict[int, bool]:
        """Of layers of new sets, whether they are to vibrate after the last one."""
        layers = [one for _, one in self.new_layers if not one.renew]
        return {one.layer: any(each.level for each in one.commands) for one in layers}

    @property
    def ramps(self) -> dict[int, int]:
        """Of layers of new sets, the last ramp [ms]."""
        return {one.layer: one.ramp for _, one in self.new_layers if not one.renew}

    @property
    def keeps_phase(self) -> dict[int, list[bool]]:
        """Of layers of the first new set, which tones continue."""
        layers = self.new_commits[0][1]
        return {one.layer: [each.keep_phase for each in one.commands] for one in layers}

    @property
    def latencies(self) -> list[float]:
        """Of new reports."""
        return [each.latency or 0.0 for each in self.new]

    @property
    def longest_unfed(self) -> float:
        """The longest time without anything that feeds the watchdog."""
        times = self.far_end.times("Ping", "Set", "Commit")
        return max(later - sooner for sooner, later in itertools.pairwise(times))

    @property
    def layers(self) -> dict[int, list[int]]:
        """Layers that play, by finger."""
        playing = [(each.content.key.finger.id, n) for n, each in self.applied[-1].contents.items()]
        return {id: [n for other, n in playing if other == id] for id, _ in playing}

    @property
    def voices(self) -> list[float | None]:
        """Frequencies that play [Hz]."""
        return [one.content.frequency for one in self.applied[-1].contents.values()]

    @property
    def frequency_of_clicks(self) -> list[float | None]:
        """Frequencies of clicks that play [Hz]."""
        contents = [one.content for one in self.applied[-1].contents.values()]
        return [each.frequency for each in contents if each.key.voice == CLICK]

    @property
    def least_apart(self) -> float:
        """The least distance of frequencies that play [Hz]."""
        pairs = itertools.pairwise(sorted(each or 0.0 for each in self.voices))
        return min(more - less for less, more in pairs)

    @property
    def is_as_before(self) -> bool:
        """Whether what lasts is, of each finger that feels something, what it was at the mark."""
        return _lasting(self.applied[-1]).items() <= _lasting(self.before).items()

    @property
    def keeps_frequencies(self) -> bool:
        """Whether fingers keep, in new reports, the frequencies that they had at the mark."""
        had = felt(self.before)
        for report in self.new:
            for id, target in felt(report).items():
                if id in had and target.frequency != had[id].frequency:
                    return False
        return True

    @property
    def gained_db(self) -> float:
        """How much more that is than at the mark [dB]."""
        return _worst(self.applied[-1]) - _worst(self.before)

    @property
    def gained_nominal_db(self) -> float:
        """How much more the first finger feels now than at the mark, as modeled [dB]."""
        now, before = felt(self.applied[-1])[1], felt(self.before)[1]
        return now.sensation.level_db_sl - before.sensation.level_db_sl

    @property
    def gained_since_db(self) -> float:
        """How much more the first finger is to feel by the last new report than by the first."""
        last, first = felt(self.new[-1])[1], felt(self.new[0])[1]
        return (last.level_db_sl or 0.0) - (first.level_db_sl or 0.0)

    @property
    def most_of_a_stroke(self) -> float:
        """What all contents take of the stroke of the ERA that is driven most."""
        levels = Counter[str]()
        for one in self.applied[-1].contents.values():
            levels.update({era: tone.level for era, tone in one.drive.items()})
        return max(levels.values())

    @property
    def held_back(self) -> dict[int, str | None]:
        """Why fingers feel nothing of their own, as is reported."""
        return {id: target.held_back for id, target in felt(self.applied[-1]).items()}

    @property
    def told(self) -> list[list[tuple[int, str]]]:
        """Verdicts of each new report, by finger."""
        return [sorted(verdicts(report).items()) for report in self.new]

    @property
    def verdicts(self) -> list[str]:
        """All verdicts."""
        return sorted({*verdicts(self.applied[-1]).values()})

    @property
    def beyond_nominal_db(self) -> dict[int, float]:
        """By how much contrasts at fingertips are beyond those of contents, as modeled [dB]."""
        contents = [one.content for one in self.applied[-1].contents.values()]
        said = {each.key.finger.id: each.sensations[0].contrast_db or 0.0 for each in contents}
        return {id: contrast - said[id] for id, contrast in self.contrasts().items()}

    @property
    def beyond_quiet_db(self) -> dict[int, float]:
        """By how much levels at fingers that are to feel nothing are beyond what is said [dB]."""
        levels, said = self.levels_db_sl(), self.applied[-1].quiet_levels
        return {key.id: levels[key.id] - level for key, (level,) in said.items()}

    @property
    def places(self) -> dict[int, list[Position]]:
        """Where fingers were for which new reports play something [m]."""
        contents = [one.content for each in self.new for one in each.contents.values()]
        places = [(each.key.id, (each.x, each.y)) for one in contents for each, _ in one.targets]
        return {id: sorted({at for other, at in places if other == id}) for id, _ in places}

    @property
    def effects_played(self) -> list[str | None]:
        """Names of what new reports play."""
        contents = [one.content for each in self.new for one in each.contents.values()]
        return [each.target.content for each in contents]

    @property
    def depths(self) -> dict[int, float]:
        """How deep the envelope at each finger comes and goes 20 times a second, 1 for to zero."""
        now, bench = threads.now(), self.far.bench
        bench.advance(now)
        found = dict[int, float]()
        for id, record in bench.sample_fingers().felt(now - 0.5, now).items():
            envelope = np.abs(hilbert(record.accelerations @ record.weights))[200:-200]
            times = np.arange(len(envelope)) / bench.sample_rate
            part = envelope * np.hanning(len(envelope))
            swing = (part * np.exp(-2j * np.pi * 20.0 * times)).sum()
            found[int(id)] = float(2 * abs(swing) / part.sum())
        return found


def places_of(fingers: Mapping[int, str | Position]) -> dict[int, Position]:
    """Places [m] of fingers, some by name."""
    named = {"left": LEFT, "right": RIGHT, "above": ABOVE}
    return {id: named[at] if isinstance(at, str) else (at[0], at[1]) for id, at in fingers.items()}


def felt(report: PlayReport | None) -> dict[int, FingerSensation]:
    """The predicted sensation of each target, by the number of its finger."""
    targets = report.targets if report else ()
    return {target.contact.key.id: target for target in targets}


def verdicts(report: PlayReport) -> dict[int, str]:
    """The verdict on each target, by the number of its finger."""
    return {id: target.sensation.verdict for id, target in felt(report).items()}


def _lasting(report: PlayReport | None) -> dict[int, Content]:
    contents = [one.content for one in report.contents.values()] if report else []
    return {each.key.finger.id: each for each in contents if each.key.voice == 0}


def _worst(report: PlayReport | None) -> float:
    return min(each.sensation.promised_contrast_db or 0.0 for each in felt(report).values())


WIRES = {
    "serial": SimulatedWire("serial", speed=921_600, unpluggable=True),
    "modbus-rtu": SimulatedWire("modbus-rtu", speed=115_200, unpluggable=True),
    "modbus-tcp": SimulatedWire("modbus-tcp"),
    "socketcand": SimulatedWire("socketcand", speed=500_000),
}
"""Wires at their default speeds."""

_LEAST_PAUSE, _PAUSE_STEP = 0.1, 0.0137  # s; between presses, at another phase of heartbeats


@dataclass(frozen=True)
class Felt:
    """What a finger feels from one start of a vibration on.

    delay [s]: after the finger came down; applied: its report; accelerations (n, p) [m/s²];
    weights (p,) of the points in the mean over the fingertip; threshold: name of the rig's set.
    """

    delay: float
    applied: PlayReport
    accelerations: FloatArray
    weights: FloatArray
    sample_rate: float
    threshold: str

    @property
    def promised_db_sl(self) -> float:
        """The level that the controller reported."""
        (prediction,) = self.applied.targets
        return prediction.level_db_sl

    @property
    def frequency(self) -> float:
        """The only frequency that plays [Hz]."""
        (frequency,) = {tone.frequency for tone in self.applied.layer.excitation.values()}
        return frequency

    def level_db_sl(self, duration: float, *, since: float = 0.0) -> float:
        """Level of the rms over a part of it [s], mean over the fingertip's points."""
        first, last = round(since * self.sample_rate), round((since + duration) * self.sample_rate)
        rms = np.sqrt((self.accelerations[first:last] ** 2).mean(axis=0))
        threshold = detection_threshold(np.array(self.frequency), self.threshold)
        return float(20 * np.log10(np.sqrt(2) * rms @ self.weights / threshold))


@dataclass
class Pressed:
    """A layout on a rig and its table behind a wire; along plain ramps unless it is shaped."""

    rig: Rig
    table: LocalizationTable
    layout: SurfaceLayout
    wire: str
    resting: Sequence[Position] = ()
    is_shaped: bool = True

    def press(self, *ways: Callable[[float], Position], held: float = 0.15) -> list[list[Felt]]:
        """Press for a time [s] along each way, the position [m] by the time since the press.

        Returns what starts at each press, each up to where the finger moves on.
        """
        with pytest.MonkeyPatch.context() as patched:
            if not self.is_shaped:
                plain = "controller.play.shared_capabilities.envelope_support"
                patched.setattr(plain, lambda rig, amplifiers: RAMPS_ONLY)
            return run_virtual(self._run(ways, held))

    async def _run(
        self, ways: Sequence[Callable[[float], Position]], held: float
    ) -> list[list[Felt]]:
        source, timing = EffectPlayer(self.layout), Timing(self.table)
        felt = []
        async with _Starts.armed(
            WIRES[self.wire], self.rig, self.table, intent_source=source, timing=timing
        ) as chain:
            chain.must_be_felt = False
            chain.at = dict(enumerate(self.resting))
            await chain.hold(0.5)
            for number, way in enumerate(ways, start=1):
                felt.append(await chain.press(100 + number, way, held))
                await chain.hold(_LEAST_PAUSE + _PAUSE_STEP * number)
        return felt


@dataclass
class _Starts(Chain):
    """A chain of which every start of a vibration is known."""

    starts: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Note when a tone starts."""
        super().__post_init__()
        amplifier = self.far.amplifier

        def note(*_: object) -> None:
            tones = [tone for each in amplifier.outputs for tone in each]
            origins = {tone.began for tone in tones if tone.transition.last}
            self.starts += sorted(origins - {*self.starts})

        after_each(self.far.device, note)

    async def press(self, id: int, way: Callable[[float], Position], held: float) -> list[Felt]:
        """Press once; records end where the finger moves."""
        self.starts.clear()
        self.applied.clear()
        felt, touched = list[Felt](), threads.now()

        def move(since: float) -> None:
            if self.at.get(id) not in (None, way(since)):
                felt.extend(self._harvest(str(id), touched))
            self.at[id] = way(since)

        await self.hold(held, move)
        felt += self._harvest(str(id), touched)
        del self.at[id]
        return felt

    def _harvest(self, finger: str, touched: float) -> list[Felt]:
        """What the finger has felt at its last position."""
        now, bench, felt = threads.now(), self.far.bench, list[Felt]()
        bench.advance(now)
        for start in self.starts:
            applied = min(self.applied, key=lambda each: abs(each.time - start))
            record = bench.sample_fingers().felt(start, now)[finger]
            felt.append(
                Felt(
                    start - touched,
                    applied,
                    record.accelerations[record.times > start],
                    record.weights,
                    bench.sample_rate,
                    bench.rig.threshold,
                )
            )
        self.starts.clear()
        self.applied.clear()
        return felt


@dataclass
class Watched(Acted):
    """A chain under a running supervisor, and what that has reported.

    failing: of states, links, refusals, alive and cycles that whose observer raises.
    """

    supervisor: Supervisor = field(init=False)
    states: list[DaemonState] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    alive: list[float] = field(default_factory=list)
    cycles: list[float] = field(default_factory=list)
    failing: str = ""

    @property
    def state(self) -> DaemonState:
        """The state of the daemon."""
        return self.supervisor.operation.state

    @property
    def is_armed(self) -> bool:
        """Whether the daemon is, or any amplifier."""
        return self.state is DaemonState.OPERATION_ENABLED or super().is_armed

    @property
    def is_alive(self) -> bool:
        """Whether it never was without a sign of life for more than 0.6 s."""
        moments = [*self.alive, threads.now()]
        return max(b - a for a, b in itertools.pairwise(moments)) <= 0.6

    async def take(self, step: Step) -> None:
        """Take a step, which may be an event in capitals."""
        if isinstance(step, str) and step.isupper():
            await self.does(step)
        else:
            await super().take(step)

    async def handle(self, event: DaemonEvent) -> None:
        """Let the supervisor handle an event, and a stop as a client's."""
        if event.trigger is Trigger.STOP:
            await self.supervisor.stop(event.cause)
        else:
            await self.supervisor.handle(event)

    async def does(self, trigger: str) -> None:
        """Let the supervisor handle an event of this kind."""
        await self.handle(DaemonEvent(Trigger[trigger]))

    async def leases(self, seconds: float) -> None:
        """Arm for a client, for so long."""
        await self.handle(DaemonEvent(Trigger.ARM, lease=Lease("me", seconds)))

    def renews(self) -> None:
        """Renew the lease."""
        assert self.supervisor.operation.lease is not None
        self.supervisor.renew(self.supervisor.operation.lease)

    async def stops(self, **confirmed: bool) -> None:
        """Stop all; it is confirmed, or not, that they are silent."""
        stopped = await self.supervisor.stop("as told")
        assert {name: each.is_confirmed for name, each in stopped.items()} == confirmed

    def becomes(self, serial_number: str) -> None:
        """Have another amplifier in place of the first."""
        self.far_end.amplifier.identity["serial_number"] = serial_number
        self.far_end.disturb()

    def fails_once(self, method: str) -> None:
        """Let a method of the controller fail once, while the amplifier is reached."""
        work, failures = getattr(self.controller, method), [LinkError("as told")]

        async def fail() -> None:
            if failures:
                assert self.far_end.is_open
                raise failures.pop()
            await work()

        setattr(self.controller, method, fail)

    def energised_in(self, seconds: float, expected: bool) -> None:
        """Require that amplifiers are taken for energised, or not, in some seconds."""
        now = threads.now()
        assert self.supervisor.reopening.assume_energised(now + seconds) is expected


@asynccontextmanager
async def watched(
    *amplifiers: str,
    refuses: bool = False,
    unplugged: bool = False,
    breaks: str | None = None,
    **options: Any,
) -> AsyncIterator[Watched]:
    """A supervisor with a running control loop, which must end when it is closed.

    amplifiers: one unless more are named; refuses: whether it refuses all requests at first;
    unplugged: whether the first is not reached then;
    breaks: the only rules that are broken; options: as for `set_chain`.
    """

    def heard(name: str, value: object) -> None:
        if daemon.failing == name:
            raise Planted(name)
        getattr(daemon, name).append(value)

    async with set_chain(*amplifiers, of=Watched, **options) as daemon:
        supervisor = Supervisor(daemon.controller, alive=lambda: heard("alive", threads.now()))
        supervisor.current.observers.append(lambda old, new: heard("states", new.state))
        supervisor.link_observers.append(lambda event, lost, message: heard("links", event))
        daemon.supervisor = supervisor
        loop = daemon.controller.cycle.observers
        loop.cycle_completed.append(lambda: heard("cycles", threads.now()))
        loop.refused.append(lambda reason: heard("refused", reason))
        if refuses:
            daemon.refuse("GetCaps")
        if unplugged:
            daemon.fault("unplug", of=0)
        running = asyncio.create_task(supervisor.run())
        await supervisor.started.wait()
        await asyncio.sleep(0.005)
        try:
            yield daemon
        finally:
            daemon.failing = ""
            daemon.host_rules.commanded("disarm")
            await supervisor.close("end of the test")
            await asyncio.wait_for(running, 20)
            assert not any(each.is_open for each in daemon.far_ends)
        daemon.judge(breaks)


def message(*arguments: Any, address: str = "/tuio/2Dcur") -> Any:
    """An OSC message with python-osc's own choice of types."""
    builder = OscMessageBuilder(address)
    for argument in arguments:
        builder.add_arg(argument)
    return builder.build()


def bundle(*messages: Any) -> bytes:
    """A bundle as a TUIO sender makes it."""
    builder = OscBundleBuilder(IMMEDIATELY)
    for part in messages:
        builder.add_content(part)
    return builder.build().dgram


def cursor(id: int, x: float, y: float) -> Any:
    """A set message of a cursor at rest."""
    return message("set", id, x, y, 0.0, 0.0, 0.0)


def frame(*touches: tuple[int, float, float], fseq: int = -1, source: str = "table@a") -> bytes:
    """A complete bundle."""
    return bundle(
        message("source", source),
        message("alive", *(id for id, _, _ in touches)),
        *(cursor(*touch) for touch in touches),
        message("fseq", fseq),
    )


def free_port() -> int:
    """Find a free UDP port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def panel(port: int) -> str:
    """The lines of a daemon's file for a TUIO panel."""
    return f'touch: [{{name: panel, url: "tuio:127.0.0.1:{port}?timeout=0.15"}}]\n'


FRAME = 1 / 50  # s


def write_schedule(
    path: Path, schedule: Sequence[tuple[int, float, float, float, float]], seconds: float
) -> Path:
    """Write a TUIO capture of fingers: id, down and up [s], place in TUIO's coordinates."""
    datagrams = []
    for number in range(round(seconds / FRAME)):
        now = number * FRAME
        touches = tuple(Touch(id, x, y) for id, down, up, x, y in schedule if down <= now < up)
        frame = TouchFrame("test", now, touches)
        datagrams.append(RecordedDatagram(now, tuio_datagram(frame, number + 1)))
    write_capture(path, datagrams)
    return path
