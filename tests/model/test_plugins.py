"""Things by name, of this package and of plug-ins: what is found, and what is told of the rest."""

import sys
from importlib.metadata import EntryPoint
from types import ModuleType

import pytest

from model import plugins
from model.errors import InputError
from model.plugins import Catalogue

GROUP = "era_test.colours"
COLOURS = Catalogue("colour", str, {"red": "ours"}, group=GROUP, otherwise="; or mix one")


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """Plug-ins: one that works, found twice in one installation, and several that do not."""
    module = ModuleType("era_test_colours")
    vars(module).update(GREEN="theirs", OLIVE="others'", NUMBER=7)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    points = [
        EntryPoint(name, value, GROUP)
        for name, value in (
            ("green", "era_test_colours:GREEN"),
            ("green", "era_test_colours:GREEN"),
            ("red", "era_test_colours:GREEN"),
            ("blue", "era_test_colours:GREEN"),
            ("blue", "era_test_colours:OLIVE"),
            ("missing", "era_no_such_module:COLOUR"),
            ("number", "era_test_colours:NUMBER"),
        )
    ]
    monkeypatch.setattr(plugins, "entry_points", lambda *, group: points)
    plugins._installed.cache_clear()
    yield
    plugins._installed.cache_clear()


def test_a_plugin_is_found_by_its_name_and_names_are_told_without_loading_any():
    """Found twice by the same value it counts once; our own stand first."""
    assert COLOURS.find("green") == "theirs"
    assert COLOURS.names() == ("red", "blue", "green", "missing", "number")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gren", r"unknown colour 'gren'; did you mean green\? known are: red, .*; or mix one$"),
        ("x" * 500, r"unknown colour 'x{40}'; known are"),
        ("red", r"colour red is claimed by several packages \(era-haptics, an unknown package\)"),
        ("blue", r"claimed by several packages .*; uninstall all but one"),
        ("missing", r"the plug-in era_no_such_module:COLOUR .* \(ModuleNotFoundError: .*repair"),
        ("number", r"era_test_colours:NUMBER .* leads to int, not to str; repair"),
    ],
)
def test_what_cannot_be_used_is_told_and_harms_no_other(name, message):
    """Unknown, claimed twice (never silently another one), broken, of another kind."""
    with pytest.raises(InputError, match=message):
        COLOURS.find(name)
    assert COLOURS.find("green") == "theirs"
