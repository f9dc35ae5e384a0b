"""The firmware's programs, each built once if a test needs it."""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from processes.installed import needs
from tests.firmware.firmware_machine import build_firmware


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of its programs; skip without a compiler."""
    needs("cc", "make")
    return tmp_path_factory.mktemp("firmware")


@pytest.fixture(scope="session")
def firmware(compiled: Path) -> Path:
    """Return that folder with the amplifier."""
    return build_firmware(compiled, "era-firmware")


@pytest.fixture(scope="session")
def moved(compiled: Path) -> Callable[..., Path]:
    """Return a function that builds the library on a moved clock with compiler options."""

    @cache
    def build(*options: str) -> Path:
        sanitizers = os.environ.get("SANITIZERS", "undefined")
        flags = ("-O1", f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", *options)
        folder = compiled / "-".join(
            ["moved", *(option.strip("-").replace("=", "") for option in options)]
        )
        return build_firmware(folder, "era-moved.so", f"CFLAGS={' '.join(flags)}")

    return build


@pytest.fixture(scope="session")
def replaying(moved: Callable[..., Path]) -> Path:
    """Return the folder of the library with the default options."""
    return moved()
