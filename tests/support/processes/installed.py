"""Programs and libraries that tests need: found, or the test is skipped, and in CI failed."""

import ctypes.util
import os
import shutil
import sys
from pathlib import Path
from typing import NoReturn

import pytest

ERA = str(Path(sys.executable).with_name("era"))

DEBIAN_PACKAGES = {"cc": "gcc", "jackd": "jackd2", "portaudio": "libportaudio2"}
"""Debian packages of programs and libraries, if their names differ."""


def installed_program(*names: str, package: str = "") -> str:
    """Path of the first program that is found; without any skip the test, fail it where CI is set.

    package: what to install on Debian.
    """
    path = next(filter(None, map(shutil.which, names)), None)
    return path or _miss(names[0], package)


def needs(*names: str) -> None:
    """As `installed_program`, for programs and libraries, all of which the test needs."""
    for name in names:
        if not (shutil.which(name) or ctypes.util.find_library(name)):
            _miss(name, "")


def _miss(name: str, package: str) -> NoReturn:
    package = package or DEBIAN_PACKAGES.get(name, name)
    reason = f"{name} is not installed; on Debian: apt install {package}"
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)
