"""The firmware, built once."""

import shutil
from pathlib import Path

import pytest

from firmware_programs import build_firmware


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of its programs for this machine."""
    if not (shutil.which("cc") and shutil.which("make")):
        pytest.skip("needs a C compiler and make")
    return build_firmware(tmp_path_factory.mktemp("firmware"))


@pytest.fixture(scope="session")
def bare_metal(firmware: Path) -> Path:
    """The folder of its programs for a Cortex-M3, to be run in QEMU."""
    if not (shutil.which("arm-none-eabi-gcc") and shutil.which("qemu-system-arm")):
        pytest.skip("needs gcc-arm-none-eabi and qemu-system-arm")
    return firmware
