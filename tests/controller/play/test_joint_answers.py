"""Answers for all fingers together, on the plate in virtual time.

What moving fingers are promised; fingers at rest that are answered again once the cause that held
one of them back has passed; and the steps from active contents to a better answer. Two fingers that
land 0.35 s apart on the paper's plate are promised 8.9 dB, because the frequency of the first is
kept, and 19.5 dB if they land together; on the way both frequencies change.
"""

import math
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cases import shortly
from controller.play.crossfades import Crossfades
from controller.play.intent import HapticIntent, Target
from controller.play.joint_answers import answered, with_paths
from controller.play.layers import CROSSFADE
from controller.play.reports import PlayReport
from controller.play.selected_contents import Content, ContentKey, Selection
from controller.play.shared_capabilities import RAMPS_ONLY
from controller.sources.touch import Contact, ContactKey, Track, track_with
from drivers.host.group import Group
from kit.chain import Chain, Position
from kit.clock import in_virtual_time
from kit.fingers import playable
from kit.fingers import table as paper_table
from kit.plates import contact_sets, smooth_rig
from kit.wires import on_two_amplifiers
from model.answer.answer import Answer, Limits
from model.answer.answer_report import Timing
from model.answer.stimulus import Finger, Placement, Stimulus
from model.arrays import FloatArray
from model.config.shapes import Rectangle
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig
from model.study.contact_sets import random_contacts
from model.study.exact_plates import draw_plates, harmonics_on, powers_on
from model.table.fingertip_shapes import read_fingertips
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from registry import threads
from sim.far_ends.wire_assignment import SimulatedWire
from tests.controller.play.fingers_on_layouts import (
    LAYOUT,
    LEFT,
    RIGHT,
    Fingers,
    choose_for,
    fingers_on,
    question_for,
    worst_promise,
)

BUS = SimulatedWire("serial", speed=921_600, shared=True, line_kind="prompt")
LINES = SimulatedWire("serial", speed=921_600, unpluggable=True)
MIN_SPACING = 30.0  # Hz


@dataclass
class EachItsOwn:
    """Every finger is to feel a buzz of its own."""

    band: tuple[float, float] | None = None
    """The band of its frequency [Hz]."""
    gain_db: float = 0.0

    def intent(self, contacts: Sequence[Contact], now: float) -> HapticIntent:
        """Return a target for each contact."""
        targets = [Target(contact.key, 14.0, band=self.band) for contact in contacts]
        gains = {(contact.key, False): self.gain_db for contact in contacts}
        return HapticIntent(tuple(targets), gains_db=gains)

    def has_effect_at(self, contact: Contact) -> bool:
        """Return True: every contact has one."""
        return True


@cache
def eight_eras() -> Rig:
    """The example with eight ERAs, on two amplifiers."""
    path = Path(__file__).parents[3] / "examples" / "eight_eras.yaml"
    return load_rig(path, mesh="12x9")


@cache
def table_of_eight() -> LocalizationTable:
    """Its table at 24 frequencies."""
    return build_table(eight_eras(), frequencies=np.linspace(40.0, 500.0, 24))


def count_served(chain: Chain) -> int:
    """How many fingers feel a content of their own."""
    targets = chain.applied[-1].targets if chain.applied else ()
    return len([target for target in targets if target.held_back is None])


@asynccontextmanager
async def three_fingers_on_a_bus(number: int) -> AsyncIterator[Chain]:
    """Eight ERAs on one bus, open, and three fingers at random positions for 0.3 s."""
    timing = Timing(table_of_eight())
    chain = Chain.on(BUS, eight_eras(), table_of_eight(), intent_source=EachItsOwn(), timing=timing)
    async with chain as fingers:
        fingers.is_felt = fingers.must_be_felt = False
        await fingers.open()
        positions = contact_sets(24, fingers=3, seed=5)[number]
        fingers.at = dict(enumerate(positions))
        await fingers.hold(0.3)
        yield fingers
        await fingers.close()


@pytest.mark.parametrize("number", shortly(range(24), range(3)))
@in_virtual_time
async def test_fingers_down_before_arming_are_served_as_those_that_land_after_it(
    number: int,
) -> None:
    """The clocks of two amplifiers on one bus are known only after arming.

    Within 0.2 s no fewer fingers feel a content than once the same fingers land again.
    """
    async with three_fingers_on_a_bus(number) as fingers:
        await fingers.operate("arm")
        await fingers.hold(0.2)
        resting_count = count_served(fingers)

        positions, fingers.at = fingers.at, {}
        await fingers.hold(0.02)
        fingers.at = positions
        await fingers.hold(0.2)
        assert resting_count >= count_served(fingers)


