"""The firmware's programs, each built once where a test needs it."""

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from processes.installed import needs
from tests.firmware.firmware_machine import build_firmware


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its programs; skipped where there is nothing to build them with."""
    needs("cc", "make")
    return tmp_path_factory.mktemp("firmware")


@pytest.fixture(scope="session")
def firmware(compiled: Path) -> Path:
    """That folder, with the amplifier."""
    return build_firmware(compiled, "era-firmware")


@pytest.fixture(scope="session")
def moved(compiled: Path) -> Callable[..., Path]:
    """The folder of the library on a moved clock, built with options of the compiler."""

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
    """That folder, of the firmware as it is."""
    return moved()
