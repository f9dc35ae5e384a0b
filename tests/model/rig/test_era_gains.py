"""ERAs with measured gains."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from model.errors import InputError
from model.fem.plate import assemble, direct_acceleration
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_plate
from model.rig.file import load_rig
from model.rig.rig import Rig
from model.structure.attachments import footprints_of
from model.transients.base_motion import BaseMotions, Term
from model.transients.time_response import plate_in_time

GAINS = ((100.0, 0.9, 0.2), (200.0, 1.3, -0.4))


@pytest.fixture
def uneven(coarse_rig: Rig) -> Rig:
    """The paper's plate, its second ERA with gains."""
    eras = list(coarse_rig.eras)
    eras[1] = replace(eras[1], gains=GAINS)
    return replace(coarse_rig, eras=tuple(eras))


def test_era_gain_is_interpolated_and_held_beyond_its_frequencies(uneven: Rig) -> None:
    """It lies on the line between two complex gains, and is the last one beyond."""
    low, high = 0.9 * np.exp(0.2j), 1.3 * np.exp(-0.4j)
    found = uneven.eras[1].gain(np.array([50.0, 100.0, 125.0, 300.0]))
    np.testing.assert_allclose(found, [low, low, 0.75 * low + 0.25 * high, high])


def test_acceleration_is_scaled_by_the_gain_of_its_era(coarse_rig: Rig, uneven: Rig) -> None:
    """In direct solve and free plate the ERA's own response is multiplied, not its neighbours'."""
    points = np.array([[0.1, 0.05], [0.2, 0.2]])
    frequencies = np.array([100.0, 150.0, 200.0])
    factor = np.ones((3, 4, 1), dtype=complex)
    factor[:, 1, 0] = uneven.eras[1].gain(frequencies)
    matrices = assemble(coarse_rig.plate, coarse_rig.mesh)
    before = direct_acceleration(matrices, coarse_rig.eras, frequencies, points)
    after = direct_acceleration(matrices, uneven.eras, frequencies, points)
    np.testing.assert_allclose(after, factor * before, rtol=1e-12)
    free = solve_free_plate(coarse_rig.plate, coarse_rig.mesh)
    np.testing.assert_allclose(
        free.acceleration(uneven.eras, frequencies, points),
        factor * free.acceleration(coarse_rig.eras, frequencies, points),
        rtol=1e-10,
    )


def test_particular_solution_is_the_same_for_negative_frequency(
    coarse_rig: Rig, uneven: Rig
) -> None:
    """Im[c exp(i w t)] is Im[-conj(c) exp(-i w t)]: quick ramps of low tones are made of both."""
    reduced = reduce_plate(coarse_rig.plate, coarse_rig.mesh, footprints_of(coarse_rig.eras))
    plate, omega, c = plate_in_time(reduced, uneven.eras), 2 * math.pi * 150.0, 6e-5 + 3e-5j
    tones = Term(0.0, math.inf, omega, c), Term(0.0, math.inf, -omega, -c.conjugate())
    expected, back = (
        plate.driven(BaseMotions([(), (tone,)]), [0], [0.0]).state(0, 0.0123) for tone in tones
    )
    np.testing.assert_allclose(back, expected, atol=1e-9 * np.abs(expected).max())


def test_load_rig_reads_gains_and_refuses_invalid_rows(tmp_path: Path) -> None:
    """Rows are frequency, magnitude and degrees; an invalid one is refused with its line."""
    text = """\
plate: {length: 0.3, width: 0.2, thickness: 1.5 mm, material: steel}
mesh: 12x9
limits: {frequency: [40, 200]}
eras:
  A: {at: [0, 0], stiffness: 9000, amplifier: m, channel: 0, gains: [[50, 0.9, 90], [60, 1, 0]]}
  B: {at: [0.3, 0], stiffness: 9000, amplifier: m, channel: 1}
  C: {at: [0, 0.2], stiffness: 9000, amplifier: m, channel: 2}
amplifiers: {m: {url: "sim://"}}
"""
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    rig = load_rig(path)
    assert rig.eras[0].gains == ((50.0, 0.9, math.pi / 2), (60.0, 1.0, 0.0))
    assert rig.eras[1].gains == ()
    for row, said in (("[60, 0, 0]", "magnitude"), ("[40, 1, 0]", "ascend")):
        path.write_text(text.replace("[60, 1, 0]", row))
        with pytest.raises(InputError, match=rf"rig\.yaml:5: eras\.A\.gains: .*{said}"):
            load_rig(path)


def test_era_refuses_invalid_gains(coarse_rig: Rig) -> None:
    """A magnitude of zero, NaN and frequencies that do not ascend are refused."""
    for gains in (
        ((50.0, 0.0, 0.0),),
        ((50.0, 1.0, math.nan),),
        ((9.0, 1.0, 0.0), (9.0, 1.0, 0.0)),
    ):
        with pytest.raises(InputError, match="ERA SW"):
            replace(coarse_rig.eras[0], gains=gains)