@in_virtual_time
async def test_resting_fingers_are_served_once_clocks_are_held(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Contents on one amplifier each leave a finger out; 0.3 s after both clocks are held none."""
    errors = {"a": math.inf, "b": math.inf}
    monkeypatch.setattr(Group, "clock_errors", property(lambda group: errors))
    async with three_fingers_on_a_bus(0) as fingers:
        await fingers.operate("arm")
        await fingers.hold(0.5)
        assert 0 < count_served(fingers) < 3
        errors |= {"a": 4e-6, "b": 4e-6}
        await fingers.hold(0.3)
        assert count_served(fingers) == 3


@asynccontextmanager
async def two_fingers(rig: Rig | None = None, **options: Any) -> AsyncIterator[Chain]:
    """Two fingers on the paper's plate, armed, each with a buzz of its own for 0.5 s."""
    table = paper_table()
    given = {"intent_source": EachItsOwn(), "timing": Timing(table), **options}
    async with Chain.on(LINES, rig or smooth_rig(), table, **given) as fingers:
        fingers.is_felt = fingers.must_be_felt = False
        await fingers.open()
        await fingers.operate("arm")
        fingers.at = {1: LEFT, 2: RIGHT}
        await fingers.hold(0.5)
        yield fingers
        await fingers.close()


@pytest.mark.parametrize(
    ("impossible", "possible"),
    [
        (EachItsOwn(band=(99.0, 101.0)), EachItsOwn()),
        (EachItsOwn(gain_db=-40.0), EachItsOwn()),
    ],
    ids=["narrow band", "weak"],
)
@in_virtual_time
async def test_resting_fingers_are_served_as_the_intent_is_now(
    impossible: EachItsOwn, possible: EachItsOwn
) -> None:
    """In one narrow band, or 40 dB weaker, a finger feels nothing; without that both do."""
    source = replace(impossible)
    async with two_fingers(intent_source=source) as fingers:
        assert count_served(fingers) < 2
        source.band, source.gain_db = possible.band, possible.gain_db
        fingers.controller.cycle.request_update()
        await fingers.hold(0.3)
        assert count_served(fingers) == 2


@in_virtual_time
async def test_resting_fingers_are_served_within_present_limits() -> None:
    """An amplifier that allowed 0.3 % of its level allows all of it when it is armed again."""
    async with two_fingers(capabilities={"level_max": 30}) as fingers:
        assert count_served(fingers) == 0
        capabilities = fingers.far_end.amplifier.capabilities
        capabilities["level_max"] = 10_000
        for limits in capabilities["limits"]:
            limits["level_max"] = 10_000
        await fingers.operate("disarm")
        await fingers.operate("arm")
        await fingers.hold(0.3)
        assert count_served(fingers) == 2


@in_virtual_time
async def test_fingers_are_served_with_capabilities_that_became_smaller() -> None:
    """Firmware with fewer layers, short ramps and no envelopes is armed: no set is refused."""
    async with two_fingers() as fingers:
        assert count_served(fingers) == 2
        await fingers.operate("disarm")
        positions, fingers.at = fingers.at, {}
        await fingers.hold(0.3)

        amplifier = fingers.far_end.amplifier
        amplifier.capabilities.update(layers=4, ramp_max=200, knots=0)
        amplifier.restart(threads.now())
        await fingers.operate("arm")
        planner = fingers.controller.cycle.planner
        assert planner is not None
        assert planner.capabilities.envelope_support == RAMPS_ONLY
        assert planner.capabilities.ramp_max == 0.2
        assert planner.slots.layers.count == 4

        fingers.at = positions
        await fingers.hold(0.3)
        assert count_served(fingers) == 2
        assert fingers.refused == []


@in_virtual_time
async def test_resting_fingers_are_served_once_a_lost_amplifier_is_back() -> None:
    """Both feel their contents 0.3 s after all are open again and armed."""
    async with two_fingers(on_two_amplifiers(smooth_rig())) as fingers:
        assert count_served(fingers) == 2
        fingers.far_ends[1].fault("unplug")
        await fingers.hold(0.5)
        fingers.far_ends[1].recover()
        await fingers.controller.open()
        await fingers.controller.clear()
        fingers.applied.clear()
        await fingers.operate("arm")
        await fingers.hold(0.3)
        assert count_served(fingers) == 2


MOVER, RESTING = (0.10, 0.08), (0.22, 0.12)
NOW = 5.0


def moving_contact(number: int, at: Position, vx: float = 0.0) -> Contact:
    """A contact with a velocity [m/s], reported every 10 ms."""
    track: Track = ()
    for step in range(-5, 1):
        time = 0.01 * step
        track = track_with(track, NOW + time, at[0] + vx * time, at[1])
    return Contact(ContactKey("a", number), *at, since=0.0, track=track)


def fingers_of(contacts: Sequence[Contact]) -> list[Finger]:
    """Fingers at the contacts, each with a stimulus of its own."""
    return [
        Finger((contact.x, contact.y), Stimulus(14.0, name=str(contact.key.id)))
        for contact in contacts
    ]


def test_moving_finger_is_answered_around_the_next_8_mm() -> None:
    """At 0.2 m/s a set plays after 20 ms, and weights have half changed 20 ms later: 8 to 16 mm.

    Its three positions are 8 mm apart, the middle one in the middle of that way.
    """
    contacts = [moving_contact(1, MOVER, vx=0.2), moving_contact(2, RESTING)]
    fingers = fingers_of(contacts)
    middle, resting, first, last = with_paths(fingers, contacts, NOW, paper_table().plate)
    way = [finger.at[0] - MOVER[0] for finger in (first, middle, last)]
    assert way == pytest.approx([0.004, 0.012, 0.020])
    assert resting == fingers[1]
    assert first.load + middle.load + last.load == pytest.approx(1.0)


def contrasts_on_plates(
    answer: Answer, placement: Placement, uncertainty: Uncertainty, count: int
) -> FloatArray:
    """Contrasts (2, count) [dB] of a moving finger at three positions and a resting finger.

    The plates are drawn with tolerances and solved exactly. The crosstalk at either finger includes
    a fiftieth, over the number of ERAs, of what the other finger feels of its own content.
    """
    table = paper_table()
    rng = np.random.default_rng(3)
    plates = draw_plates(rng, uncertainty, of=table, count=count, contact_count=4)
    weights = read_fingertips(table, placement.quiet).fine_weights[0]
    powers = []  # by layer: of both fingers (points, count)
    for layer in answer.layers:
        rows, power = powers_on(table, placement, layer.excitation, plates)
        over_threshold = table.sensitivities[:, rows, None] ** 2 / table.thresholds[rows] ** 2
        felt = power[0] * over_threshold + harmonics_on(table, placement, layer.excitation, plates)
        by_position = felt.reshape(len(felt), 4, -1, count)
        moving = by_position[:, :3].mean(axis=1)
        powers.append((moving, by_position[:, 3]))

    contrasts = []
    for finger in (0, 1):
        neighbor = 1 - finger
        content, foreign_content = powers[finger], powers[neighbor]
        side_bands = 0.02 / len(table.eras) * foreign_content[neighbor].mean(axis=1)
        crosstalk = foreign_content[finger] + side_bands[:, None]
        amplitude = np.sqrt(content[finger])
        level = (weights[:, None] * amplitude).sum(axis=1)
        ratio = level / np.sqrt(crosstalk.max(axis=1))
        contrasts.append(20 * np.log10(ratio).min(axis=0))
    return np.array(contrasts)


def test_promise_on_a_way_is_that_of_the_mean_power_there_on_exact_plates() -> None:
    """A moving and a resting finger have their nominal contrasts, and promises on 90 % of plates.

    The promise is the 10th percentile over the stated tolerances.
    """
    contacts = [moving_contact(1, MOVER, vx=0.2), moving_contact(2, (0.05, 0.04))]
    targets = [
        (contact, Target(contact.key, 14.0, content=str(contact.key.id))) for contact in contacts
    ]
    question = question_for(targets)
    answer = answered(paper_table(), question, question.lasting, playable(), now=NOW)
    middle, resting, first, last = with_paths(
        fingers_of(contacts), contacts, NOW, paper_table().plate
    )
    loads = (middle.load, first.load, last.load, resting.load)
    placement = Placement((middle.at, first.at, last.at), (resting.at,), loads)

    nominal = contrasts_on_plates(answer, placement, Uncertainty.none(), 1)
    drawn = contrasts_on_plates(answer, placement, paper_table().uncertainty, 300)

    assert len(answer.layers) == 2
    sensations = answer.fingers
    predicted = [sensation.contrast_db for sensation in sensations]
    np.testing.assert_allclose(predicted, nominal[:, 0], atol=0.5, err_msg="nominal contrast")
    promises = np.array([sensation.promised_contrast_db for sensation in sensations])
    shares = (drawn >= promises[:, None]).mean(axis=1)
    np.testing.assert_allclose(shares, 0.9, atol=0.08, err_msg="share of plates")


FIRST, SECOND = (0.2133, 0.0366), (0.1206, 0.1132)
WHOLE_PLATE = replace(
    LAYOUT,
    regions=(replace(LAYOUT.regions[0], shape=Rectangle(0.0, 0.0, 0.3, 0.22), on_press="any"),),
)
"""Every finger feels the same effect, of 14 dB SL, at any frequency."""


def frequencies(report: PlayReport | Selection) -> dict[ContactKey, float]:
    """The frequency of each target, by contact."""
    targets = report.finger_sensations if isinstance(report, Selection) else report.targets
    return {target.contact.key: target.frequency or 0.0 for target in targets}


def changed_frequency(
    former: dict[ContactKey, float], later: dict[ContactKey, float]
) -> float | None:
    """The only frequency that a step changes, which keeps its distance from all former ones."""
    changes = {*later.values()} - {*former.values()}
    assert len(changes) <= 1, changes
    for frequency in changes:
        distances = [abs(frequency - former_frequency) for former_frequency in former.values()]
        assert min(distances) >= MIN_SPACING
        return frequency
    return None


async def land_apart(fingers: Fingers, *, resting: float) -> int:
    """Let two fingers land 0.35 s apart, and rest; returns how many sets served the landing."""
    fingers.at = {1: FIRST}
    await fingers.hold(0.35)
    fingers.at[2] = SECOND
    await fingers.hold(0.09)
    count = len(fingers.committed)
    await fingers.hold(resting - 0.09)
    return count


def targets_at(*positions: Position) -> list[tuple[Contact, Target]]:
    """Resting contacts with targets of 14 dB SL."""
    contacts = [
        Contact(ContactKey("a", number), *position, since=0.0)
        for number, position in enumerate(positions)
    ]
    return [(contact, Target(contact.key, 14.0)) for contact in contacts]


def by_key(selection: Selection) -> dict[ContentKey, Content]:
    """The contents of a selection by their keys."""
    return {content.key: content for content in selection.contents}


@in_virtual_time
async def test_fingers_that_land_apart_reach_the_promise_of_those_that_land_together() -> None:
    """Within 1 dB, one content at a time; simultaneous tones are 30 Hz apart.

    A new content rises in a layer of its own along 300 ms. The one that it replaces falls as long,
    81 ms later, to below any threshold; then it has ended.
    """
    together = choose_for(targets_at(FIRST, SECOND), playable())
    promise = min(
        target.sensation.promised_contrast_db or 0.0 for target in together.finger_sensations
    )
    async with fingers_on(paper_table(), WHOLE_PLATE) as fingers:
        landing_count = await land_apart(fingers, resting=0.6)
        fades = [
            (time, layers[0])
            for time, _, layers in fingers.committed[landing_count:]
            if layers[0].ramp == 300
        ]
        (rise_time, rising), (fall_time, falling) = fades[:2]
        assert (rising.layer, falling.layer) == (2, 0)
        assert fall_time - rise_time == pytest.approx(0.081, abs=0.005)
        commands = {(command.level, bool(command.keep_phase)) for command in falling.commands}
        assert commands == {(1, True)}  # level 1e-4 of the stroke

        await fingers.hold(0.3)
        assert fingers.far_end.status()["tokens"][falling.layer] == 0
        assert falling.layer not in fingers.applied[-1].contents

        await fingers.hold(0.6)
        landed, *steps = fingers.applied[1:]
        assert worst_promise(landed) < promise - 6
        assert worst_promise(steps[-1]) >= promise - 1
        for former, later in pairwise([landed, *steps]):
            assert changed_frequency(frequencies(former), frequencies(later)) is not None
        pauses = [later.time - former.time for former, later in pairwise(steps)]
        assert min(pauses) >= 0.38  # no two fade simultaneously
        assert min(fingers.contrasts().values()) >= worst_promise(steps[-1])


@in_virtual_time
async def test_finger_that_moves_again_within_a_second_is_not_led_again() -> None:
    """The last step, and the first of the next way, are a second apart or more."""
    async with fingers_on(paper_table(), WHOLE_PLATE) as fingers:
        await land_apart(fingers, resting=1.1)
        steps = [report.time for report in fingers.applied[2:]]
        assert len(steps) == 2
        fingers.at[2] = (0.20, 0.15)
        await fingers.hold(1.5)
        fades = [report.time for report in fingers.applied if report.settled_after == CROSSFADE]
        later_steps = [time - steps[-1] for time in fades[2:]]
        assert min(later_steps, default=math.inf) >= 1.0


def count_checked_steps(positions: Sequence[Position], *, has_landed: bool) -> int:
    """Check the steps of crossfades after the third finger has landed, or has left.

    Returns how many frequencies they change.
    """
    targets = targets_at(*positions)
    former = by_key(choose_for(targets[:2], playable())) if has_landed else {}
    landed = choose_for(targets, playable(), playing=former)
    resting = targets if has_landed else targets[:2]
    keys = {contact.key for contact, _ in resting}
    contents = {key: content for key, content in by_key(landed).items() if key.finger in keys}
    if {key.finger for key in contents} != keys:
        return 0
    playing = {key: hertz for key, hertz in frequencies(landed).items() if key in keys}
    count = 0
    for step in Crossfades(paper_table(), question_for(resting, contents), playable()).steps():
        later = frequencies(step)
        if changed_frequency(playing, later) is not None:
            count += 1
        playing = later
    return count


def test_every_step_keeps_30_hz_between_simultaneous_tones() -> None:
    """Of twelve random sets of three fingers, the third has landed in six and has left in six."""
    rng = np.random.default_rng(5)
    count = 0
    for number in range(12):
        positions = random_contacts(rng, 3, paper_table().plate, margin=0.013)
        count += count_checked_steps(positions, has_landed=number % 2 == 1)
    assert count >= 3


def landed_apart() -> Selection:
    """The selection for two fingers of which the second has landed later."""
    targets = targets_at(FIRST, SECOND)
    first = choose_for(targets[:1], playable())
    return choose_for(targets, playable(), playing=by_key(first))


def crossfade_steps(playing: Sequence[Content], stroke: float) -> list[Selection]:
    """Steps from active contents, if the stroke is so many times what these take."""
    amplitudes: dict[str, float] = {}
    for content in playing:
        for era, tone in content.layer.excitation.items():
            amplitudes[era] = amplitudes.get(era, 0.0) + stroke * tone.amplitude
    limited = replace(playable(), limits=Limits((40.0, 320.0), amplitudes))
    contents = {content.key: content for content in playing}
    question = question_for(targets_at(FIRST, SECOND), contents)
    return [*Crossfades(paper_table(), question, limited).steps()]


def test_no_crossfade_to_contents_that_exceed_the_stroke_together() -> None:
    """During a crossfade both contents need more than 1.2 times what is active."""
    contents = landed_apart().contents
    assert crossfade_steps(contents, stroke=1.2) == []
    assert crossfade_steps(contents, stroke=100.0) != []


def test_promise_for_a_way_is_restated_once_the_finger_rests() -> None:
    """For its way, a finger was promised 2 dB less than it is at rest."""
    landed = landed_apart()
    on_a_way = []
    for content in landed.contents:
        sensations = tuple(
            replace(sensation, promised_contrast_db=(sensation.promised_contrast_db or 0.0) - 2.0)
            for sensation in content.sensations
        )
        on_a_way.append(replace(content, sensations=sensations))

    (restated,) = crossfade_steps(on_a_way, stroke=1.2)

    assert restated.contents == landed.contents
    promises = [
        [target.sensation.promised_contrast_db for target in selection.finger_sensations]
        for selection in (restated, landed)
    ]
    assert promises[0] == pytest.approx(promises[1], abs=0.1)


def test_level_at_the_threshold_is_played_at_every_position() -> None:
    """Rounding must not hold back 0 dB SL: a detection experiment plays levels around it."""
    unserved = []
    for x in np.linspace(0.03, 0.27, 9):
        for y in np.linspace(0.03, 0.2, 7):
            key = ContactKey("panel", 1)
            target = Target(key, 0.0)
            selection = choose_for([(Contact(key, float(x), float(y), 0.0), target)], playable())
            if not selection.contents:
                unserved.append((x, y, selection.reason))
    assert unserved == []
