import importlib.metadata
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from drivers import registry
from drivers.backends.serial_line.backend import SerialBackend
from drivers.errors import CommandError
from drivers.registry import known_schemes, open_backend

Install = Callable[..., None]
GROUP = "era_haptics.backends"
SERIAL = EntryPoint("serial", "drivers.backends.serial_line.backend:SerialBackend", GROUP)


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Install:
    """Puts other entry points in the place of the installed ones."""

    def install(*entries: EntryPoint) -> None:
        def found(**parameters: str) -> importlib.metadata.EntryPoints:
            return importlib.metadata.EntryPoints(entries).select(**parameters)

        monkeypatch.setattr(registry, "entry_points", found)

    return install


def test_the_installed_backends_are_found() -> None:
    """The distribution registers serial and sim, and a URL is handed to its backend unopened."""
    assert {"serial", "sim"} <= set(known_schemes())
    assert type(open_backend("serial:///dev/no-such-port")) is SerialBackend
    assert type(open_backend("SERIAL:///dev/no-such-port")) is SerialBackend


def test_an_unknown_scheme_is_refused_with_a_guess() -> None:
    """The message lists what there is and guesses what was meant."""
    with pytest.raises(CommandError, match=r"Did you mean serial://\?.*serial, sim"):
        open_backend("seriel:///dev/ttyUSB0")


@pytest.mark.parametrize("url", ["", "/dev/ttyUSB0", "serial:/dev/ttyUSB0"])
def test_what_is_no_url_is_refused_with_an_example(url: str) -> None:
    """A bare device name is answered with how to write it."""
    with pytest.raises(CommandError, match="serial:///dev/ttyUSB0"):
        open_backend(url)


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("no_such_module_at_all:Backend", "ModuleNotFoundError"),
        ("drivers.errors:NoSuchBackend", "AttributeError"),
        ("broken_plugin:Backend", "RuntimeError: half installed"),
        ("drivers.errors:LinkError", "not a class derived from"),
    ],
)
def test_a_broken_plugin_is_named_and_harms_nobody_else(
    value: str,
    problem: str,
    install: Install,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever a plug-in does when imported, only its own URLs fail, and the message names it."""
    (tmp_path / "broken_plugin.py").write_text("raise RuntimeError('half installed')\n")
    monkeypatch.syspath_prepend(tmp_path)
    install(SERIAL, EntryPoint("broken", value, GROUP))
    with pytest.raises(CommandError, match=problem):
        open_backend("broken://x")
    assert type(open_backend("serial:///dev/no-such-port")) is SerialBackend


def test_backends_are_imported_only_when_asked_for(install: Install) -> None:
    """A URL imports its own backend and no other."""
    install(SERIAL, EntryPoint("other", "antigravity:Backend", GROUP))
    open_backend("serial:///dev/no-such-port")
    assert "antigravity" not in sys.modules


def test_two_backends_for_one_scheme_are_refused(install: Install) -> None:
    """Which of two plug-ins drives the hardware is not left to chance."""
    install(SERIAL, EntryPoint("serial", "elsewhere:Backend", GROUP))
    with pytest.raises(CommandError, match="several"):
        open_backend("serial:///dev/no-such-port")
