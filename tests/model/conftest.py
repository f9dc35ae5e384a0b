"""Kernels in C, and the same in numpy where there is no compiler."""

from collections.abc import Callable, Iterator

import pytest

from model.compiled import kernels
from model.errors import InputError


@pytest.fixture
def without_kernels(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Takes the compiler away until the test is over."""

    def fail(*_: object, **__: object) -> None:
        raise InputError("no C compiler")

    def take() -> None:
        monkeypatch.setattr(kernels, "kept_library", fail)
        kernels.kernels.cache_clear()

    yield take
    monkeypatch.undo()
    kernels.kernels.cache_clear()


@pytest.fixture(params=["C", "numpy"])
def kernels_or_numpy(request: pytest.FixtureRequest, without_kernels: Callable[[], None]) -> None:
    """Computes with kernels, and without."""
    if request.param == "numpy":
        without_kernels()
    else:
        assert kernels.kernels() is not None, "install a C compiler"
