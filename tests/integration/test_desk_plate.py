"""A plate on a desk with a simulated sound card, from its measurement to its touches."""

import subprocess
from collections.abc import Iterator

import numpy as np
import pytest

from model.rig.rig_file import load_rig
from tests.integration.desk import DEVICE, PLATE, Desk, desk, identified_errors, session

SEED, DESK_MESH = 3, "6x4 Q3"


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """A plate behind a JACK server of its own."""
    with desk(tmp_path_factory.mktemp("desk"), seed=SEED, mesh=DESK_MESH) as running:
        yield running


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.needs("jackd", "cc")
def test_identified_plate_is_the_one_on_the_desk(plate: Desk) -> None:
    """Few tones, through the command: what drives the plate, its springs, its places.

    A second plate of that name is refused: it would be measured in place of the first.
    """
    plate.run(
        "rig", "identify", "rig.yaml", "--device", DEVICE, "--sensors", "sensors.csv",
        "-o", "identified.yaml", "--frequencies", "61:481:60", "--yes",
    )  # fmt: skip
    rig = load_rig(plate.folder / "identified.yaml")
    limits = {"stiffness": 0.03, "place": 5e-4, "gain": 0.02, "phase": np.radians(2)}
    errors = [e for e in identified_errors(rig, plate.truth) if e.kind in limits]
    assert len(errors) == 16
    for error in errors:
        assert abs(error.size) < limits[error.kind], error
    done = subprocess.run(
        [*PLATE, "--mesh", DESK_MESH],
        cwd=plate.folder,
        env=plate.environment,
        capture_output=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stdout) == (3, b"")


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.needs("jackd", "cc")
def test_chain_from_measurement_to_touches_keeps_its_promises() -> None:
    """Values found are the plate's, and touches are felt where they are.

    Stiffness and damping to some percent, as one plate shows.
    """
    results = session(seed=SEED, touched=2)
    assert results.held_out_error < 0.05
    for error in results.calibrated:
        assert abs(error.size) < 0.1, error
    for error in results.identified:
        limit = 1e-3 if error.kind == "place" else 0.1
        assert abs(error.size) < limit, error
    assert len(results.touches) == 2
    assert min(touch.measured_db for touch in results.touches) > 6
