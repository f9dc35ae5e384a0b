"""A plate in service: a thin plate, whose theory is not the model's, that changes."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from benchmarks.identification.hidden import Hidden, finger_stiffness
from benchmarks.identification.thin_plate import Complexes, Mounted, Reals
from model.identification.learned_plate import LivePlate, PlateEstimate
from plates import played, settled_patterns

NE = 2  # number of that ERA
HAND = np.array([0.25, 0.05])  # m


def test_loosened_mount_is_named_and_followed(hidden: Hidden, known: PlateEstimate) -> None:
    """Quiet patterns raise no alarm; a mount 20 % softer does within 8, and is named NE."""
    live = LivePlate(known)
    quiet = played(live.take, hidden, hidden.mounted, count=10)
    assert not any(report.alarm for report in quiet)
    assert np.mean([report.nis / report.count for report in quiet]) < 1.5
    factors = np.where(np.arange(4) == NE, 0.8, 1.0)
    loose = replace(hidden.mounted, stiffness=factors * hidden.mounted.stiffness)
    after = played(live.take, hidden, loose, count=8, start=10)
    assert any(report.alarm for report in after)
    (explanation,) = (each.explanation for each in after if each.explanation)
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
        after = np.sqrt(np.diag(live._drifted(3600.0 * hours).covariance))
        return float(np.max((space.std * after)[space.groups[kind]]))

    begun = known("thickness", 0.0)
    assert begun < 0.01
    assert known("thickness", 1.0) == pytest.approx(np.hypot(begun, 0.01), rel=1e-6)
    assert known("thickness", 336.0) == pytest.approx(0.02, rel=1e-6)
    assert known("stiffness", 336.0) == pytest.approx(0.1, rel=1e-6)


@pytest.mark.long
def test_sticker_is_named_in_its_place(hidden: Hidden, known: PlateEstimate) -> None:
    """3 g are named a mass within ten patterns, to 0.6 g and 1.5 cm."""
    live = LivePlate(known)
    played(live.take, hidden, hidden.mounted, count=10)
    sticker = np.array([0.11, 0.16, 3e-3])
    changed = replace(hidden.mounted, masses=np.vstack([hidden.mounted.masses, sticker]))
    after = played(live.take, hidden, changed, count=10, start=10)
    (explanation,) = (each.explanation for each in after if each.explanation)
    assert explanation.name == "a mass"
    added = live.known.rig.masses[-1]
    assert added.mass == pytest.approx(3e-3, abs=0.6e-3)
    assert (added.x, added.y) == pytest.approx((0.11, 0.16), abs=0.015)


def test_heavy_finger_is_no_change(hidden: Hidden, known: PlateEstimate) -> None:
    """Fingers of six times the usual load, beyond three standard deviations, raise no alarm."""
    live = LivePlate(known)
    heavy = settled_patterns(hidden, hidden.mounted, count=12, start=0, heaviest=6.0)
    assert not any(live.take(each).alarm for each in heavy)


def test_plate_that_was_not_explained_is_not_updated(hidden: Hidden, known: PlateEstimate) -> None:
    """After an identification with chi² above 2 patterns leave the state as it was."""
    live = LivePlate(replace(known, is_explained=False))
    before = live.known.state
    played(live.take, hidden, hidden.mounted, count=2)
    assert live.known.state is before


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


def retuned(mounted: Mounted) -> Mounted:
    """Two mounts and a gain at once."""
    return replace(
        mounted,
        stiffness=mounted.stiffness * [0.5, 1.0, 2.0, 1.0],
        gain=mounted.gain * [1.0, 0.5j, 1.0, 1.0],
    )


def cracked(mounted: Mounted) -> Mounted:
    """A patch of 2.3 by 6.9 cm at an edge that has lost half of its stiffness."""
    soft = (0.188, 0.211, 0.0, 0.069, -0.5, 0.0)  # m; more of its rigidity, and of its mass
    return replace(mounted, plate=replace(mounted.plate, parts=(soft,)))


def rested(mounted: Mounted) -> Mounted:
    """A hand on the plate."""
    return Rested(**{each.name: getattr(mounted, each.name) for each in fields(Mounted)})


@pytest.mark.long
@pytest.mark.parametrize("change", [retuned, cracked, rested])
def test_change_that_nothing_explains_is_said_until_it_is_gone(
    hidden: Hidden, known: PlateEstimate, change: Callable[[Mounted], Mounted]
) -> None:
    """It is followed as no other: the state stays and says so; then service goes on."""
    live = LivePlate(known)
    played(live.take, hidden, hidden.mounted, count=10)
    reports = played(live.take, hidden, change(hidden.mounted), count=6, start=10)
    (explanation,) = (each.explanation for each in reports if each.explanation)
    assert explanation.name == ""
    assert live.known.change
    before = live.known.state
    played(live.take, hidden, hidden.mounted, count=9, start=16)
    assert not live.known.change
    assert live.known.state is not before
