"""Fingers on a layout in virtual time: real bytes on a wire, the paper's plate, what is felt."""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pytest
from scipy.signal import hilbert

from cases import read_yaml
from controller.daemon.plate_view import PlateView
from controller.effects.layout import SurfaceLayout, layout_of
from controller.effects.player import EffectPlayer
from controller.play.intent import CLICK, FingerTarget, Target
from controller.play.joint_answers import answered, selection_of
from controller.play.reports import PlayReport
from controller.play.selected_contents import (
    Content,
    ContentKey,
    FingerSensation,
    Question,
    Selection,
)
from controller.play.shared_capabilities import PlaybackCapabilities
from controller.sources.touch import Contact
from drivers.errors import CommandRefused
from drivers.host.set_admission import StagedSet
from drivers.protocol.sets import LayerSet
from kit.chain import Chain, Position
from kit.fingers import answers_take
from kit.fingers import table as paper_table
from kit.plates import smooth_rig
from model.answer.answer_report import Timing
from model.arrays import FloatArray
from model.config.document import data_text, parse_document
from model.errors import InputError
from model.finger import detection_threshold
from model.rig.rig import Channel
from model.table.table import LocalizationTable
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire

LEFT, RIGHT, ABOVE = (0.126, 0.081), (0.234, 0.049), (0.069, 0.208)
"""Positions on the paper's plate [m], 11 to 23 cm apart."""
LAYOUTS: Mapping[str, SurfaceLayout] = {
    name: layout_of(parse_document(name, data_text(document)), None)
    for name, document in read_yaml(Path(__file__).with_name("layouts.yaml")).items()
}
LAYOUT = LAYOUTS["plain"]
"""Each of three regions has a buzz of 14 dB SL promised, of which 15 to 18 are felt."""
SILENT_POWER = 1e-9
"""The power over threshold at which there is no tone."""


def question_for(
    targets: Sequence[tuple[Contact, Target]],
    playing: Mapping[ContentKey, Content] = MappingProxyType({}),
) -> Question:
    """A question for fingers with continuous targets, on a plate without others."""
    fingers = tuple([FingerTarget(contact, target) for contact, target in targets])
    contacts = tuple([finger.contact for finger in fingers])
    return Question(contacts, fingers, (), playing=playing)


def choose_for(
    targets: Sequence[tuple[Contact, Target]],
    capabilities: PlaybackCapabilities,
    *,
    playing: Mapping[ContentKey, Content] = MappingProxyType({}),
) -> Selection:
    """The selection for fingers with continuous targets, on a plate without others."""
    question = question_for(targets, playing)
    answer = answered(paper_table(), question, question.lasting, capabilities)
    return selection_of(paper_table(), question, answer, question.lasting)


def level_db(power: float) -> float:
    """A power over threshold as a level [dB SL]."""
    return float(10 * np.log10(power))


class Reached(NamedTuple):
    """Amplitudes of tones at a fingertip, over threshold."""

    weights: FloatArray
    """Weights (p,) of the points of the fingertip."""
    own: FloatArray
    """Amplitudes (f, p) of tones at the frequency reported for the finger."""
    crosstalk: FloatArray
    """Amplitudes (f, p) of all other tones."""

    @property
    def level(self) -> float:
        """Level of the own tone as a mean over the fingertip [dB SL]."""
        (amplitude,) = self.own @ self.weights / self.weights.sum()
        return level_db(amplitude**2)

    @property
    def crosstalk_level(self) -> float:
        """Level of the other tones at the loudest point [dB SL]."""
        return loudest(self.crosstalk)


def loudest(amplitudes: FloatArray) -> float:
    """Level [dB SL] of tones (f, p) at the loudest point."""
    powers = (amplitudes**2).sum(axis=0)
    return level_db(powers.max(initial=SILENT_POWER))


def sensations(report: PlayReport) -> dict[int, FingerSensation]:
    """The predicted sensation of each target, by finger."""
    return {target.contact.key.id: target for target in report.targets}


