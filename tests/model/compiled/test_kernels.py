"""Where the library of kernels comes from."""

from collections.abc import Callable

from model.compiled.kernels import kernels


def test_machine_without_a_compiler_has_none(without_kernels: Callable[[], None]) -> None:
    """No library, and no error; with one there is a library."""
    assert kernels() is not None
    without_kernels()
    assert kernels() is None
