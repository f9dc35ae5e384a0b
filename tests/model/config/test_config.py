from pathlib import Path
from typing import Annotated

import pytest

from model.config.document import ConfigError, read_document
from model.config.sections import Quantity, Section, Validation
from model.config.units import FREQUENCY, LENGTH


class Inner(Section):
    """A section in a mapping by name."""

    size: Annotated[float, Quantity(LENGTH, above=0, at_most=1)]
    word: str = "none"


class Outer(Section):
    """A section for these tests."""

    parts: dict[str, Inner]
    rate: Annotated[float, Quantity(FREQUENCY, at_least=10, below=20)] = 15.0
    armed: bool = False


def read(folder: Path, text: str) -> Validation[Outer]:
    """A validation of this text."""
    path = folder / "daemon.yaml"
    path.write_text(text, encoding="utf-8")
    return Validation(read_document(path), Outer)


def problems(validation: Validation[Outer]) -> list[tuple[int | None, str, str]]:
    """Line, key and message of all problems of a validation."""
    with pytest.raises(ConfigError) as caught:
        validation.finish()
    return [(problem.line, problem.key, problem.message) for problem in caught.value.problems]


def test_validation_returns_the_section_of_a_valid_file(tmp_path: Path) -> None:
    """Values with units are converted."""
    validation = read(tmp_path, "parts:\n  a: {size: 2 mm}\nrate: 10\narmed: true\n")
    assert validation.finish() == Outer(parts={"a": Inner(size=0.002)}, rate=10, armed=True)


def test_validation_reports_all_problems_in_the_order_of_lines(tmp_path: Path) -> None:
    """Unknown and missing keys, wrong types and bounds are reported, with suggestions."""
    text = "rate: 20\nparst: 1\narmed: yes\nparts:\n  a: {sise: 1, size: 0}\n  b: {word: 5}\n  c:\n"
    found = problems(read(tmp_path, text))
    assert [(line, key) for line, key, _ in found] == [
        (1, "rate"),
        (2, "parst"),
        (3, "armed"),
        (5, "parts.a.size"),
        (5, "parts.a.sise"),
        (6, "parts.b.size"),
        (6, "parts.b.word"),
        (7, "parts.c"),
    ]
    for (_, _, message), part in zip(
        found,
        [
            "below 20 Hz, got 20",
            "parts?",
            "'yes'",
            "above 0 m",
            "size?",
            "add",
            "quotes",
            "nothing",
        ],
        strict=True,
    ):
        assert part in message


def test_validation_reports_no_more_than_the_first_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fifty of a thousand unknown keys are reported, and no suggestion made for the others."""
    suggested: list[str] = []
    monkeypatch.setattr(
        "model.config.sections.did_you_mean", lambda name, known: suggested.append(name) or ""
    )
    text = "parts: {}\n" + "".join(f"key{number}: 1\n" for number in range(1000))
    found = problems(read(tmp_path, text))
    assert [line for line, _, _ in found] == list(range(2, 52))
    assert len(suggested) == 51


def test_validation_reports_problems_of_the_caller_with_its_own(tmp_path: Path) -> None:
    """All are in the order of lines."""
    validation = read(tmp_path, "parts:\n  a: {size: 1}\nrate: 5 m\n")
    validation.add(("parts", "a", "size"), "odd")
    found = [(line, key) for line, key, _ in problems(validation)]
    assert found == [(2, "parts.a.size"), (3, "rate")]


def test_validation_returns_valid_parts_of_an_invalid_file(tmp_path: Path) -> None:
    """Sections and fields are returned by themselves; invalid or missing ones are None."""
    validation = read(tmp_path, "parts:\n  a: {size: 1 cm, word: 5}\n  b: {size: 2 cm}\n")
    assert validation.part(("parts", "a"), Inner) is None
    assert validation.part(("parts", "b"), Inner) == Inner(size=0.02)
    assert validation.part(("parts", "c"), Inner) is None
    assert validation.field(("parts", "a", "size"), Inner) == 0.01
    assert validation.field(("parts", "a", "word"), Inner) is None
    assert list(validation.mapping(("parts",))) == ["a", "b"]
    assert validation.mapping(("rate",)) == {}
