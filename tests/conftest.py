"""What all tests share: one thread for linear algebra, the paper's plate, the order of files."""

import os
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads: two threads are slower here, and erratic

import pytest  # noqa: E402

from model.rig.rig import Rig  # noqa: E402
from paper_plate import make_paper_rig  # noqa: E402

SLOWEST = (
    "test_tutorials.py",
    "test_dashboard.py",
    "test_demo.py",
    "test_soak.py",
    "test_amplifier_contract.py",
    "test_table_commands.py",
    "test_daemon_over_a_wire.py",
    "test_daemon_process.py",
    "test_table_build.py",
    "test_nothing_is_lost.py",
    "test_how_to_pages.py",
    "test_rig_check_over_wires.py",
    "test_diagnosis.py",
    "test_calibration.py",
    "test_docs_site.py",
    "test_study_cli.py",
    "test_dashboard_losses.py",
    "test_gateway_api.py",
    "test_wheel.py",
    "test_calibrate_on_the_bench.py",
    "test_gateway_process.py",
    "test_live_demo.py",
    "test_convergence.py",
    "test_errors.py",
)
"""Run in this order before all others: one that started last would leave the other cores idle."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files without a test that runs alone: importing all takes ten seconds."""
    if config.option.markexpr != "alone" or collection_path.suffix != ".py":
        return None
    return True if "mark.alone" not in collection_path.read_text("utf-8") else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest files first; the order within each file stays."""
    place = {name: number for number, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(SLOWEST)))


@pytest.fixture(scope="session")
def coarse_rig() -> Rig:
    """The paper's own mesh, 12x9."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="session")
def fine_rig() -> Rig:
    """A mesh whose answers are near converged and still cheap, 48x36."""
    return make_paper_rig(48, 36)
