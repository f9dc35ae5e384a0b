"""What a machine lacks skips the tests that use it, by name, and fails them in CI."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = """
import pytest
from typed_page import needs

@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    for mark in item.iter_markers("needs"):
        needs(*mark.args)
"""
TESTS = """
import pytest

@pytest.fixture
def server():
    raise RuntimeError("started without its library")

@pytest.mark.needs("cc", "no-such-library")
def test_user(server): pass

def test_neighbour(): pass
"""


@pytest.mark.parametrize(("ci", "outcome"), [("", "1 passed, 1 skipped"), ("1", "1 error")])
def test_missing_component_skips_its_user_and_not_its_neighbour(
    tmp_path: Path, ci: str, outcome: str
) -> None:
    """Before a fixture fails for it; the reason has its name and the remedy."""
    (tmp_path / "conftest.py").write_text(CONFTEST, "utf-8")
    (tmp_path / "test_users.py").write_text(TESTS, "utf-8")
    more = {"PYTHONPATH": str(Path(__file__).with_name("support")), "CI": ci}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-p", "no:xdist"],
        cwd=tmp_path,
        env=os.environ | more | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert outcome in done.stdout.splitlines()[-1]
    missing = "no-such-library is not installed; on Debian: apt install no-such-library"
    assert missing in done.stdout
