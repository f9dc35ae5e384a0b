"""What all tests share: one thread for linear algebra, the paper's plate, what is begun first."""

import os
from pathlib import Path

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads: two threads are slower here, and erratic

import pytest  # noqa: E402

from model.rig.rig import Rig  # noqa: E402
from paper_plate import make_paper_rig  # noqa: E402

TESTS = Path(__file__).parent
DEAREST = (
    "test_soak.py",
    "docs/test_tutorials.py",
    "test_docs_site.py",
    "model/commands/test_study_cli.py",
    "test_link_faults.py",
    "integration/test_dashboard.py",
    "controller/test_gateway_process.py",
    "model/commands/test_table_commands.py",
    "controller/test_daemon_over_a_wire.py",
    "model/diagnosis/test_diagnosis.py",
    "model/commands/test_plate_commands.py",
    "errors/test_errors_read.py",
    "model/studies/test_studies.py",
    "era_haptics/test_examples.py",
    "test_wheel.py",
)
"""Begun in this order, before all others: one that began last would go on when a core is idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The dearest files first; the order within each file stays."""
    if missing := [name for name in DEAREST if not (TESTS / name).is_file()]:
        raise pytest.UsageError(f"tests/conftest.py, DEAREST: there is no {', '.join(missing)}")
    place = {TESTS / name: number for number, name in enumerate(DEAREST)}
    items.sort(key=lambda item: place.get(item.path, len(DEAREST)))


@pytest.fixture(scope="session")
def coarse_rig() -> Rig:
    """The paper's own mesh, 12x9."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="session")
def fine_rig() -> Rig:
    """A mesh whose answers are near converged and still cheap, 48x36."""
    return make_paper_rig(48, 36)
