"""Kernels in C for each kind of processor, and the same in numpy where there is no compiler."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cases import shortly
from model.compiled import kernels
from model.errors import InputError

HAS = kernels.processor_features()
RUNNABLE = {each.name: each for each in kernels.versions() if each.features.keys() <= HAS}
FASTEST = next(iter(RUNNABLE))  # the one that is used


@pytest.fixture
def without_kernels(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Callable[[], None]]:
    """Takes the compiler away until the test is over."""

    def fail(*_: object, **__: object) -> None:
        raise InputError("no C compiler")

    def take() -> None:
        monkeypatch.setattr(kernels, "kept_library", fail)
        monkeypatch.setattr(kernels, "KERNEL_FOLDER", tmp_path)  # nor one of a wheel
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
    monkeypatch.setattr(kernels, "processor_features", version.features.keys)
    kernels.kernels.cache_clear()
    found = kernels.kernels()
    assert found is not None, "install a C compiler"
    assert found.lanes == version.lanes
