from pathlib import Path
from typing import Annotated

import pytest

from model.config.document import ConfigError, read_document
from model.config.sections import Quantity, Section, Validation
from model.config.units import FREQUENCY, LENGTH


class Inner(Section):
    """A section in a mapping by name."""

    size: Annotated[float, Quantity(LENGTH, above=0, most=1)]
    word: str = "none"


class Outer(Section):
    """A section that is made up for these tests, as a daemon's would be."""

    parts: dict[str, Inner]
    rate: Annotated[float, Quantity(FREQUENCY, least=10, below=20)] = 15.0
    armed: bool = False


def read(folder: Path, text: str) -> Validation:
    """A validation of this text."""
    path = folder / "daemon.yaml"
    path.write_text(text, encoding="utf-8")
    return Validation(read_document(path), Outer)


def problems(validation: Validation) -> list[str]:
    """What a validation has found, a line each."""
    with pytest.raises(ConfigError) as caught:
        validation.finish()
    folder = Path(caught.value.source).parent
    return [
        f"{problem.line} {problem.key}: {problem.message}".replace(str(folder), "")
        for problem in caught.value.problems
    ]


def test_a_file_in_order_has_no_problems(tmp_path: Path) -> None:
    """Nothing is raised, and a section can be had with its units converted."""
    validation = read(tmp_path, "parts:\n  a: {size: 2 mm}\nrate: 10\narmed: true\n")
    validation.finish()
    assert validation.part((), Outer) == Outer(parts={"a": Inner(size=0.002)}, rate=10, armed=True)


def test_every_problem_is_said_in_the_order_of_lines(tmp_path: Path) -> None:
    """Unknown, missing, mistyped and out of range, each with line and key, in one error."""
    text = "rate: 20\nparst: 1\narmed: yes\nparts:\n  a: {sise: 1, size: 0}\n  b: {word: 5}\n  c:\n"
    assert problems(read(tmp_path, text)) == [
        "1 rate: 20 is out of range, must be at least 10 Hz and below 20 Hz; "
        "a bare number is in Hz",
        "2 parst: unknown key; did you mean parts? known here are: parts, rate, armed",
        "3 armed: must be a valid boolean, not 'yes'",
        "5 parts.a.size: 0 is out of range, must be above 0 m and at most 1 m; "
        "a bare number is in m",
        "5 parts.a.sise: unknown key; did you mean size? known here are: size, word",
        "6 parts.b.size: is missing; add it",
        "6 parts.b.word: must be a text, not 5; write it in quotes",
        "7 parts.c: must be a mapping, `key: value` each on a line, not nothing",
    ]


def test_a_check_of_our_own_joins_the_others(tmp_path: Path) -> None:
    """What a caller notes is raised together with what the sections refuse."""
    validation = read(tmp_path, "parts:\n  a: {size: 1}\nrate: 5 m\n")
    validation.add(("parts", "a", "size"), "is odd")
    assert [line.split(":")[0] for line in problems(validation)] == ["2 parts.a.size", "3 rate"]


def test_what_is_in_order_can_be_had_beside_what_is_not(tmp_path: Path) -> None:
    """Sections and fields are read by themselves; None where they are wrong or not there."""
    validation = read(tmp_path, "parts:\n  a: {size: 1 cm, word: 5}\n  b: {size: 2 cm}\n")
    assert validation.part(("parts", "a"), Inner) is None
    assert validation.part(("parts", "b"), Inner) == Inner(size=0.02)
    assert validation.part(("parts", "c"), Inner) is None
    assert validation.field(("parts", "a", "size"), Inner) == 0.01
    assert validation.field(("parts", "a", "word"), Inner) is None
    assert list(validation.mapping(("parts",))) == ["a", "b"]
    assert validation.mapping(("rate",)) == {}


def test_a_long_value_is_shown_short(tmp_path: Path) -> None:
    """A message does not repeat a page of text."""
    (said,) = problems(read(tmp_path, f"parts: [{'x' * 5000}]\n"))
    assert len(said) < 150
