"""What clocks that are off cost two contents, as `era config check` tells it."""

import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from typer.testing import CliRunner

from drivers.urls import CLOCK_ERRORS
from model.cli import app
from model.rig.rig import Channel, Uncertainty
from model.rig.rig_file import example_rig_path
from model.study.overview import ClockCost, clock_cost
from plates import smooth_rig

IDENTIFIED = Uncertainty(0.015, 1.5, 0.002, 0.01, 1.1, 0.5, modulus=0.0, place=0.0, harmonic=0.0)
RIG = """
plate: {length: 305 mm, width: 229 mm, thickness: 1.5 mm, material: aluminium}
mesh: 6x5 Q4
eras:
  SW: {at: [0, 0], stiffness: 17e3, amplifier: a, channel: 0}
  SE: {at: [305 mm, 0], stiffness: 17e3, amplifier: a, channel: 1}
  NW: {at: [0, 229 mm], stiffness: 17e3, amplifier: b, channel: 0}
  NE: {at: [305 mm, 229 mm], stiffness: 17e3, amplifier: b, channel: 1}
amplifiers:
  a: {url: "serial:///dev/ttyUSB0"}
  b: {url: "serial:///dev/ttyUSB1"%s}
limits: {frequency: [40 Hz, 250 Hz]}
uncertainty: {gain: 0.5 %%, phase_deg: 0.5, thickness: 0.1 %%, stiffness: 0.5 %%, damping: 1.02}
"""
USB_US = round(1e6 * math.hypot(CLOCK_ERRORS["ftdi-low-latency"], 5e-6 / math.sqrt(3)), 1)


def test_contrast_falls_with_the_error_and_stays_with_one_amplifier() -> None:
    """Two amplifiers of two ERAs each; one with all of them loses nothing whatever its clock."""
    rig = replace(smooth_rig(), uncertainty=IDENTIFIED)
    halves = {era.name: Channel("ab"[n % 2], n // 2) for n, era in enumerate(rig.eras)}
    both = replace(rig, wiring=halves)
    costs = [clock_cost(both, {"a": each, "b": each}) for each in (0.0, 2e-5, 2e-4, math.inf)]
    kept = [each.kept_db for each in costs]
    assert kept[0] == costs[0].exact_db
    assert kept == sorted(kept, reverse=True)
    assert kept[0] - kept[1] < 2 < kept[0] - kept[3]
    one = replace(rig, wiring={era.name: Channel("a", n) for n, era in enumerate(rig.eras)})
    assert clock_cost(one, {"a": math.inf}) == ClockCost(costs[0].exact_db, costs[0].exact_db)


@pytest.mark.parametrize(("length", "width", "said"), [("60 cm", "40 cm", 1), ("12 in", "9 in", 0)])
def test_config_check_remarks_eras_on_a_small_part_of_the_plate(
    tmp_path: Path, length: str, width: str, said: int
) -> None:
    """12 x 9 in of 60 x 40 cm are 29 %; spread to the corners ERAs promise more. Still good."""
    text = example_rig_path().read_text("utf-8")
    text = text.replace("length: 12 in", f"length: {length}").replace(
        "width: 9 in", f"width: {width}"
    )
    file = tmp_path / "rig.yaml"
    file.write_text(text)
    result = CliRunner().invoke(app, ["config", "check", str(file), "--json"])
    assert result.exit_code == 0
    remarks = [each for each in json.loads(result.output)["warnings"] if "span" in each]
    assert len(remarks) == said
    for each in remarks:
        assert "29 %" in each
        here, there = (float(number) for number in re.findall(r"([0-9.]+) dB", each))
        assert here + 1 < there


@pytest.mark.parametrize(
    ("more", "error_us", "warnings"), [("", USB_US, 1), (", clock_error: unknown", None, 2)]
)
def test_config_check_tells_what_clocks_cost(
    tmp_path: Path, more: str, error_us: float | None, warnings: int
) -> None:
    """Over USB: that of the line, and 5 us / sqrt(3) of the amplifier; and which plays alone."""
    file = tmp_path / "rig.yaml"
    file.write_text(RIG % more)
    run = partial(CliRunner().invoke, app)
    found = json.loads(run(["config", "check", str(file), "--json"]).output)
    assert found["ok"]
    clocks = found["clocks"]
    assert clocks["error_us"] == {"a": USB_US, "b": error_us}
    assert clocks["kept_contrast_db"] < clocks["exact_contrast_db"]
    assert len([each for each in found["warnings"] if "contents" in each]) == warnings
