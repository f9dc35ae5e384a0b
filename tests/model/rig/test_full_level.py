"""What full level is, gains of ERAs, and layouts of a rig."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.direct_plate import direct_acceleration
from model.answer.stimulus import Placement
from model.config.document import ConfigError
from model.fem import assemble
from model.reduction.free_plate import solve_free_plate
from model.reduction.reduced_plate import reduce_plate
from model.rig.rig import (
    FOUR_ERA_LAYOUTS,
    Rig,
    diagonal_pair,
    edge_pair,
)
from model.rig.rig_file import load_rig, parse_rig
from model.rig.rig_summary import gain_notes
from model.structure.attachments import footprints_of
from model.table.table_file import build_table
from model.transients.base_motion import BaseMotions, Term
from model.transients.time_response import plate_in_time
from plates import exciter_rig, exciter_rig_text, make_paper_rig
from set_table import only

DESK = Path(__file__).parents[3] / "examples" / "desk" / "rig.yaml"
RIG_TEXT = """
plate: {length: 12 in, width: 9 in, thickness: 1.5 mm, material: aluminium}
mesh: 16x12
eras:
  SW: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0}
  SE: {at: [12 in, 0], stiffness: 17000, amplifier: main, channel: 1, gains: {SE}}
  NE: {at: [12 in, 9 in], stiffness: 17000}
  NW: {at: [0, 9 in], stiffness: 17000}
amplifiers:
  main: {url: "sim://", full_level: {main}}
limits: {frequency: [60, 260]}
"""


def text(*, full_level: str = "output", gains: str = "[[40, 6, 0], [300, 2, -20]]") -> str:
    """The rig with this full level and these gains of one ERA."""
    return RIG_TEXT.replace("{main}", full_level).replace("{SE}", gains)


def test_full_level_is_a_motion_or_an_output() -> None:
    """A motion unless the file says that it is an output, as that of the desk does.

    What drives exciters is one without a word.
    """
    assert parse_rig("rig.yaml", text().replace(", full_level: output", "")).outputs == set()
    assert parse_rig("rig.yaml", text(full_level="motion")).outputs == set()
    assert parse_rig("rig.yaml", text()).outputs == {"main"}
    assert load_rig(DESK).outputs == {"main"}
    board = exciter_rig_text().replace(", full_level: output", "")
    assert "full_level" not in board
    assert parse_rig("board.yaml", board).outputs == {"card"}
    with pytest.raises(ConfigError, match=r"amplifiers\.main\.full_level"):
        parse_rig("rig.yaml", text(full_level="voltage"))


def test_check_says_which_motion_by_an_output_is_a_guess() -> None:
    """Of the ERAs without gains at once; of motions and exciters nothing is to be measured."""
    (guess,) = gain_notes(parse_rig("rig.yaml", text()))
    assert guess.startswith("gains of SW: missing")
    both = text().replace(", gains: [[40, 6, 0], [300, 2, -20]]", "")
    assert gain_notes(parse_rig("rig.yaml", both)) == [guess.replace("SW", "SW, SE")]
    assert gain_notes(exciter_rig()) == []
    assert gain_notes(parse_rig("rig.yaml", text(full_level="motion"))) == []


def test_check_names_rows_that_are_too_far_apart() -> None:
    """Halfway between rows 90 degrees apart a straight line has 0.7 of the gain; 179 to -176 is 5.

    Rows beyond the limits of frequency are not played.
    """
    far = "[[40, 2, 179], [150, 2, -176], [255, 2, 94], [300, 2, 90], [320, 2, 0]]"
    _, coarse = gain_notes(parse_rig("rig.yaml", text(gains=far)))
    assert coarse.startswith("eras.SE.gains: phases differ by 90 degrees between 150 and 255 Hz")


def test_era_without_amplifier_supports_as_one_at_rest() -> None:
    """Fields of the others are those of the rig in which it is wired and not driven.

    No pattern drives it.
    """
    rig = parse_rig("rig.yaml", text())
    wired = text().replace("17000}", "17000, amplifier: side, channel: 0}", 1)
    wired = wired.replace("17000}", "17000, amplifier: side, channel: 1}", 1)
    whole = parse_rig("rig.yaml", wired.replace("limits", '  side: {url: "sim://x"}\nlimits'))
    assert (rig.supports, [era.name for era in rig.eras]) == (("NE", "NW"), ["SW", "SE"])
    frequencies, points = np.array([80.0, 220.0]), np.array([[0.1, 0.06], [0.22, 0.16]])

    def fields(one: Rig) -> np.ndarray:
        plate = assemble(one.plate, one.mesh)
        return direct_acceleration(plate, one.eras, frequencies, points, loads=one.masses)

    np.testing.assert_allclose(fields(rig), fields(whole)[:, :2], rtol=1e-9)
    table = build_table(rig, frequencies=np.arange(60.0, 261.0, 20.0))
    np.testing.assert_allclose(
        table.unit_fields(points)[[1, 8]],
        fields(rig),
        rtol=0.02,
        atol=0.02 * np.abs(fields(rig)).max(),
    )
    placed = Placement(((0.1, 0.06),), ((0.22, 0.16),))
    layer, _ = only(table, placed, 10.0, drive_mode="phased")
    assert set(layer.excitation) <= {"SW", "SE"}


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
    """The ERA's own response is multiplied, not its neighbours'."""
    points = np.array([[0.1, 0.05], [0.2, 0.2]])
    frequencies = np.array([100.0, 150.0, 200.0])
    factor = np.ones((3, 4, 1), dtype=complex)
    factor[:, 1, 0] = uneven.eras[1].gain(frequencies)
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


def test_corners_and_pairs_are_those_of_the_paper():
    """`corners` are its own rig, of which SW and SE share the long edge, and SW and NE not."""
    rig = make_paper_rig(12, 9)
    corners = next(layout for layout in FOUR_ERA_LAYOUTS if layout.name == "corners")
    expected = [(era.x, era.y) for era in rig.eras]
    np.testing.assert_allclose(corners.positions(rig.plate), expected)
    pairs = [[rig.eras[era].name for era in of(rig.eras)] for of in (edge_pair, diagonal_pair)]
    assert pairs == [["SW", "SE"], ["SW", "NE"]]
