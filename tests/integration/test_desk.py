"""The desk without hardware: real JACK server, plate and commands.

Its short forms have no server, or no plate: tests/era_haptics/lab/measuring/test_measuring.py, test_jack_card.py.
"""

import subprocess
from collections.abc import Iterator

import numpy as np
import pytest

from benchmarks.desk.chain import chain
from benchmarks.desk.identified import identified_errors
from benchmarks.desk.session import BLOCK, EXAMPLES, PLATE, Desk, desk
from benchmarks.desk_plate.model_in_time import DeskModel
from benchmarks.desk_plate.truth import draw_truth
from model.calibration.responses import read_measured, responses_of
from model.rig.rig_file import load_rig

pytestmark = [
    pytest.mark.long,
    pytest.mark.alone,
    pytest.mark.needs("jackd", "cc"),
]

SEED, MESH = 3, "6x4 Q3"


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """A plate behind a JACK server of its own."""
    with desk(tmp_path_factory.mktemp("desk"), seed=SEED, mesh=MESH) as running:
        yield running


@pytest.mark.parametrize(("device", "late"), [("jack:desk", 0), ("desk", 512)])
def test_measured_plate_is_the_one_on_the_desk(plate: Desk, device: str, late: int) -> None:
    """Through JACK or PortAudio and files, against the plate's closed form, and its hidden delay.

    73 samples of converters, a block of JACK, of PortAudio another of its own, and a filter's
    third of a sample; known but for periods of 60 Hz, which the tones have in common.
    """
    told = plate.run(
        "measure", "rig.yaml", "--device", device, "--sensors", "sensors.csv",
        "-o", "measured.csv", "--frequencies", "61:481:60",
    )  # fmt: skip
    assert told["latency_s"] * 48_000 == pytest.approx((73 + BLOCK + late) % 800, abs=0.5)
    rig = load_rig(plate.folder / "rig.yaml")
    found = responses_of(read_measured(plate.folder / "measured.csv"), rig)
    model = DeskModel(draw_truth(rig, seed=SEED, mesh=MESH), found.points).under()
    exact = model.response(found.frequencies).swapaxes(1, 2) / rig.eras[0].stroke
    loud = np.abs(exact) > 0.2 * np.abs(exact).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(found.values[loud], exact[loud], rtol=0.03)


def test_identified_plate_is_the_one_on_the_desk(plate: Desk) -> None:
    """Few tones, through JACK and the command: what drives the plate, its springs, its places."""
    plate.run(
        "rig", "identify", "rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv",
        "-o", "identified.yaml", "--frequencies", "61:481:60", "--yes",
    )  # fmt: skip
    rig = load_rig(plate.folder / "identified.yaml")
    limits = {"stiffness": 0.03, "place": 5e-4, "gain": 0.02, "phase": np.radians(2)}
    errors = [e for e in identified_errors(rig, plate.truth) if e.kind in limits]
    assert len(errors) == 16
    for error in errors:
        assert abs(error.relative) < limits[error.kind], error


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """The same plate with one sensor of 2 g, which is moved to the twelve places."""
    folder = tmp_path_factory.mktemp("moved")
    text = (EXAMPLES / "sensors.csv").read_text("utf-8")
    head, *lines = text.splitlines()
    rows = (line.split(",") for line in lines)
    one = [",".join([*row[:3], "1", *row[4:], "2"]) for row in rows]
    with desk(folder, seed=SEED, mesh=MESH, sensors="\n".join([f"{head},mass_g", *one, ""])) as it:
        yield it


def test_plate_is_identified_by_one_sensor_of_known_mass(moved: Desk) -> None:
    """Guided through twelve places, through JACK: with its mass the plate is explained, and known.

    Without it is refused.
    """
    arguments = ["rig.yaml", "--device", "jack:desk", "--sensors", "sensors.csv"]
    arguments += ["-o", "measured.uff", "--frequencies", "51:491:40"]
    moved.measure_by_moving(*arguments)
    identified = ("rig", "identify", "rig.yaml", "-o", "identified.yaml", "--measured")
    told = moved.run(*identified, "measured.uff")
    limits = {"stiffness": 0.03, "place": 1e-3, "gain": 0.03}
    errors = identified_errors(load_rig(moved.folder / "identified.yaml"), moved.truth)
    for error in (each for each in errors if each.kind in limits):
        assert abs(error.relative) < limits[error.kind], error
    bare = (moved.folder / "measured.uff").read_text("utf-8").replace("mass_g=2 ", "mass_g=0 ")
    (moved.folder / "bare.uff").write_text(bare, "utf-8")
    without = moved.run(*identified, "bare.uff", status=1)
    assert (told["explained"], without["explained"]) == (True, False)


def test_second_plate_of_a_name_is_refused(plate: Desk) -> None:
    """It could not be told from the first, which would be measured in its place."""
    done = subprocess.run(
        [*PLATE, "--mesh", MESH],
        cwd=plate.folder,
        env=plate.environment,
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 3
    assert not done.stdout


def test_chain_from_measurement_to_touches_keeps_its_promises() -> None:
    """Values found are the plate's, promises are kept, and touches are felt where they are.

    Stiffness and damping to some percent, as one plate shows; of one plate's promises some fail.
    """
    found = chain(seed=SEED, promises=6, touched=2)
    assert found.held_out_error < 0.05
    for error in found.errors:
        assert abs(error.relative) < 0.1, error
    assert sum(row["kept"] for row in found.promises) >= 3
    for row in found.promises:
        assert row["measured_level_db_sl"] == pytest.approx(row["promised_level_db_sl"], abs=1)
        assert row["measured_contrast_db"] > row["promised_contrast_db"] - 6
    for error in found.identified.errors:
        limit = 1e-3 if error.kind == "place" else 0.1
        assert abs(error.relative) < limit, error
    assert len(found.touches) == 2
    assert all(touch.measured_db > 6 for touch in found.touches)
