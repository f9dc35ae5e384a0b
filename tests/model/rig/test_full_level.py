"""What full level of an amplifier is, and ERAs without an amplifier, in rig files."""

from pathlib import Path

import numpy as np
import pytest

from model.config.document import ConfigError
from model.fem.plate import assemble, direct_acceleration
from model.rig.file import load_rig, parse_rig
from model.rig.kind import gain_notes
from model.rig.rig import Rig
from model.table.build import build_table
from model.table.question import Question

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


def problems(source: str) -> list[str]:
    """Keys of the problems."""
    with pytest.raises(ConfigError) as error:
        parse_rig("rig.yaml", source)
    return [problem.key for problem in error.value.problems]


def test_full_level_is_a_motion_or_an_output() -> None:
    """A motion unless the file says that it is an output, as that of the desk does."""
    assert parse_rig("rig.yaml", text().replace(", full_level: output", "")).outputs == set()
    assert parse_rig("rig.yaml", text(full_level="motion")).outputs == set()
    assert parse_rig("rig.yaml", text()).outputs == {"main"}
    assert load_rig(DESK).outputs == {"main"}
    assert problems(text(full_level="voltage")) == ["amplifiers.main.full_level"]


def test_check_says_which_motion_by_an_output_is_a_guess() -> None:
    """Of the ERA without gains; of a motion nothing is to be measured."""
    (guess,) = gain_notes(parse_rig("rig.yaml", text()))
    assert guess.startswith("eras.SW.gains: missing")
    assert gain_notes(parse_rig("rig.yaml", text(full_level="motion"))) == []


def test_check_names_rows_that_are_too_far_apart() -> None:
    """Halfway between rows 90 degrees apart a straight line has 0.7 of the gain; 179 to -176 is 5.

    Rows beyond the limits of frequency are not played.
    """
    far = "[[40, 2, 179], [150, 2, -176], [255, 2, 94], [300, 2, 90], [320, 2, 0]]"
    _, coarse = gain_notes(parse_rig("rig.yaml", text(gains=far)))
    assert coarse.startswith("eras.SE.gains: phases differ by 90 degrees between 150 and 255 Hz")


def test_half_of_a_wiring_is_refused() -> None:
    """A channel without an amplifier, and a rig of which nothing is driven."""
    half = text().replace("{at: [0, 9 in], stiffness", "{at: [0, 9 in], channel: 3, stiffness")
    assert problems(half) == ["eras.NW.amplifier"]
    undriven = text().replace("amplifier: main, channel: 0", "amplifier: null")
    undriven = undriven.replace("amplifier: main, channel: 1", "amplifier: null")
    assert problems(undriven) == ["eras"]


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
    question = Question(((0.1, 0.06),), ((0.22, 0.16),), level_db_sl=10.0, drive_mode="phased")
    assert set(table.query(question).excitation) <= {"SW", "SE"}
