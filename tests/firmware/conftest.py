"""The firmware's programs, each built once where a test needs it."""

import shutil
from pathlib import Path

import pytest

from firmware_programs import build_firmware


@pytest.fixture(scope="session")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its programs; skipped where there is nothing to build them with."""
    if not (shutil.which("cc") and shutil.which("make")):
        pytest.skip("needs a C compiler and make")
    return tmp_path_factory.mktemp("firmware")


@pytest.fixture(scope="session")
def firmware(compiled: Path) -> Path:
    """That folder, with the amplifier."""
    return build_firmware(compiled, "era-firmware")


@pytest.fixture(scope="session")
def replaying(compiled: Path) -> Path:
    """That folder, with the program that plays scripts."""
    return build_firmware(compiled, "era-replay")
