"""What benchmarks on the paper's plate have in common; numpy is loaded only when it is used."""

import os
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from model.arrays import FloatArray

_ROOT = Path(__file__).parents[1]
RIG = _ROOT / "examples" / "paper_plate.yaml"
APART = 0.05  # m; between the fingers of a contact set
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def use_one_thread() -> None:
    """Let linear algebra use one thread; call before numpy is loaded."""
    os.environ.update(ONE_THREAD)


def support(module: str) -> Any:
    """Return a module of the support of the tests, which they import by its name alone."""
    folder = str(_ROOT / "tests" / "support")
    if folder not in sys.path:
        sys.path.insert(0, folder)
    return import_module(module)


def random_contacts(
    rng: "np.random.Generator",
    count: int,
    size: "tuple[float, float]",
    *,
    margin: float = 0.0,
    apart: float = APART,
    beside: "Sequence[tuple[float, float]]" = (),
) -> "FloatArray":
    """Contacts (count, 2) [m] on a plate of a size, so far apart and so far from its edges.

    beside: places [m] on the plate that they are as far from.
    """
    import numpy as np

    while True:
        places = rng.uniform(margin, np.array(size) - margin, (count, 2))
        every = np.array([*places, *beside])
        gaps = np.linalg.norm(every[:, None] - every, axis=-1)
        if gaps[np.triu_indices(len(every), 1)].min(initial=np.inf) > apart:
            return places
