"""A hand that stays, a sticker and a crack: told apart on plates by another solver."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from benchmarks.identification.hidden import Hidden, finger_stiffness
from benchmarks.identification.thin_plate import Complexes, Mounted, Reals
from extrapolated import extrapolated_slopes
from model.identification.alterations import Alteration, Altered, Crack, Hand, altered
from model.identification.identify import Identification
from model.identification.in_service import Known, LivePlate, Report
from model.identification.settled import Touched
from settled_patterns import played, settled_patterns

HAND = np.array([0.25, 0.05])
EDGE = (0.188, 0.211, 0.0, 0.069, 0.5)  # m, and the share of its rigidity that is lost
INSIDE = (0.117, 0.164, 0.114, 0.160, 0.1)


@dataclass(frozen=True, eq=False)
class Rested(Mounted):
    """A plate on which a hand of four fingertips rests that nobody reports."""

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


def softened(plate: Mounted, soft: tuple[float, float, float, float, float]) -> Mounted:
    """The plate with a patch that has lost a share of its rigidity."""
    return replace(plate, plate=replace(plate.plate, soft=soft))


def said(reports: Iterable[Report]) -> str:
    """The name of what was found first."""
    return next(each.explanation.name for each in reports if each.explanation)


@pytest.mark.long
def test_hand_that_stays_is_no_sticker_and_leaves_again(hidden: Hidden, known: Known) -> None:
    """It is named where it rests, answers are cautious until it is gone; then service goes on."""
    live = LivePlate(known)
    own = {each.name: getattr(hidden.mounted, each.name) for each in fields(Mounted)}
    rested = Rested(**own)
    reports = played(live.take, hidden, rested, count=6)
    assert said(reports) == "a hand"
    (explanation,) = (each.explanation for each in reports if each.explanation)
    x, y = (0.01 * float(each) for each in explanation.found.split(" at ")[1][:-3].split(", "))
    assert (x, y) == pytest.approx(HAND, abs=0.01)
    assert live.known.change
    played(live.take, hidden, hidden.mounted, count=9)
    assert not live.known.change


@pytest.mark.long
def test_heavy_sticker_is_no_hand(hidden: Hidden, known: Known) -> None:
    """10 g where the hand was are a mass."""
    sticker = np.array([*HAND, 10e-3])
    plate = replace(hidden.mounted, masses=np.vstack([hidden.mounted.masses, sticker]))
    live = LivePlate(known)
    assert said(played(live.take, hidden, plate, count=6)) == "a mass"


@pytest.mark.long
def test_crack_is_named(hidden: Hidden, known: Known) -> None:
    """A patch of 2.3 by 6.9 cm at an edge that has lost half of its stiffness is a crack.

    After ten patterns, which have told the gains of the sensors.
    """
    live = LivePlate(known)
    played(live.take, hidden, hidden.mounted, count=10)
    reports = played(live.take, hidden, softened(hidden.mounted, EDGE), count=6, start=10)
    assert said(reports) == "a crack"
    assert live.known.change


@pytest.mark.parametrize(("kind", "error"), [("crack", 0.15), ("hand", 0.02)])
def test_responses_change_as_on_finite_elements(
    hidden: Hidden, found: Identification, kind: str, error: float
) -> None:
    """Responses change as by a soft patch of that area, to a seventh, and as by a load there."""
    mounted, model = hidden.mounted, found.fitted.problem.model
    cracked, area = softened(mounted, INSIDE), np.diff(INSIDE[:4])[::2].prod() * INSIDE[4]
    middle = np.reshape(INSIDE[:4], (2, 2)).mean(axis=1)
    ours, true = [], []
    for tone in np.linspace(60, 480, 15):
        plate = replace(model, frequencies=np.array([tone])).at(found.posterior.x)
        before, w = mounted.accelerations(tone, mounted.at), 2 * np.pi * tone
        if kind == "crack":
            now = altered(plate, Crack(), middle, np.log([area / Crack.unit]))
            after = cracked.accelerations(tone, mounted.at)
        else:
            parts = np.array([1e-3, 8.0, 500.0])  # kg, N s/m, N/m
            now = altered(plate, Hand(), HAND, np.log(parts / Hand.units))
            load = np.array([[-(w**2), 1j * w, 1]]) @ parts
            after = mounted.accelerations(tone, mounted.at, fingers=HAND[None], loads=load)
        ours.append(now - plate.responses[0])
        true.append(hidden.sensor_gain[:, None] * (after - before))
    assert np.linalg.norm(np.subtract(ours, true)) < error * np.linalg.norm(true)


@pytest.mark.parametrize("alteration", [Hand(), Crack()], ids=["hand", "crack"])
def test_numbers_change_with_place_and_values_of_an_alteration(
    hidden: Hidden, found: Identification, alteration: Alteration
) -> None:
    """As extrapolated differences of the numbers, to 0.2 % of each column's largest."""
    model = found.fitted.problem.model
    (pattern,) = settled_patterns(hidden, hidden.mounted, count=1)
    touched = Altered.by(alteration, Touched.of(model, pattern, 0.5))
    p, fingers = model.space.size, np.zeros(4 * len(pattern.fingers))
    start = np.array([0.3, -0.4, *alteration.start(1.0)])

    def numbers(theta: Reals) -> Reals:
        return touched.predicted(np.concatenate([found.posterior.x, theta]), fingers)[0]

    _, columns = touched.predicted(np.concatenate([found.posterior.x, start]), fingers)
    exact = extrapolated_slopes(numbers, start, step=1e-2)
    for own, true in zip(columns[:, p : p + alteration.size].T, exact, strict=True):
        np.testing.assert_allclose(own, true, atol=2e-3 * np.abs(true).max())
