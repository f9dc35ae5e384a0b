"""ERAs behind amplifiers of voltage, and ERAs without an amplifier, in rig files."""

import math
from dataclasses import replace

import numpy as np
import pytest

from model.config.document import ConfigError
from model.fem.assembly import assemble
from model.fem.harmonic import direct_acceleration
from model.finger.perception import detection_threshold
from model.rig.file import parse_rig
from model.rig.rig import Rig
from model.rig.voltage_costs import second_harmonic, voltage_costs
from model.table.build import build_table
from model.table.question import Question
from registry.voltage import Law, VoltageDrive

RIG_TEXT = """
plate: {length: 12 in, width: 9 in, thickness: 1.5 mm, material: aluminium}
mesh: 16x12
eras:
  SW: {at: [0, 0], stiffness: 17000, amplifier: main, channel: 0, voltage: {SW}}
  SE: {at: [12 in, 0], stiffness: 17000, amplifier: main, channel: 1, voltage: {SE}}
  NE: {at: [12 in, 9 in], stiffness: 17000}
  NW: {at: [0, 9 in], stiffness: 17000}
amplifiers:
  main: {url: "sim://"}
limits: {frequency: [60, 260]}
"""
ROWS = "response: [[40, 6, 0], [300, 2, -90]]"
WIDE = "response: [[40, 6, 0], [300, 2, -90], [520, 1, -170]]"
PLAIN = f"{{{ROWS}}}"


def text(sw: str = PLAIN, se: str = PLAIN) -> str:
    """The rig with these sections."""
    return RIG_TEXT.replace("{SW}", sw).replace("{SE}", se)


def problems(source: str) -> dict[str, str]:
    """Problems by key."""
    with pytest.raises(ConfigError) as error:
        parse_rig("rig.yaml", source)
    return {problem.key: problem.message for problem in error.value.problems}


def test_section_is_read() -> None:
    """Law, bias and response of each channel; the frequencies are the rig's limits."""
    rig = parse_rig(
        "rig.yaml", text(f"{{{WIDE}, law: quadratic, bias: 0.4}}", f"{{{ROWS}, maximum: 0.5}}")
    )
    drives = rig.voltage_of("main")
    assert (drives[0].law, drives[0].bias, drives[0].maximum) == (Law.QUADRATIC, 0.4, 1.0)
    assert (drives[1].law, drives[1].bias, drives[1].maximum) == (Law.LINEAR, 0.0, 0.5)
    assert drives[0].frequencies == (60.0, 260.0)
    assert drives[0].at(170.0) == pytest.approx(3 - 1j)


@pytest.mark.parametrize(
    ("sw", "key"),
    [
        ("{response: [[70, 1, 0], [300, 1, 0]]}", "eras.SW.voltage.response"),
        ("{response: [[50, 1, 0], [200, 1, 0]]}", "eras.SW.voltage.response"),
        (f"{{{ROWS}, bias: 0.2}}", "eras.SW.voltage.bias"),
        (f"{{{WIDE}, law: quadratic, bias: 0.5, maximum: 0.4}}", "eras.SW.voltage.bias"),
        (f"{{{ROWS}, law: quadratic, bias: 0.4}}", "eras.SW.voltage.response"),
        (f"{{{ROWS}, law: cubic}}", "eras.SW.voltage.law"),
        (f"{{{ROWS}, minimum: -1}}", "eras.SW.voltage.minimum"),
        (f"{{{WIDE}, law: quadratic, bias: 0.3, minimum: 0.3}}", "eras.SW.voltage.minimum"),
        (f"{{{ROWS}, static: 3}}", "eras.SW.voltage.static"),
        (f"{{{WIDE}, law: quadratic, bias: 0.5, static: 4}}", "eras.SW.voltage.static"),
    ],
)
def test_invalid_sections_are_refused(sw: str, key: str) -> None:
    """A response that does not cover the limits, a bias of a linear law or beyond the maximum.

    With a bias it must cover the harmonic, too: up to 520 Hz. A lowest voltage without a bias or
    from the bias on, a static response of a linear law, or one of which the bias takes the stroke.
    """
    assert list(problems(text(sw))) == [key]


