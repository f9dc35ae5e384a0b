"""Suggestions for mistyped names."""

import pytest

from registry.plugins import did_you_mean


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("aluminum", ["steel", "aluminium"], "did you mean aluminium? "),
        ("sw", ["SW", "SE"], "did you mean SW? "),
        ("Steal", ["iron", "steel"], "did you mean steel? "),
        ("unobtainium", ["steel", "aluminium"], ""),
        (
            "Glass",
            ["soda-lime-glass", "steel", "gorilla-glass"],
            "did you mean soda-lime-glass or gorilla-glass? ",
        ),
        ("lass", ["soda-lime-glass"], ""),
        ("level", ["rig", "level_db_sl", "log"], "did you mean level_db_sl? "),
        ("", ["steel"], ""),
        ("x", [], ""),
    ],
)
def test_did_you_mean_suggests_similar_names(name: str, known: list[str], meant: str) -> None:
    """Mistyped names, another case and one word of a name are understood."""
    assert did_you_mean(name, known) == meant


def test_did_you_mean_ignores_a_common_ending() -> None:
    """`usb://` is more similar to `sim://` than `usb` to `sim`."""
    assert did_you_mean("usb", ["sim"], ending="://") == ""
    assert did_you_mean("usb://", ["sim://"]) != ""
    assert did_you_mean("sym", ["sim"], ending="://") == "did you mean sim://? "