@dataclass
class Fingers(Chain):
    """Fingers by id, and what was sent and reported for them."""

    def __post_init__(self) -> None:
        """Record what requests of the host change."""
        super().__post_init__()
        self.committed = self.far_end.committed
        """Time [s], token and layers of every set and silence (no layers)."""

    @property
    def player(self) -> EffectPlayer:
        """The player of the layout."""
        player = self.controller.intent_source
        assert isinstance(player, EffectPlayer)
        return player

    def play(self, effect: str, id: int = 1) -> None:
        """Play an effect at a finger, as a client does."""
        contacts = {contact.key.id: contact for contact in self.applied[-1].contacts}
        self.player.play(effect, contacts[id], threads.now(), level_db_sl=None)
        self.controller.cycle.request_update()

    def reached(self, *, over: float = 0.25) -> dict[int, Reached]:
        """What has reached each finger in the last seconds."""
        now = threads.now()
        bench = self.far.bench
        bench.advance(now)
        targets = sensations(self.applied[-1]) if self.applied else {}
        reached = {}
        for name, felt in bench.felt(now - over, now).items():
            thresholds = detection_threshold(np.array(felt.frequencies), bench.rig.threshold)
            amplitudes = felt.amplitude / thresholds[:, None]
            target = targets.get(int(name))
            own_frequency = target.frequency if target else None
            is_own = np.isclose(felt.frequencies, own_frequency or 0.0, atol=0.2)
            reached[int(name)] = Reached(felt.weights, amplitudes[is_own], amplitudes[~is_own])
        return reached

    def contrasts(self) -> dict[int, float]:
        """Level of each finger's content over the crosstalk there [dB], as the table defines it.

        Fingers without a content of their own, or without crosstalk, are left out.
        """
        contrasts = {}
        for id, reached in self.reached().items():
            if len(reached.own) == 1 and len(reached.crosstalk):
                contrasts[id] = reached.level - reached.crosstalk_level
        return contrasts

    def levels_db_sl(self) -> dict[int, float]:
        """Level [dB SL] at each finger's loudest point."""
        reached = self.reached().items()
        return {id: loudest(np.concatenate([tip.own, tip.crosstalk])) for id, tip in reached}

    def crosstalk_levels(self) -> dict[int, float]:
        """Level [dB SL] of tones that are not its own at each finger's loudest point."""
        return {id: reached.crosstalk_level for id, reached in self.reached().items()}


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

    of: their class; at: fingers that are held for a time [s] first; breaks: the only rule that
    the test breaks.
    """
    rig = smooth_rig()
    count = len(amplifiers)
    wiring = {
        era: Channel(amplifiers[number % count], number // count)
        for number, era in enumerate(rig.wiring)
    }
    async with of.armed(
        SimulatedWire("serial", speed=921_600, unpluggable=True),
        replace(rig, wiring=wiring, amplifiers=dict.fromkeys(amplifiers, "memory://")),
        table,
        intent_source=EffectPlayer(layout),
        timing=Timing(table),
        capabilities={"layers": layers},
        breaks=breaks,
    ) as fingers:
        fingers.at = {**at}
        await fingers.hold(held)
        yield fingers


class Commit(NamedTuple):
    """A set, or a silence without layers, that the first amplifier carried out."""

    time: float
    """Time since the mark [s]."""
    layers: Sequence[LayerSet]

    @property
    def numbers(self) -> list[int]:
        """The numbers of its layers."""
        return sorted(layer.layer for layer in self.layers)

    @property
    def is_change(self) -> bool:
        """Whether it changes active layers: it is no renewal and adds no ending."""
        for layer in self.layers:
            if layer.renew or any(command.ending for command in layer.commands):
                return False
        return True


@dataclass
class Hands(Fingers):
    """Fingers, and what has been committed and reported since a mark."""

    patch: pytest.MonkeyPatch = field(default_factory=pytest.MonkeyPatch)
    """Changes of the product that `restore` undoes."""
    marked_at: float = 0.0
    """When the mark was set [s]."""
    marked_reports: int = 0
    marked_commits: int = 0
    former_report: PlayReport | None = None
    """The last report before the mark."""

    def mark(self) -> None:
        """Set the mark."""
        self.marked_at = threads.now()
        self.former_report = self.applied[-1] if self.applied else None
        self.marked_reports = len(self.applied)
        self.marked_commits = len(self.committed)

    async def slide(self, seconds: float, dx: float, dy: float, *ids: int) -> None:
        """Hold all fingers for a time; some move by a distance [m] meanwhile."""
        starts = {id: self.at[id] for id in ids}

        def move(since: float) -> None:
            share = since / seconds
            for id, (x, y) in starts.items():
                self.at[id] = (x + share * dx, y + share * dy)

        await self.hold(seconds, move)

    def spread(self, count: int) -> None:
        """Have so many fingers 5 cm apart or more, numbered from 1."""
        self.controller.cycle.tracker.max_fingers = count
        for number in range(count):
            column, row = number % 5, number // 5
            self.at[number + 1] = (0.04 + 0.055 * column, 0.035 + 0.05 * row)

    def choose_layout(self, name: str) -> None:
        """Replace the layout."""
        self.player.replace(LAYOUTS[name])
        self.controller.cycle.request_update()

    def slow_answers(self, *seconds: float) -> list[float]:
        """Let answers of the thread take these times, the last one from then on.

        Returns when [s] answers were asked for.
        """
        return answers_take(self.patch, *seconds)

    def fail_answers(self, error: Exception) -> list[Exception]:
        """Let answers raise an error; returns the errors that were raised."""
        raised = []

        def fail(*_: object, **__: object) -> None:
            raised.append(error)
            raise error

        self.patch.setattr("controller.play.chooser.answered", fail)
        return raised

    def refuse_answers(self, reason: str) -> None:
        """Let the table refuse all questions."""
        self.fail_answers(InputError(reason))

    def refuse_layers(self, reason: str, least: int) -> list[float]:
        """Let the ledger refuse so many new layers that vibrate, or more.

        Returns when it refused some [s], after the mark.
        """
        slots = self.controller.cycle.planner.slots
        check = slots.check
        refusals: list[float] = []

        def refuse(sets: Mapping[str, StagedSet]) -> CommandRefused | None:
            vibrating = [
                layer
                for layer in sets["main"].requested
                if not layer.renew and any(tone.level for tone in layer.tones)
            ]
            if len(vibrating) < least:
                return check(sets)
            refusals.append(threads.now() - self.marked_at)
            return CommandRefused(reason)

        self.patch.setattr(slots, "check", refuse)
        return refusals

    def refuse_next_set(self) -> None:
        """Let the amplifier refuse the next set."""
        group = self.controller.group

        async def refuse(*_: object, **__: object) -> None:
            self.patch.undo()
            raise CommandRefused("not now")

        self.patch.setattr(group, "play", refuse)

    def degrade(self) -> None:
        """Let the amplifier not reply, while it may play."""
        members = self.controller.group.members
        self.patch.setattr(type(members), "degraded", ("main",))

    def restore(self) -> None:
        """Undo all changes of the product."""
        self.patch.undo()

    def status(self, key: str) -> dict[int, Any]:
        """A value of each finger's status."""
        reports = [*self.applied[-1:], *self.silenced[-1:]]
        report = max(reports, key=lambda report: report.time, default=None)
        contacts = self.controller.cycle.tracker.contacts
        view = PlateView(self.player.effect_of, contacts, report)
        rows = view.statuses_now(paper_table())
        return {row.id: getattr(row, key) for row in rows}

    @property
    def is_loud(self) -> bool:
        """Whether any channel plays."""
        return any(max(levels) > 0 for levels in self.levels().values())

    @property
    def new_reports(self) -> list[PlayReport]:
        """Reports of active layers since the mark."""
        return self.applied[self.marked_reports :]

    @property
    def new_commits(self) -> list[Commit]:
        """What was committed since the mark."""
        commits = self.committed[self.marked_commits :]
        return [Commit(time - self.marked_at, layers) for time, _, layers in commits]

    @property
    def changes(self) -> list[list[int]]:
        """Layers of each new set that changes active layers; none for a silence."""
        return [commit.numbers for commit in self.new_commits if commit.is_change]

    @property
    def new_layers(self) -> list[LayerSet]:
        """The layers of new sets that are no renewals."""
        layers = [layer for commit in self.new_commits for layer in commit.layers]
        return [layer for layer in layers if not layer.renew]

    @property
    def driven(self) -> dict[int, bool]:
        """Of layers of new sets, whether they vibrate after the last one."""
        return {
            layer.layer: any(command.level for command in layer.commands)
            for layer in self.new_layers
        }

    @property
    def ramps(self) -> dict[int, int]:
        """Of layers of new sets, the last ramp [ms]."""
        return {layer.layer: layer.ramp for layer in self.new_layers}

    @property
    def continued(self) -> dict[int, set[bool]]:
        """Of layers of the first new set, whether their tones continue in phase."""
        first = self.new_commits[0]
        return {
            layer.layer: {command.keep_phase for command in layer.commands}
            for layer in first.layers
        }

    def times_of(self, layer: int) -> list[float]:
        """When new sets of a layer were committed [s], after the mark."""
        return [commit.time for commit in self.new_commits if layer in commit.numbers]

    @property
    def latencies(self) -> list[float | None]:
        """The latencies of new reports [s]."""
        return [report.latency for report in self.new_reports]

    @property
    def contents(self) -> list[Content]:
        """The active contents of the last report."""
        return [slot.content for slot in self.applied[-1].contents.values()]

    @property
    def layers(self) -> dict[int, list[int]]:
        """Active layers, by finger."""
        layers: dict[int, list[int]] = {}
        for number, slot in self.applied[-1].contents.items():
            layers.setdefault(slot.content.key.finger.id, []).append(number)
        return layers

    @property
    def frequencies(self) -> list[float]:
        """Active frequencies [Hz], sorted."""
        return sorted(content.frequency or 0.0 for content in self.contents)

    @property
    def spacing(self) -> float:
        """The smallest distance of two active frequencies [Hz]."""
        return min(upper - lower for lower, upper in pairwise(self.frequencies))

    @property
    def click_frequencies(self) -> list[float | None]:
        """Frequencies of active clicks [Hz]."""
        return [content.frequency for content in self.contents if content.key.voice == CLICK]

    @property
    def kept_frequencies(self) -> bool:
        """Whether all fingers keep, in new reports, the frequencies that they had at the mark."""
        assert self.former_report is not None
        former = sensations(self.former_report)
        for report in self.new_reports:
            for id, sensation in sensations(report).items():
                if id in former and sensation.frequency != former[id].frequency:
                    return False
        return True

    @property
    def held_back(self) -> dict[int, str | None]:
        """The reported reason why a finger does not feel a content of its own."""
        return {id: felt.held_back for id, felt in sensations(self.applied[-1]).items()}

    @property
    def played_effects(self) -> list[str | None]:
        """Names of the effects in new reports."""
        contents = [
            slot.content for report in self.new_reports for slot in report.contents.values()
        ]
        return [content.target.content for content in contents]

    @property
    def served_positions(self) -> dict[int, set[Position]]:
        """Where fingers were for which new reports state contents [m]."""
        positions: dict[int, set[Position]] = {}
        for report in self.new_reports:
            for slot in report.contents.values():
                for contact, _ in slot.content.targets:
                    positions.setdefault(contact.key.id, set()).add((contact.x, contact.y))
        return positions

    def depths(self) -> dict[int, float]:
        """How deep the envelope at each finger beats 20 times a second; 1 is down to zero."""
        now = threads.now()
        bench = self.far.bench
        bench.advance(now)
        depths = {}
        for id, record in bench.sample_fingers().felt(now - 0.5, now).items():
            envelope = np.abs(hilbert(record.accelerations @ record.weights))[200:-200]
            times = np.arange(len(envelope)) / bench.sample_rate
            windowed = envelope * np.hanning(len(envelope))
            swing = np.sum(windowed * np.exp(-2j * np.pi * 20.0 * times))
            depths[int(id)] = float(2 * abs(swing) / windowed.sum())
        return depths


