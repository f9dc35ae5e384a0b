"""A plate measured through a sound card in memory for its identification."""

import numpy as np
import pytest

from benchmarks.desk_plate.desk_plate import DeskPlate
from benchmarks.desk_plate.sensing import Converters
from benchmarks.desk_plate.truth import Truth
from desk_card import DeskCard
from drivers.errors import LinkError
from model.arrays import Float32Array, FloatArray
from model.errors import InputError
from model.identification.identify import identify
from model.identification.measured_plate import MeasuredPlate
from model.rig.rig import Rig
from sim.measuring.desk import Desk
from sim.measuring.multisine import Multisine
from sim.measuring.plate_measurement import measure_through
from sim.sensors.sensor_file import WiredSensor

RATE, LEVEL = 8_000.0, 0.3
PLACES = ((0.03, 0.05), (0.20, 0.11), (0.29, 0.20), (0.11, 0.19), (0.25, 0.03))
SENSORS = tuple(WiredSensor(f"P{n}", x, y, n, 2e-3) for n, (x, y) in enumerate(PLACES, start=1))
FREQUENCIES = np.arange(51.0, 500.0, 40.0)


class ChangingCard(DeskCard):
    """Plays to the plate through amplifiers that change; gains: of each run, by its samples."""

    def run(self, played: FloatArray) -> Float32Array:
        """Advance the plate by what the amplifiers make of the samples."""
        changed = played.copy()
        changed[:, :-1] = self.amplified(played[:, :-1])
        return super().run(changed)

    def amplified(self, played: FloatArray) -> FloatArray:
        """Compress large samples, by 10 % at the level."""
        return np.asarray(played * (1 - 0.1 * (played / LEVEL) ** 2))


class FadingCard(ChangingCard):
    """The amplifiers lose 3 % before the last run."""

    def amplified(self, played: FloatArray) -> FloatArray:
        """Lose a little."""
        return played * (0.97 if self.runs == 6 else 1.0)


def measured(
    rig: Rig,
    truth: Truth,
    *,
    kind: type[DeskCard] = DeskCard,
    frequencies: FloatArray = FREQUENCIES,
    **wires: object,
) -> MeasuredPlate:
    """The plate measured from rest."""
    converters = Converters(delay=73, noise=5e-3)
    plate = DeskPlate(truth, SENSORS, rate=RATE, converters=converters, seed=1)
    card = kind(plate, rate=RATE, **wires)  # type: ignore[arg-type]
    desk = Desk(rig, SENSORS)
    multisine = Multisine(frequencies, len(desk.eras) + 1, RATE, LEVEL)
    return measure_through(desk, card, multisine, periods=2, progress=lambda done, of: None)


def test_identified_plate_is_the_one_behind_the_card(rig: Rig, truth: Truth) -> None:
    """Springs per mass, rigidity, gains over frequency: what drove the plate, with resonances.

    Within four standard deviations of what is written, and that is less than before.
    """
    found = identify(rig, measured(rig, truth).measurement)
    assert found.is_explained
    mass = truth.rig.plate.thickness / found.rig.plate.thickness
    std = found.rig.uncertainty
    assert std.stiffness < rig.uncertainty.stiffness / 3
    for era, real, actuator in zip(found.rig.eras, truth.rig.eras, truth.actuators, strict=True):
        assert mass * era.stiffness == pytest.approx(real.stiffness, rel=4 * std.stiffness)
        ratio = era.gain(FREQUENCIES) / actuator.response(FREQUENCIES)
        assert np.abs(np.angle(ratio)).max() < 4 * np.radians(std.phase_deg)
        np.testing.assert_allclose(np.abs(ratio), np.abs(ratio).mean(), rtol=4 * std.gain)


@pytest.mark.parametrize(
    ("kind", "cause"), [(ChangingCard, "half the level"), (FadingCard, "at the end")]
)
def test_plate_that_is_not_the_same_twice_is_refused(
    rig: Rig, truth: Truth, kind: type[DeskCard], cause: str
) -> None:
    """Amplifiers that compress show at half the level, ones that fade in the run that is last."""
    found = measured(rig, truth, kind=kind, frequencies=np.array([61.0, 151.0, 311.0]))
    with pytest.raises(InputError, match=cause):
        found.measurement.check()


def test_block_that_is_lost_in_a_repeated_run_is_played_again(rig: Rig, truth: Truth) -> None:
    """Once is repeated, three times is refused."""
    few = np.array([61.0, 151.0, 311.0])
    measured(rig, truth, frequencies=few, lost=[5]).measurement.check()
    with pytest.raises(LinkError):
        measured(rig, truth, frequencies=few, lost=[6, 7, 8])
