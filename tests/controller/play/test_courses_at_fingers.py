"""Content files at fingers, played over a wire in virtual time on the simulated plate.

They play alone, together, at the edge of the plate and under a moving finger. Magnets must stay
within their excursion.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from controller.content.pattern import Curve, Pattern, Transient, sharpness_of
from controller.daemon.plate_view import PlateView
from controller.effects.effect import Effect, Region
from controller.effects.file_effect import File
from controller.effects.kinds import Buzz
from controller.effects.layout import SurfaceLayout
from controller.effects.player import EffectPlayer
from controller.play.shared_capabilities import RAMPS_ONLY, PlaybackCapabilities
from controller.sources.touch import Contact, ContactKey
from kit.clock import in_virtual_time
from kit.fingers import ABOVE, LEFT, RIGHT, Fingers, fingers_on
from kit.fingers import table as paper_table
from model.answer.answer import Answer, Limits
from model.answer.answer_report import Timing
from model.answer.envelope import STRONGEST
from model.answer.plan import answer
from model.answer.stimulus import Finger, Stimulus
from model.arrays import ComplexArray, Point
from model.config.fields import Circle, Rectangle
from model.rig.rig import Rig, Uncertainty
from model.rig.rig_file import load_rig, parse_rig
from model.table.table import LocalizationTable
from model.table.table_file import build_table
from model.transients.base_motion import Envelopes
from processes.sound_cards import STEP, Magnets
from sim.far_ends.wire_assignment import SimulatedWire

SWELL = Pattern(1.5, ((0.0, 0.3), (0.7, 1.0), (1.5, 0.2)), ((0.0, 0.4),))
SHARPER = Pattern(1.5, SWELL.intensity, ((0.0, 0.7),))
FADING = Pattern(1.0, ((0.0, 1.0), (0.2, 0.3), (0.5, 1.0), (1.0, 0.5)), ((0.0, 0.1),))


def file_of(pattern: Pattern, of: LocalizationTable, *, loop: bool = False) -> File:
    """A file at 14 dB SL."""
    return File.of(pattern, name="it", level_db_sl=14.0, loop=loop).for_table(of.frequencies)


@in_virtual_time
async def test_of_a_buzz_and_a_file_the_later_is_felt_then_what_is_left_of_the_other() -> None:
    """By hand: 0.4 s into the file it has 12.8 dB SL, after a buzz of half a second 11.6 at 1.3 s.

    The buzz of the finger that rests goes on once both are over.
    """
    short, file = Buzz(level=14.0, duration=0.5), file_of(SWELL, paper_table())
    layout = SurfaceLayout(effects={"it": file, "short": short, "buzz": Buzz()}, elsewhere="buzz")
    async with fingers_on(paper_table(), layout, at={1: LEFT}, held=0.5) as fingers:

        def felt() -> tuple[str | None, float]:
            (target,) = fingers.applied[-1].targets
            return target.content_name, 20 * np.log10(max(fingers.far_end.levels))

        fingers.play("it")
        await fingers.hold(0.41)
        name, before = felt()
        assert name == "it"
        await fingers.hold(0.3)
        fingers.play("short")
        await fingers.hold(0.3)
        assert felt()[0] == "short"
        await fingers.hold(0.3)
        name, after = felt()
        assert (name, after - before) == ("it", pytest.approx(11.6 - 12.8, abs=0.15))
        await fingers.hold(0.5)
        assert felt()[0] == "buzz"


@pytest.mark.parametrize("at", [(0.0, 0.1), (0.01, 0.1), (0.001, 0.001), (0.3048, 0.2286)])
@in_virtual_time
async def test_a_file_has_its_level_at_the_edge_and_in_corners(at: tuple[float, float]) -> None:
    """14 dB SL as a mean over the tip where it has risen slowly; nothing is refused."""
    pattern = Pattern(2.0, ((0.0, 0.01), (0.3, 1.0), (2.0, 1.0)), ((0.0, 0.5),))
    layout = SurfaceLayout(effects={"it": file_of(pattern, paper_table())}, elsewhere="it")
    async with fingers_on(paper_table(), layout, at={1: at}, held=1.0) as fingers:
        ((_, weights, own, _),) = fingers.reached()
        level = 20 * np.log10(own @ weights / weights.sum())
        assert level == pytest.approx([14.0], abs=0.1)
        assert not fingers.refused


@cache
def eight() -> LocalizationTable:
    """Of the example with eight ERAs."""
    rig = load_rig(Path(__file__).parents[3] / "examples" / "eight_eras.yaml")
    return build_table(rig, frequencies=np.arange(60.0, 321.0, 20.0), drive_mode="phased")


@in_virtual_time
async def test_three_fingers_feel_three_files_apart() -> None:
    """Each at its own frequency with the contrast that it is promised, turn after turn.

    Every piece of each is on the wire where the one before ends.
    """
    plate, files = eight().plate, (SWELL, SHARPER, FADING)
    places = [(0.2, 0.25), (0.8, 0.2), (0.4, 0.85)]
    at = {n: (x * plate.length, y * plate.width) for n, (x, y) in enumerate(places, start=1)}
    layout = SurfaceLayout(
        tuple(Region(f"at{n}", Circle(*each, 0.03), on_press=f"f{n}") for n, each in at.items()),
        {f"f{n}": file_of(each, eight(), loop=True) for n, each in enumerate(files, start=1)},
        elsewhere=None,
    )
    async with Fingers.armed(
        SimulatedWire("serial", speed=921_600, unpluggable=True),
        load_rig(Path(__file__).parents[3] / "examples" / "eight_eras.yaml"),
        eight(),
        intent_source=EffectPlayer(layout),
        timing=Timing(eight()),
    ) as fingers:
        fingers.at = at
        await fingers.hold(0.6)
        own, foreign = np.full((2, 3), 1e-9)
        for _ in range(50):
            await fingers.hold(0.03)
            for id, weights, lasting, others in fingers.reached(over=STRONGEST):
                power = ((lasting @ weights / weights.sum()) ** 2).max(initial=0)
                own[id - 1] = max(own[id - 1], power)
                loudest = (others**2).sum(axis=0).max(initial=0)
                foreign[id - 1] = max(foreign[id - 1], loudest)
        targets = sorted(fingers.applied[-1].targets, key=lambda each: each.contact.key.id)
        promised = np.array([each.sensation.promised_contrast_db for each in targets])
        assert len({each.frequency for each in targets}) == len(targets) == 3
        assert (10 * np.log10(own / foreign) > promised).all()
        assert not fingers.refused


ALL = 60.0
"""More than any rig gives [dB SL]."""


@cache
def rig(name: str) -> Rig:
    """The weekend's as it is, down to 60 Hz, or with the larger exciters at all that they bear.

    It is known exactly, so that magnets may use all of their excursion.
    """
    path = Path(__file__).parents[3] / "examples/weekend/rig.yaml"
    text, reach = path.read_text(), "frequency: [100 Hz, 300 Hz]"
    assert reach in text
    if name == "large":
        text = text.replace("DAEX25CT-4", "DAEX25FHE-4").replace("power: 1 W", "power: 24 W")
    low = {"weekend": 90, "low": 60, "onsets": 45, "large": 40}[name]
    found = parse_rig("rig.yaml", text.replace(reach, f"frequency: [{low} Hz, 300 Hz]"))
    return replace(found, uncertainty=Uncertainty.none())


@cache
def table(name: str, frequencies: tuple[float, ...]) -> LocalizationTable:
    """Of these frequencies [Hz] alone, so that nothing else is chosen."""
    return build_table(rig(name), frequencies=np.array(frequencies), drive_mode="phased")


@cache
def magnets(name: str) -> Magnets:
    """Those of a rig."""
    return Magnets(rig(name))


def file(
    curve: Curve, hertz: float, taps: Sequence[float] = (), *, to: float | None = None
) -> Effect:
    """A file of this intensity and of taps at times [s], all that is played; to: swept."""
    first, last = sharpness_of(np.array([hertz, to or hertz])).tolist()
    sharpness = ((0.0, first), (0.8, last))
    pattern = Pattern(1.0, curve, sharpness, tuple([Transient(at, 1.0, first) for at in taps]))
    return File.of(pattern, name="it", level_db_sl=ALL)


ALLOWED = 0.5e-3  # m
PAIRS = (((0.1, 0.1), (0.3, 0.2)), ((0.3, 0.22), (0.15, 0.1)))


def onset_table() -> LocalizationTable:
    """Of frequencies near the magnets' resonances, and one above."""
    return table("onsets", (60.0, 70.0, 90.0, 120.0))