def test_slew_needs_a_bias() -> None:
    """The square of a ramp is steeper than the ramp."""
    limited = text(f"{{{ROWS}, law: quadratic}}").replace("[60, 260]", "[60, 260], slew: 10")
    assert list(problems(limited)) == ["eras.SW.voltage.law"]


def test_era_without_amplifier_must_have_neither_channel_nor_voltage() -> None:
    """Half of the wiring is a mistake, and so is a rig of which nothing is driven."""
    half = text().replace("{at: [0, 9 in], stiffness", "{at: [0, 9 in], channel: 3, stiffness")
    assert list(problems(half)) == ["eras.NW.amplifier"]
    useless = text().replace("17000}\namp", f"17000, voltage: {PLAIN}}}\namp")
    assert list(problems(useless)) == ["eras.NW.voltage"]


def test_empty_key_is_as_one_left_out() -> None:
    """An empty `voltage:` beside an ERA that has one, and an empty `amplifier:` of every ERA."""
    assert list(problems(text(sw=""))) == ["eras.SW.voltage"]
    assert list(problems(text(se=""))) == ["eras.SE.voltage"]
    undriven = text("", "").replace("amplifier: main, channel: 0", "amplifier: null")
    undriven = undriven.replace("amplifier: main, channel: 1", "amplifier: null")
    assert list(problems(undriven)) == ["eras"]


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
    table = build_table(replace(rig, voltage={}), frequencies=np.arange(60.0, 261.0, 20.0))
    np.testing.assert_allclose(
        table.unit_fields(points)[[1, 8]],
        fields(rig),
        rtol=0.02,
        atol=0.02 * np.abs(fields(rig)).max(),
    )
    question = Question(((0.1, 0.06),), ((0.22, 0.16),), level_db_sl=10.0, drive_mode="phased")
    assert set(table.query(question).excitation) <= {"SW", "SE"}


def test_check_says_how_far_the_mean_force_deflects() -> None:
    """A response of 2 at least, and 6 to a constant term: 2 / 8 of a stroke, and 6 / 8 at rest."""
    flat = "{response: [[40, 2, 0], [300, 2, 0]], law: quadratic, static: 6}"
    (cost,) = voltage_costs(parse_rig("rig.yaml", text(flat, flat)))
    assert "levels up to 0.25 " in cost
    assert "up to 0.75 strokes" in cost


def test_check_names_rows_that_are_too_far_apart() -> None:
    """Halfway between rows 90 degrees apart the straight line has 0.7 of the response."""
    near = "{response: [[40, 2, 170], [150, 2, -175], [300, 2, -170]]}"
    _, coarse = voltage_costs(parse_rig("rig.yaml", text(near, PLAIN)))
    assert coarse.startswith("SE: response turns by 90 degrees from 40 to 300 Hz")


def test_second_harmonic_by_hand() -> None:
    """A flat response of 2, a bias of 0.25 and full level: U = 1, as strong as the tone.

    Its acceleration is four times as large; at 60 and 120 Hz thresholds differ by their ratio.
    """
    flat = ((10.0, 2.0, 0.0), (1000.0, 2.0, 0.0))
    drive = VoltageDrive(flat, law=Law.QUADRATIC, bias=0.25, frequencies=(60.0, 60.0))
    full = second_harmonic(drive, level=1.0, threshold="vibrotactile-probe")
    half = second_harmonic(drive, level=0.5, threshold="vibrotactile-probe")
    assert full.worst_db - half.worst_db == pytest.approx(20 * math.log10(2))
    at_60, at_120 = detection_threshold(np.array([60.0, 120.0]), "vibrotactile-probe")
    assert full.worst_db == pytest.approx(20 * math.log10(4 * at_60 / at_120))


def test_harmonic_that_is_not_felt_is_left_out() -> None:
    """Above 500 Hz it is beyond the thresholds: the check says nothing of it, and goes on."""
    rows = "response: [[40, 6, 0], [1000, 2, -90]], law: quadratic, bias: 0.4"
    high = text(f"{{{rows}}}", f"{{{rows}}}").replace("[60, 260]", "[510, 600]")
    cost, *_ = voltage_costs(parse_rig("rig.yaml", high))
    assert "harmonic of" not in cost
