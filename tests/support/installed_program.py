"""The `era` under test, and programs of the system that a machine may lack."""

import os
import shutil
import sys
from pathlib import Path

import pytest

ERA = str(Path(sys.executable).with_name("era"))


def installed_program(*names: str, package: str) -> str:
    """Path of the first program that is found; without any skip the test, fail it under CI=true.

    package: what to install on Debian.
    """
    for name in names:
        if found := shutil.which(name):
            return found
    reason = f"{names[0]} is not installed; on Debian: apt install {package}"
    if os.environ.get("CI") == "true":
        pytest.fail(reason)
    pytest.skip(reason)
