"""A table that learns its plate: answers after a change, what is kept of it, and its refusals.

A plate in service: a thin plate, whose theory is not the model's, that changes.

The benchmark of identification in its short form: one hard plate.

Identification of hidden thin plates in Hermite elements, whose theory is not the model's.

Settled patterns, and the alarm that follows them.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from cases import shortly
from controller.learning import learned_table as learned_table_module
from controller.learning.learned_table import LearnedTable, save_learned
from kit.plates import SETTLED_PATTERNS_FREQUENCIES, played, settled_patterns
from kit.thin_plates import FREQUENCIES as PLATES_FREQUENCIES
from kit.thin_plates import (
    Complexes,
    Hidden,
    Mounted,
    Reals,
    draw,
    finger_stiffness,
    outcome,
    pattern_of_touches,
    table_of,
)
from model.arrays import FloatArray
from model.errors import InputError
from model.estimate.fit import Fit
from model.estimate.following import (
    WINDOW,
    Alarm,
    LivePlate,
    NoiseLevel,
    PatternReport,
    PlateChange,
    PlateEstimate,
    PlateUpdate,
    SettledPattern,
    update,
)
from model.estimate.forward import Sensor
from model.estimate.identify import (
    Identification,
    fit_in_stages,
    identify,
    model_of,
    solved_with_modes_of,
)
from model.estimate.measurement import Measurement
from model.reduction.free_plate import solve_free_plate
from model.rig.rig import Rig, Uncertainty
from model.table.table import LocalizationTable
from model.table.table_file import build_table

TONES = np.array([85.0, 150.0, 215.0, 330.0])
POINTS = np.array([[0.06, 0.05], [0.15, 0.11], [0.26, 0.17], [0.22, 0.04]])


@pytest.fixture(scope="session")
def hidden() -> Hidden:
    """A plate with places and a mass of its own."""
    return draw("form", 1)


@pytest.fixture(scope="session")
def found(rig: Rig, hidden: Hidden) -> Identification:
    """The paper's rig identified on it."""
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    values = hidden.measured(SETTLED_PATTERNS_FREQUENCIES, np.random.default_rng(1))
    return identify(rig, Measurement(sensors, SETTLED_PATTERNS_FREQUENCIES, values))


@pytest.fixture(scope="session")
def known(found: Identification) -> PlateEstimate:
    """What a daemon knows of that plate when it starts: what the identified rig states."""
    return PlateEstimate.of_rig(found.rig, found.fitted.model.sensors)


@pytest.fixture(scope="module")
def table(known: PlateEstimate) -> LocalizationTable:
    """The table of the identified rig at a few tones."""
    return build_table(known.model.rig, frequencies=TONES, drive_mode="phased")


def learned_table(table: LocalizationTable, known: PlateEstimate, file: Path) -> LearnedTable:
    """A table of a plate and its sensors, with what its file holds."""
    return LearnedTable(known.model.rig, table, known.model.sensors, "phased", file)


@pytest.mark.long
def test_unexplained_change_widens_the_errors_of_answers(
    hidden: Hidden, known: PlateEstimate, table: LocalizationTable, tmp_path: Path
) -> None:
    """A quiet pattern gives a new table, odd ones that raise an alarm none.

    Answers then allow for the errors of a plate that was not measured, also when resumed.
    """
    file = tmp_path / "learned.npz"
    learned = learned_table(table, known, file)
    quiet = played(learned.take, hidden, hidden.mounted, count=12)
    assert all(each.table is not None for each in quiet)
    odd = CHANGES["retuned"](hidden.mounted)
    first, second, *_, report = played(learned.take, hidden, odd, count=7, start=12)
    assert second.is_alarm
    assert first.table is second.table is None
    assert report.state == "changed"
    assert "most as if" in report.cause
    assert report.table is not None
    wide, built = learned.current.uncertainty, Uncertainty()
    assert (wide.gain, wide.thickness, wide.damping) == (built.gain, built.thickness, built.damping)
    assert learned.keep()[0] == ""
    again = learned_table(table, known, file)
    assert again.live.known.change == learned.live.known.change != ""
    assert again.current.uncertainty == wide


