"""The desk without hardware, its short form: real JACK server, plate and commands."""

import csv
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.desk.session import Desk, desk
from model.calibration.responses import responses_of
from model.calibration.responses_file import read_functions
from model.rig.file import load_rig
from sim.desk.model_in_time import DeskModel
from sim.desk.truth import draw_truth

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.skipif(
        not (shutil.which("jackd") and shutil.which("cc")), reason="needs jackd2 and a C compiler"
    ),
]

SEED, MESH = 3, "6x4 Q3"


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """A plate behind a JACK server of its own."""
    with desk(tmp_path_factory.mktemp("desk"), seed=SEED, mesh=MESH) as running:
        yield running


def test_measured_plate_is_the_one_on_the_desk(plate: Desk) -> None:
    """Through JACK and files, against the plate's closed form, and its hidden delay.

    73 samples of converters, a block of JACK, and a filter's third of a sample.
    """
    told = plate.run(
        "measure", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
        "-o", "measured.csv", "--frequencies", "61:481:60",
    )  # fmt: skip
    assert told["latency_s"] * 48_000 == pytest.approx(73 + 128, abs=0.5)
    rig = load_rig(plate.folder / "rig.yaml")
    found = responses_of(read_functions(plate.folder / "measured.csv"), rig)
    model = DeskModel(draw_truth(rig, seed=SEED, mesh=MESH), found.points).under()
    exact = model.response(found.frequencies).swapaxes(1, 2) / rig.eras[0].stroke
    loud = np.abs(exact) > 0.2 * np.abs(exact).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found.values[loud], exact[loud], rtol=0.03)


def test_swapped_inputs_are_refused_through_jack(plate: Desk, tmp_path: Path) -> None:
    """The last sensor's line names the input of the loop-back: exit status 2, and no file."""
    with (plate.folder / "sensors.csv").open() as lines:
        rows = list(csv.DictReader(lines))
    wrong = tmp_path / "wrong.csv"
    with wrong.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows([*rows[:-1], rows[-1] | {"input": "13"}])
    with pytest.raises(RuntimeError, match="status 2"):
        plate.run(
            "measure", "rig.yaml", "--device", "jack:desk", "--sensors", wrong,
            "-o", tmp_path / "m.csv", "--frequencies", "61:121:60",
        )  # fmt: skip
    assert not (tmp_path / "m.csv").exists()
