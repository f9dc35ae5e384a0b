"""Which name is taken to be meant by a mistyped one."""

import pytest

from registry.suggestions import did_you_mean


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
        ("", ["steel"], ""),
        ("x", [], ""),
    ],
)
def test_only_what_is_nearly_the_same_is_meant(name: str, known: list[str], meant: str) -> None:
    """A letter left out or turned round, in whatever case, or a word; not what sounds alike."""
    assert did_you_mean(name, known) == meant


def test_what_ends_all_names_makes_none_alike() -> None:
    """`usb://` has more in common with `sim://` than `usb` with `sim`, and does not mean it."""
    assert did_you_mean("usb", ["sim"], ending="://") == ""
    assert did_you_mean("usb://", ["sim://"]) != ""
    assert did_you_mean("sym", ["sim"], ending="://") == "did you mean sim://? "
