"""Touch sources by the scheme of their URL."""

import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from types import ModuleType

import pytest

from controller import touch_registry
from controller.sources.tuio import TuioSource
from controller.touch import TouchFrame, TouchSource
from controller.touch_registry import GROUP, open_source
from model.errors import InputError


class Fine(TouchSource):
    """A plug-in that works."""

    def __init__(self, url: str) -> None:
        self.url = url

    async def run(self, deliver: Callable[[TouchFrame], None]) -> None:
        """See nothing."""


def _raises(url: str) -> TouchSource:
    raise RuntimeError("no such device")


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Installed plug-ins: one that works and several that do not."""
    module = ModuleType("era_test_plugins")
    vars(module).update(Fine=Fine, raises=_raises, nothing=lambda url: None)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    points = [
        EntryPoint("fine", f"{module.__name__}:Fine", GROUP),
        EntryPoint("missing", "era_no_such_module:Source", GROUP),
        EntryPoint("raises", f"{module.__name__}:raises", GROUP),
        EntryPoint("nothing", f"{module.__name__}:nothing", GROUP),
    ]
    monkeypatch.setattr(touch_registry, "entry_points", lambda *, group: points)


def test_our_own_sources_are_registered(tmp_path: Path) -> None:
    """The sources of this distribution are found by the schemes that its metadata gives them."""
    assert isinstance(open_source("tuio:127.0.0.1:0"), TuioSource)
    with pytest.raises(InputError, match=r"^/.*missing\.events: cannot be read"):
        open_source(f"evemu:{tmp_path / 'missing.events'}")


def test_unknown_scheme() -> None:
    """A mistyped scheme is answered with the one that was meant and all that are known."""
    with pytest.raises(InputError, match=r"'tuoi'; did you mean tuio:\? known are .*evemu:, .*"):
        open_source("tuoi:127.0.0.1:3333")
    with pytest.raises(InputError, match=r"unknown kind 'taps\.events'; known are"):
        open_source("taps.events")


@pytest.mark.usefixtures("plugins")
def test_a_broken_plugin_disturbs_no_other() -> None:
    """A plug-in that cannot even be imported does not keep another from working."""
    source = open_source("fine:anything")
    assert isinstance(source, Fine)
    assert source.url == "fine:anything"


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    ("url", "complaint"),
    [
        ("missing:", "era_no_such_module:Source .* does not work .ModuleNotFoundError"),
        ("raises:", "does not work .RuntimeError: no such device"),
        ("nothing:", "does not make a TouchSource"),
    ],
)
def test_a_broken_plugin_is_reported(url: str, complaint: str) -> None:
    """Whatever is wrong with a plug-in becomes an input error that names it."""
    with pytest.raises(InputError, match=complaint):
        open_source(url)
