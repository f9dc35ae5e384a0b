"""Rig files for tests: the paper's plate on a coarse mesh, with what is changed in its text."""

from pathlib import Path

from model.rig.rig_file import example_rig_path


def write_rig(path: Path, *changes: tuple[str, str], mesh: str = "16x12") -> Path:
    """The example's text with these replacements, each of which must find something."""
    text = example_rig_path().read_text(encoding="utf-8")
    for old, new in (("mesh: auto", f"mesh: {mesh}"), *changes):
        assert old in text, old
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")
    return path


TWO_AMPLIFIERS = (
    ('  main: {url: "sim://"}', '  main: {url: "sim://"}\n  side: {url: "sim://"}'),
    ("amplifier: main, channel: 2", "amplifier: side, channel: 0"),
    ("amplifier: main, channel: 3", "amplifier: side, channel: 1"),
)
"""The ERAs NE and NW on an amplifier of their own."""
