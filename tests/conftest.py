"""What all tests share: one thread for linear algebra, and the paper's plate on two meshes."""

import os

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # before numpy loads: two threads are slower here, and erratic

import pytest  # noqa: E402

from model.rig.rig import Rig  # noqa: E402
from paper_plate import make_paper_rig  # noqa: E402


@pytest.fixture(scope="session")
def coarse_rig() -> Rig:
    """The paper's own mesh, 12x9."""
    return make_paper_rig(12, 9)


@pytest.fixture(scope="session")
def fine_rig() -> Rig:
    """A mesh whose answers are near converged and still cheap, 48x36."""
    return make_paper_rig(48, 36)
