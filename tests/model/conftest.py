"""C kernels for each kind of processor, and their references in numpy."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from build_libraries import kernel_library, update
from cases import shortly
from model.compiled import kernels
from model.compiled.versions import versions

HAS = kernels.processor_features()
RUNNABLE = {each.name: each for each in versions() if each.features.keys() <= HAS}
FASTEST = next(iter(RUNNABLE))  # the one that is used


@pytest.fixture
def without_kernels(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[], None]]:
    """Takes the C kernels away until the test is over."""

    def take() -> None:
        monkeypatch.setattr(kernels, "KERNEL_FOLDER", tmp_path)
        kernels.kernels.cache_clear()

    yield take
    monkeypatch.undo()
    kernels.kernels.cache_clear()


@pytest.fixture(params=shortly([*RUNNABLE, "numpy"], [FASTEST, "numpy"]))
def kernels_or_numpy(
    request: pytest.FixtureRequest,
    without_kernels: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Computes with the kernels of each version that this processor can run, and without any."""
    if request.param == "numpy":
        without_kernels()
        return
    version = RUNNABLE[request.param]
    update([kernel_library(version)])
    monkeypatch.setattr(kernels, "processor_features", version.features.keys)
    kernels.kernels.cache_clear()
    found = kernels.kernels()
    assert found is not None
    assert found.lanes == version.lanes