def worst_promise(report: PlayReport | None) -> float:
    """The lowest contrast that a report promises a finger [dB]."""
    assert report is not None
    targets = sensations(report).values()
    return min(target.sensation.promised_contrast_db or 0.0 for target in targets)


def lasting_contents(report: PlayReport | None) -> dict[int, Content]:
    """The continuous content of each finger that has one, without side bands."""
    assert report is not None
    contents = [slot.content for slot in report.contents.values()]
    return {content.key.finger.id: content for content in contents if content.key.voice == 0}


@asynccontextmanager
async def hands(
    fingers: Mapping[int, Position] = MappingProxyType({}),
    *,
    layout: str = "plain",
    held: float = 0.0,
    layers: int = 8,
    amplifiers: Sequence[str] = ("main",),
    breaks: str | None = None,
) -> AsyncIterator[Hands]:
    """Fingers on a layout of `layouts.yaml`, held for a time [s], with a first mark."""
    async with fingers_on(
        paper_table(),
        LAYOUTS[layout],
        of=Hands,
        at=fingers,
        held=held,
        layers=layers,
        amplifiers=amplifiers,
        breaks=breaks,
    ) as chain:
        with pytest.MonkeyPatch.context() as chain.patch:
            chain.mark()
            yield chain


def has_no_thread(patch: pytest.MonkeyPatch) -> None:
    """Let the system have no thread left."""

    def exhausted(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    patch.setattr(type(asyncio.get_running_loop()), "run_in_executor", exhausted)