def voltages(envelopes: Iterable[Envelopes]) -> ComplexArray:
    """What each exciter gets (n, eras) of envelopes that begin together, and 50 ms of the last."""
    times = STEP * np.arange(1600)
    found = np.zeros((len(times), len(onset_table().eras)), dtype=complex)
    for number, era in enumerate(onset_table().eras):
        for each in envelopes:
            if era.name in each:
                one = each[era.name]
                turning = np.exp(2j * np.pi * one.frequency * times)
                found[:, number] += one.amplitude(times) * turning
    return found


def furthest(volts: ComplexArray) -> float:
    """The largest motion [m] of a magnet from rest, in whichever phase."""
    return float(np.abs(magnets("onsets").moved(volts)).max())


@pytest.mark.parametrize("frequency", [60.0, 70.0, 90.0])
def test_onsets_keep_magnets_within_their_excursion(frequency: float) -> None:
    """At the most that is asked, along shaped onsets and along a jump, in either phase.

    Of answers for one of two fingers with as much as exciters give; a jump takes a millisecond.
    """
    largest, times = [], STEP * np.arange(1600)
    jump = np.exp(2j * np.pi * frequency * times) * np.minimum(times / 1e-3, 1)
    for target, quiet in PAIRS:
        (layer,) = alone(target, frequency, Limits(), Finger(quiet)).layers
        assert layer.onset is not None
        full = np.array([layer.excitation[era.name].phasor for era in onset_table().eras])
        largest += [furthest(voltages([layer.onset])), furthest(jump[:, None] * full)]
    assert 0.6 * ALLOWED < max(largest) < 1.01 * ALLOWED


