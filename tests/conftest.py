"""What all tests share: one thread for linear algebra, the paper's plate, what is begun first."""

import os
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads: two threads are slower here, and erratic

import pytest  # noqa: E402

from model.rig.rig import Rig  # noqa: E402
from paper_plate import make_paper_rig  # noqa: E402

DEAREST = (
    "test_soak.py",
    "test_demo.py",
    "test_tutorials.py",
    "test_study_cli.py",
    "test_docs_site.py",
    "test_link_faults.py",
    "test_dashboard.py",
    "test_gateway_process.py",
    "test_table_commands.py",
    "test_daemon_over_a_wire.py",
    "test_daemon_process.py",
    "test_diagnosis.py",
    "test_plate_commands.py",
    "test_errors_read.py",
    "test_studies.py",
    "test_examples.py",
    "test_calibration.py",
    "test_wheel.py",
)
"""Begun in this order, before all others: one that began last would go on when a core is idle."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Of those that run alone, leave out files that hold none: reading all takes ten seconds."""
    if config.option.markexpr != "alone" or collection_path.suffix != ".py":
        return None
    return True if "mark.alone" not in collection_path.read_text("utf-8") else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The dearest files first; the order within each file stays."""
    place = {name: number for number, name in enumerate(DEAREST)}
    items.sort(key=lambda item: place.get(item.path.name, len(DEAREST)))


@pytest.fixture(scope="session")
def coarse_rig() -> Rig:
    """The paper's own mesh, 12x9."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="session")
def fine_rig() -> Rig:
    """A mesh whose answers are near converged and still cheap, 48x36."""
    return make_paper_rig(48, 36)