def test_pattern_that_no_table_follows_leaves_the_state(
    hidden: Hidden,
    known: PlateEstimate,
    table: LocalizationTable,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """State, answers and time are those before a refused pattern, and the next one is taken."""
    learned = learned_table(table, known, tmp_path / "learned.npz")
    first, second, third = settled_patterns(hidden, hidden.mounted, count=3)
    learned.take(first)
    state, current = learned.live.known, learned.current

    def refused(table: LocalizationTable, rig: Rig) -> LocalizationTable:
        raise InputError("thickness must be within 10 %, got 20 %")

    with monkeypatch.context() as patch:
        patch.setattr(learned_table_module, "table_following", refused)
        report = learned.take(second)
    assert "not used: thickness" in report.note
    assert report.table is None
    assert learned.live.known is state
    assert learned.current is current
    assert learned.take(third).table is not None


def test_what_was_learned_is_resumed_for_its_table_only(
    hidden: Hidden, known: PlateEstimate, table: LocalizationTable, tmp_path: Path
) -> None:
    """The same state and answers come back; of anything else the plate is learned anew."""
    file = tmp_path / "learned.npz"
    learned = learned_table(table, known, file)
    played(learned.take, hidden, hidden.mounted, count=3)
    after = learned.live.known
    lying = (0.1, 0.2, 0.05)
    save_learned(file, replace(after, change="a cup", lying=lying), table=table.fingerprint)
    beside = learned_table(table, known, file)
    report, _ = beside.start()
    assert (report.cause, tuple(report.lying or ())) == ("a cup", lying)
    assert "take away" in str(report.remedy)
    assert beside.current.uncertainty == replace(table.uncertainty, foreign_mass=0.05)
    save_learned(file, replace(after, change="a crack"), table=table.fingerprint)
    cautious = learned_table(table, known, file)
    assert cautious.start()[0].cause == "a crack"
    assert cautious.current.uncertainty.thickness == Uncertainty().thickness
    assert learned.keep()[0] == ""
    again = learned_table(table, known, file)
    assert again.start()[0].state == "following"
    np.testing.assert_array_equal(again.live.known.covariance, after.covariance)
    np.testing.assert_array_equal(
        again.current.unit_fields(POINTS), learned.current.unit_fields(POINTS)
    )
    kept = file.read_bytes()
    damaged = bytearray(kept)
    damaged[len(kept) // 2] ^= 1
    few = PlateEstimate.of_rig(known.model.rig, known.model.sensors[:2])
    thin = after.x.copy()
    thin[after.model.space.groups["thickness"]] = -1e3
    save_learned(file, replace(after, x=thin), table=table.fingerprint)
    for content, of, state, said in (
        (kept, replace(table, masses=()), known, "this table"),
        (kept, table, few, "this rig"),
        (bytes(damaged), table, known, "remove the file"),
        (file.read_bytes(), table, known, "thickness"),
    ):
        file.write_bytes(content)
        anew = learned_table(of, state, file)
        report, _ = anew.start()
        assert report.note.startswith("learning anew: ")
        assert said in report.note
        assert anew.current is of
        assert not file.exists()
        assert file.with_name("learned.npz.old").read_bytes() == content


NE = 2  # number of that ERA
HAND = np.array([0.25, 0.05])  # m


def changed_to(
    hidden: Hidden, known: PlateEstimate, changed: Mounted, *, count: int
) -> tuple[LivePlate, PlateChange]:
    """A plate followed into so many patterns of a change, and what explains it.

    Ten patterns before it raise no alarm.
    """
    live = LivePlate(known)
    quiet = played(live.take, hidden, hidden.mounted, count=10)
    assert not any(report.alarm for report in quiet)
    assert np.mean([report.nis / report.count for report in quiet]) < 1.5
    after = played(live.take, hidden, changed, count=count, start=10)
    (explanation,) = (each.explanation for each in after if each.explanation)
    return live, explanation


@pytest.mark.long
def test_loosened_mount_is_named_and_followed(hidden: Hidden, known: PlateEstimate) -> None:
    """A mount 20 % softer is named NE within 8 patterns."""
    factors = np.where(np.arange(4) == NE, 0.8, 1.0)
    loose = replace(hidden.mounted, stiffness=factors * hidden.mounted.stiffness)
    live, explanation = changed_to(hidden, known, loose, count=8)
    assert explanation.name == "stiffness NE"
    assert explanation.change == pytest.approx(np.log(0.8), abs=0.03)
    assert live.known.rig.eras[NE].stiffness == pytest.approx(loose.stiffness[NE], rel=0.02)
    assert not live.known.change


def test_an_idle_plate_is_known_at_least_as_one_that_nobody_measured(
    known: PlateEstimate,
) -> None:
    """Thickness by 1 % more after an hour; after two weeks by 2 %, stiffness by 10 %."""
    live = LivePlate(replace(known, time=0.0))
    space = live.known.model.space

    def known(kind: str, hours: float) -> float:
        after = np.sqrt(np.diag(live.known.at(3600.0 * hours).covariance))
        return float(np.max((space.std * after)[space.groups[kind]]))

    begun = known("thickness", 0.0)
    assert begun < 0.01
    assert known("thickness", 1.0) == pytest.approx(np.hypot(begun, 0.01), rel=1e-6)
    assert known("thickness", 336.0) == pytest.approx(0.02, rel=1e-6)
    assert known("stiffness", 336.0) == pytest.approx(0.1, rel=1e-6)


@pytest.mark.long
def test_sticker_is_named_in_its_place(hidden: Hidden, known: PlateEstimate) -> None:
    """3 g are named a mass within ten patterns, to 0.6 g and 1.5 cm."""
    sticker = np.array([0.11, 0.16, 3e-3])
    changed = replace(hidden.mounted, masses=np.vstack([hidden.mounted.masses, sticker]))
    live, explanation = changed_to(hidden, known, changed, count=10)
    assert explanation.name == "a mass"
    stated = re.search(r"g at \((\S+), (\S+)\) m$", str(explanation))
    assert [*map(float, stated.groups())] == pytest.approx([0.11, 0.16], abs=0.015)
    added = live.known.rig.masses[-1]
    assert added.mass == pytest.approx(3e-3, abs=0.6e-3)
    assert (added.x, added.y) == pytest.approx((0.11, 0.16), abs=0.015)


@pytest.mark.parametrize("mass", shortly([0.05, 0.2], [0.2]))
def test_object_is_noticed_where_it_lies_until_it_is_gone(
    hidden: Hidden, known: PlateEstimate, mass: float
) -> None:
    """A phone and a cup within 10 s of touches, to 2 cm; promises count it, for 10 s after.

    A touch every two seconds. What is known of the plate itself stays as it was.
    """
    live, rng = LivePlate(known), np.random.default_rng(3)

    def touched(start: int, lying: tuple[float, float, float] | None) -> list[PatternReport]:
        times = 2.0 * np.arange(start, start + 5)
        return [live.take(pattern_of_touches(hidden, rng, time=t, lying=lying)) for t in times]

    assert not any(each.alarm for each in touched(0, None))
    before = live.known
    reports = touched(5, (0.2, 0.09, mass))
    assert [str(each.explanation) for each in reports if each.explanation] == [live.known.change]
    assert live.known.lying is not None
    x, y, found = live.known.lying
    assert np.hypot(x - 0.2, y - 0.09) < 0.02
    assert mass / 5 < found < 5 * mass
    promised = replace(before.rig.uncertainty, foreign_mass=found)
    assert live.known.cautious_rig.uncertainty == promised
    assert live.known.x is before.x
    touched(10, None)
    assert (live.known.change, live.known.lying) == ("", None)


@pytest.mark.long
@pytest.mark.parametrize("hours", [0.2, 1.0])
def test_fingers_are_no_change(hidden: Hidden, known: PlateEstimate, hours: float) -> None:
    """Nothing is accused of lying there in hours of a touch each 12 s.

    They are under one to three contents at once. Fingers of six times the usual load, beyond three
    standard deviations, raise no alarm either.
    """
    live, rng = LivePlate(known), np.random.default_rng(4)
    times = np.arange(0.0, 3600 * hours, 12.0)
    touches = (pattern_of_touches(hidden, rng, time=time) for time in times)
    assert not any(live.take(each).alarm for each in touches)
    live = LivePlate(known)
    heavy = settled_patterns(hidden, hidden.mounted, count=12, start=0, heaviest=6.0)
    assert not any(live.take(each).alarm for each in heavy)


def test_plate_that_was_not_explained_is_not_updated(hidden: Hidden, known: PlateEstimate) -> None:
    """After an identification with chi² above 2 patterns leave the state as it was."""
    live = LivePlate(replace(known, why_off="it was not measured"))
    before = live.known.x
    played(live.take, hidden, hidden.mounted, count=2)
    assert live.known.x is before


@dataclass(frozen=True, eq=False)
class Rested(Mounted):
    """A plate on which a hand of four fingertips rests that no panel reports."""

    def accelerations(
        self,
        frequency: float,
        points: Reals,
        *,
        fingers: Reals | None = None,
        loads: Complexes | None = None,
    ) -> Complexes:
        """Those with the hand, too."""
        hand = np.array([finger_stiffness(frequency, np.full(4, 4.0))])
        if fingers is not None and loads is not None:
            fingers, hand = np.vstack([fingers, HAND]), np.append(loads, hand)
        return super().accelerations(frequency, points, fingers=fingers, loads=hand)


CHANGES: dict[str, Callable[[Mounted], Mounted]] = {
    # Two mounts and a gain at once.
    "retuned": lambda mounted: replace(
        mounted,
        stiffness=mounted.stiffness * [0.5, 1.0, 2.0, 1.0],
        gain=mounted.gain * [1.0, 0.5j, 1.0, 1.0],
    ),
    # A patch [m] of 2.3 by 6.9 cm at an edge that has lost half of its stiffness, and no mass.
    "cracked": lambda mounted: replace(
        mounted, plate=replace(mounted.plate, parts=((0.188, 0.211, 0.0, 0.069, -0.5, 0.0),))
    ),
    "a hand": lambda mounted: Rested(
        **{each.name: getattr(mounted, each.name) for each in fields(Mounted)}
    ),
}


@pytest.mark.long
@pytest.mark.parametrize("change", CHANGES)
def test_change_that_nothing_explains_is_said_until_it_is_gone(
    hidden: Hidden, known: PlateEstimate, change: str
) -> None:
    """It is followed as no other: the state stays and says so; then service goes on."""
    live, explanation = changed_to(hidden, known, CHANGES[change](hidden.mounted), count=6)
    assert explanation.name == ""
    assert live.known.change
    before = live.known.x
    played(live.take, hidden, hidden.mounted, count=9, start=16)
    assert not live.known.change
    assert live.known.x is not before


@pytest.mark.long
def test_hard_plate_gives_the_contrast_of_the_plate_known(rig: Rig) -> None:
    """Identified, weightless fingers feel within 2 dB of the plate known, and more than before."""
    written = {loaded: table_of(rig, PLATES_FREQUENCIES, loaded=loaded) for loaded in (False, True)}
    found = outcome(draw("hard", 1), rig, written, "hard", 1, sets=2)
    assert found.chi2 < 1.5
    mean = {
        way: np.mean([found.contrasts[way, False, quiet] for quiet in (1, 2, 3)])
        for way in ("written", "identified", "known")
    }
    assert abs(mean["identified"] - mean["known"]) < 2
    assert mean["identified"] > mean["written"] + 2


def test_hidden_mass_and_places_are_found(hidden: Hidden, found: Identification) -> None:
    """A mass of 3 g is found within 5 % and 2 mm, places within 0.5 mm, springs within 2 %."""
    assert found.chi2 < 1.3
    values = found.values
    ((x, y, mass),) = hidden.mounted.masses
    assert values["masses"][0, 0] == pytest.approx(mass, rel=0.05)
    np.testing.assert_allclose(values["masses"][0, 1:], [x, y], atol=2e-3)
    np.testing.assert_allclose(values["place"], hidden.mounted.at, atol=5e-4)
    np.testing.assert_allclose(values["stiffness"], hidden.mounted.stiffness, rtol=0.02)


@pytest.mark.long
def test_one_round_of_interleaved_tones_finds_the_springs(rig: Rig) -> None:
    """Where each ERA plays every fourth tone only, springs are found within 2 %, and no mass."""
    hidden, tones = draw("plain", 4), SETTLED_PATTERNS_FREQUENCIES
    plays = (np.arange(len(tones))[:, None] + np.arange(4)) % 4 == 0
    values = np.where(plays[:, None], hidden.measured(tones, np.random.default_rng(1)), np.nan)
    sensors = [Sensor(era.name, era.name) for era in rig.eras]
    found = fit_in_stages(rig, Measurement(sensors, tones, values))
    assert found.chi2 < 1.4
    values = found.plate.values
    np.testing.assert_allclose(values["stiffness"], hidden.mounted.stiffness, rtol=0.02)
    assert values["masses"][0, 0] < 0.3e-3


def test_plate_solved_anew_keeps_the_modes_of_the_fit(rig: Rig) -> None:
    """One a tenth thicker, with tones to 180 Hz, has its eighth mode above twice that."""
    free = solve_free_plate(rig.plate, rig.mesh, frequency_max=180.0)
    measurement = Measurement(
        [Sensor("A1", rig.eras[0].name)], np.array([60.0]), np.ones((1, 1, 4))
    )
    model = model_of(rig, free, measurement, masses=0)
    thicker = rig.plate.scaled(modulus=1.0, thickness=1.1)
    anew = replace(model, free=solved_with_modes_of(free, thicker))
    shifts = np.zeros(model.space.size)
    shifts[model.space.groups["mode_shifts"]] = 0.01
    assert anew.at(shifts).responses.shape == (1, 1, len(rig.eras))
    # Eigenvalues go as the square of the thickness, but for its shear.
    lowest = [np.sort(each.free.modes.eigenvalues)[3:11] for each in (model, anew)]
    np.testing.assert_allclose(lowest[1], 1.21 * lowest[0], rtol=2e-3)


@pytest.fixture(scope="module")
def drawn(rig: Rig) -> PlateEstimate:
    """The paper's plate by its drawing."""
    return PlateEstimate.of_rig(rig, [Sensor(era.name, era.name) for era in rig.eras])


@pytest.fixture(scope="module")
def pattern() -> SettledPattern:
    """One of another plate."""
    hidden = draw("form", 1)
    (one,) = settled_patterns(hidden, hidden.mounted, count=1, start=0)
    return one


def state_after(
    drawn: PlateEstimate, pattern: SettledPattern, *, phase: float, has_phase: bool
) -> FloatArray:
    """Parameters after the pattern, read from another moment on."""
    live = LivePlate(drawn)
    live.take(replace(pattern, values=np.exp(1j * phase) * pattern.values, has_phase=has_phase))
    return live.known.x


def test_update_does_not_depend_on_a_phase_that_is_unknown(
    drawn: PlateEstimate, pattern: SettledPattern
) -> None:
    """A turn of all readings together changes nothing; where their phase counts, it does."""
    before = state_after(drawn, pattern, phase=0.0, has_phase=False)
    after = state_after(drawn, pattern, phase=2.0, has_phase=False)
    np.testing.assert_allclose(after, before, atol=1e-9)
    counted = state_after(drawn, pattern, phase=2.0, has_phase=True)
    assert np.abs(counted - before).max() > 0.1


def test_update_within_bounds_explains_a_pattern(
    drawn: PlateEstimate, pattern: SettledPattern
) -> None:
    """Of a plate that was not measured, whose ERAs at corners can be off inwards alone.

    A hundred parameters are free for eight numbers: at the most likely state these are explained to
    their errors, by no more changes than eight directions of the prior are likely to make.
    """
    found = update(drawn, [pattern])
    count = len(found.innovation)
    assert count == 2 * pattern.values.size
    assert found.misfit < count
    assert 2 * found.fit.cost < 3 * count
    space = found.fit.space
    assert (found.fit.x >= space.lower).all()
    assert (found.fit.x <= space.upper).all()
    # What the fit predicts is what the plate does under the fingers that it found.
    rows, own = found.fit.plate.responses[0], found.fit.x[: drawn.model.space.size]
    np.testing.assert_array_equal(found.known.x, own)
    np.testing.assert_allclose(found.fit.predicted[0, :, 0], rows @ pattern.bases[0])


def test_patterns_together_are_those_alone(drawn: PlateEstimate) -> None:
    """A finger loads the plate during its own pattern only: the model of several is that of each.

    The second has a state twice as certain as one of them alone leaves, at least.
    """
    hidden = draw("form", 1)
    several = [*settled_patterns(hidden, hidden.mounted, count=3, start=0)]
    whole = update(drawn, several, evaluations=1)
    for number, each in enumerate(several):
        (alone,) = update(drawn, [each], evaluations=1).fit.predicted
        np.testing.assert_allclose(whole.fit.predicted[number], alone, rtol=1e-9)
    certain = np.diag(whole.known.covariance)
    for each in several:
        after = update(drawn, [each], evaluations=1).known
        assert (certain <= np.diag(after.covariance) + 1e-9).all()


def test_numbers_change_as_their_derivatives_say(
    drawn: PlateEstimate, pattern: SettledPattern
) -> None:
    """Central differences of the residuals of one without a phase; none lies along its turn."""
    without = replace(pattern, values=1j * pattern.values, has_phase=False)
    size, step = drawn.model.space.size, 1e-5

    def fitted(x: FloatArray) -> Fit:
        exact = replace(drawn, covariance=np.eye(size))
        return update(exact, [without], evaluations=1, start=x).fit

    centre = np.full(size, 0.2)
    _, J = fitted(centre).of_values
    for number in drawn.model.space.indices("stiffness"):
        moved = np.zeros(size)
        moved[number] = step
        ahead, behind = (fitted(centre + way * moved).of_values[0] for way in (1, -1))
        np.testing.assert_allclose(
            (ahead - behind) / (2 * step), J[:, number], rtol=1e-3, atol=1e-6
        )
    turn = (1j * without.values / without.std).ravel()
    turn = np.concatenate([turn.real, turn.imag])
    assert np.abs(turn @ J).max() < 1e-6 * np.linalg.norm(turn) * np.linalg.norm(J)


def taken(*, nis: float = 2.0, slope: float = 0.0, masses: int = 0) -> PlateUpdate:
    """A pattern of eight numbers with one direction of unit curvature."""
    directions = np.array([slope]), np.ones(1), masses
    found = SimpleNamespace(nis=nis, innovation=np.zeros(8), directions=directions)
    return cast(PlateUpdate, found)


@pytest.mark.parametrize(
    ("patterns", "since_change"),
    [
        # Four 2.4 deviations off along a direction are 4.8 together, though each is likely.
        ([{}] * 5 + [{"slope": 2.4}] * 4, 4),
        ([{"slope": 2.4 * (-1) ** n} for n in range(2 * WINDOW)], 0),
        ([{"slope": -2.4, "masses": 1}] * WINDOW, 0),
        # Of chi² of 16 60 has a probability of 5e-7, of 24 90 one of 1.4e-9.
        ([{"nis": 30.0}] * 3, 3),
    ],
    ids=["along one direction", "changing sign", "less than no mass", "unlikely"],
)
def test_alarm_has_the_patterns_since_the_plate_changed(
    patterns: list[dict[str, Any]], since_change: int
) -> None:
    """None before, and none where deviations cancel or a mass would be taken away."""
    alarm, found = Alarm(), [taken(**each) for each in patterns]
    *before, last = map(alarm.take, found)
    assert before == [None] * len(before)
    assert last == (found[-since_change:] if since_change else None)


def test_one_unlikely_pattern_raises_none() -> None:
    """A finger unlike any other is odd, alone and among others, but no change of the plate."""
    alarm = Alarm()
    assert alarm.take(taken(nis=90.0, slope=9.0)) is None
    assert alarm.is_odd
    assert all(alarm.take(taken()) is None for _ in range(WINDOW))
    assert not alarm.is_odd


def test_noise_follows_what_is_left_within_its_bounds() -> None:
    """Residuals of half their size halve the noise; it is 0.3 at least and 1 at most."""
    for size, expected in ((0.5, 0.5), (0.01, 0.3), (3.0, 1.0)):
        noise = NoiseLevel()
        for _ in range(200):
            noise.take(4 * (size / noise.relative) ** 2, 4.0)
        assert noise.relative == pytest.approx(expected, rel=0.05)