def test_contents_together_keep_magnets_within_their_excursion() -> None:
    """Of a tone at 70 Hz that takes half of it, and one at 90 Hz that wants all beside it."""
    largest, every = [], PlaybackCapabilities("phased", ("phased",), Limits(), RAMPS_ONLY)
    for first, second in PAIRS:
        one = alone(first, 70.0, Limits(excursion=0.5))
        other = alone(second, 90.0, every.left_by(one.layers, onset_table()).limits)
        onsets = [layer.onset for layer in (*one.layers, *other.layers) if layer.onset]
        assert len(onsets) == 2
        largest.append(furthest(voltages(onsets)))
    assert 0.3 * ALLOWED < max(largest) < 1.01 * ALLOWED


def alone(at: Point, frequency: float, limits: Limits, *quiet: Finger) -> Answer:
    """All that one finger can have within limits, beside others that feel nothing."""
    fingers = [Finger(at, Stimulus(60.0, band_hz=(frequency, frequency))), *quiet]
    found = answer(onset_table(), fingers, drive_mode="phased", shaped=True, limits=limits)
    return Timing(onset_table()).shaped(found)


LEAKING = SurfaceLayout(
    (
        Region("left", Rectangle(0.0, 0.0, 0.15, 0.12), on_press="left"),
        Region("right", Rectangle(0.16, 0.0, 0.14, 0.12), on_press="right"),
    ),
    {"left": Buzz(level=14.0), "right": Buzz(level=14.0)},
    elsewhere=None,
)


def statuses(fingers: Fingers) -> dict[int, float]:
    """What the status says that leaks to each finger [dB SL]."""
    contacts = tuple(
        Contact(ContactKey("panel", id), *at, since=0.0) for id, at in fingers.at.items()
    )
    view = PlateView(lambda key: None, contacts, fingers.applied[-1])
    found = {each.id: each.leak_db_sl for each in view.statuses_now(paper_table())}
    return {id: -math.inf if level is None else level for id, level in found.items()}


@in_virtual_time
async def test_status_says_what_leaks_to_a_finger_that_has_moved() -> None:
    """Slowly, by less than 8 mm, no weights change: within a decibel of what is measured there.

    Nothing leaks when the last finger has lifted and its silence is not confirmed yet.
    """
    async with fingers_on(
        paper_table(), LEAKING, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.2
    ) as fingers:
        rested = statuses(fingers)
        assert rested == pytest.approx(fingers.levels_db_sl(foreign=True), abs=1.0)
        count = len(fingers.applied)

        def move(since: float) -> None:
            way = min(0.02 * since, 0.0055)
            fingers.at[3] = (ABOVE[0] + way, ABOVE[1] - way)

        await fingers.hold(1.5, move)
        assert len(fingers.applied) == count
        moved = statuses(fingers)
        assert moved == pytest.approx(fingers.levels_db_sl(foreign=True), abs=1.0)
        assert moved[3] > rested[3]
        fingers.at.clear()
        assert statuses(fingers) == {}


@pytest.mark.long
@in_virtual_time
async def test_weights_follow_a_finger_at_half_a_meter_a_second() -> None:
    """10 cm in 0.2 s: several answers on the way, after which as little leaks as before."""
    async with fingers_on(
        paper_table(), LEAKING, at={1: LEFT, 2: RIGHT, 3: ABOVE}, held=1.0
    ) as fingers:
        rested, count = statuses(fingers)[3], len(fingers.applied)
        on_the_way = []

        def way(since: float) -> None:
            on_the_way.append(statuses(fingers)[3])
            fingers.at[3] = (ABOVE[0] + 0.5 * since, ABOVE[1])

        await fingers.hold(0.2, way)
        changes = [each.time for each in fingers.applied[count:]]
        assert 4 <= len(changes) <= 0.2 / 0.017 + 1
        await fingers.hold(1.0)
        assert statuses(fingers)[3] == pytest.approx(fingers.levels_db_sl(foreign=True)[3], abs=1.0)
        assert max(on_the_way) > rested
        assert statuses(fingers)[3] < max(on_the_way)
