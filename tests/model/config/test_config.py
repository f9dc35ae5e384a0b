"""Configuration: sections, units, points, and edits that keep the text of a file."""

import math
import re
from collections.abc import Mapping
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

import pytest
import yaml
from hypothesis import given as for_all
from hypothesis import strategies as st

from cases import read_yaml
from model.config import document as reading
from model.config import units
from model.config.document import (
    ConfigError,
    Document,
    data_text,
    parse_document,
    read_document,
)
from model.config.fields import Quantity, Section, Validation
from model.config.units import (
    FREQUENCY,
    LENGTH,
    TEMPERATURE,
    Dimension,
    quantity,
    unit_scale,
)
from model.errors import InputError

VALUES = read_yaml(Path(__file__).with_name("values.yaml"))


def write(folder: Path, content: str | bytes) -> Path:
    """Write a file with this content."""
    path = folder / "file.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def read(folder: Path, content: str | bytes) -> Document:
    """Return the document of a file with this content."""
    return read_document(write(folder, content))


# Sections


class Inner(Section):
    """A section in a mapping by name."""

    size: Annotated[float, Quantity(LENGTH, above=0, at_most=1)]
    word: str = "none"


class Outer(Section):
    """A section for these tests."""

    parts: dict[str, Inner]
    rate: Annotated[float, Quantity(FREQUENCY, at_least=10, below=20)] = 15.0
    armed: bool = False


def validation_of(folder: Path, text: str) -> Validation[Outer]:
    """Return a validation of a text."""
    return Validation(read(folder, text), Outer)


def problems(validation: Validation[Outer]) -> list[tuple[int | None, str, str]]:
    """Return the line, key and message of all problems of a validation."""
    with pytest.raises(ConfigError) as error:
        validation.finish()
    return [(problem.line, problem.key, problem.message) for problem in error.value.problems]


def test_validation_reports_all_problems_in_the_order_of_lines(tmp_path: Path) -> None:
    """Unknown and missing keys, wrong types and bounds are reported, with suggestions."""
    text = "rate: 20\nparst: 1\narmed: yes\nparts:\n  a: {sise: 1, size: 0}\n  b: {word: 5}\n  c:\n"

    reported = problems(validation_of(tmp_path, text))

    expected = [
        (1, "rate", "below 20 Hz, got 20"),
        (2, "parst", "parts?"),
        (3, "armed", "'yes'"),
        (5, "parts.a.size", "above 0 m"),
        (5, "parts.a.sise", "size?"),
        (6, "parts.b.size", "add"),
        (6, "parts.b.word", "quotes"),
        (7, "parts.c", "nothing"),
    ]
    assert [(line, key) for line, key, _ in reported] == [(line, key) for line, key, _ in expected]
    for (*_, message), (_, key, part) in zip(reported, expected, strict=True):
        assert part in message, key


def test_validation_reports_no_more_than_the_first_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fifty of a thousand unknown keys; for the others no suggestion is made."""
    names: list[str] = []

    def suggest(name: str, keys: object) -> str:
        names.append(name)
        return ""

    monkeypatch.setattr("model.config.fields.did_you_mean", suggest)
    keys = "".join(f"key{number}: 1\n" for number in range(1000))

    reported = problems(validation_of(tmp_path, f"parts: {{}}\n{keys}"))

    assert [line for line, *_ in reported] == list(range(2, 52))
    assert len(names) == 51


def test_validation_returns_valid_parts_of_an_invalid_file(tmp_path: Path) -> None:
    """Sections and fields are returned separately; invalid or missing ones are None.

    Problems of the caller are reported with its own, in the order of lines.
    """
    text = "parts:\n  a: {size: 1 cm, word: 5}\n  b: {size: 2 cm}\nrate: 5 m\n"
    validation = validation_of(tmp_path, text)

    assert validation.part(("parts", "a"), Inner) is None
    assert validation.part(("parts", "b"), Inner) == Inner(size=0.02)
    assert validation.part(("parts", "c"), Inner) is None
    assert validation.field(("parts", "a", "size"), Inner) == 0.01
    assert validation.field(("parts", "a", "word"), Inner) is None
    assert list(validation.mapping(("parts",))) == ["a", "b"]
    assert validation.mapping(("rate",)) == {}
    validation.add(("parts", "b", "size"), "odd")
    keys = [(line, key) for line, key, _ in problems(validation)]
    assert keys == [(2, "parts.a.word"), (3, "parts.b.size"), (4, "rate")]


# Quantities


@pytest.mark.parametrize("name", VALUES["si"])
def test_quantity_converts_to_si_exactly(name: str) -> None:
    """Common units and spellings are exact to the last bit; a bare number is in SI.

    An inch is 25.4 mm by definition; micro is written with the micro sign or the Greek letter.
    """
    expected = VALUES["si"][name]
    dimension = getattr(units, name)

    assert {value: quantity(value, dimension) for value in expected} == expected


@pytest.mark.parametrize(
    "value", [math.nan, math.inf, -math.inf, 10**400, True, None, [1], {"m": 1}, b"1 m", "1" * 41]
)
def test_quantity_refuses_another_value(value: object) -> None:
    """Numbers that are not finite, truth values and containers, and texts that are too long."""
    with pytest.raises(InputError, match=r"1\.5 mm") as error:
        quantity(value, LENGTH)

    assert len(str(error.value)) < 200


@for_all(st.text(max_size=60) | st.text(alphabet="0123456789.eE+-*/^% mkgNsPainHz()", max_size=60))
def test_quantity_raises_input_error_only(text: str) -> None:
    """No text raises anything but InputError."""
    try:
        quantity(text, LENGTH)
    except InputError:
        return


DIMENSIONS = [value for value in vars(units).values() if isinstance(value, Dimension)]


@pytest.mark.parametrize("dimension", DIMENSIONS, ids=lambda dimension: dimension.name)
def test_common_factors_are_those_of_pint(dimension: Dimension) -> None:
    """They agree to the last digit, so it does not matter which of the two is used."""
    for unit, factor in dimension.factors.items():
        if unit != dimension.unit:
            assert unit_scale(f"1 {unit}", unit, dimension) == (Decimal(factor), 0), unit


@pytest.mark.parametrize("text", VALUES["celsius"])
def test_temperature_counts_from_the_zero_of_its_unit(text: str) -> None:
    """By the definitions of the scales: 0 degC is 273.15 K, 32 degF and 491.67 degR."""
    assert quantity(text, TEMPERATURE) == VALUES["celsius"][text]


@pytest.mark.parametrize(
    ("text", "slope"), [("0.05 %/degC", 5e-4), ("0.05 %/K", 5e-4), ("0.05 %/degF", 9e-4)]
)
def test_units_per_degree_count_differences(text: str, slope: float) -> None:
    """0.05 % per degC is as many per K, and 0.09 % of it per 1.8 degF."""
    dimension = Dimension("a temperature coefficient", "1/K", "0.05 %/K")

    assert quantity(text, dimension) == pytest.approx(slope)


DIFFERENCE = Dimension("a temperature difference", "K", "5 K")


@pytest.mark.parametrize(("name", "text"), VALUES["other_dimensions"])
def test_quantity_refuses_another_dimension(name: str, text: str) -> None:
    """The error has the value, the expected dimension and an example; units with a zero too.

    100 rpm have the dimension of Hz, but are not 100 Hz; pounds are a mass. By a factor 30 dBm,
    1 W, would be 0.03 W, and 3 Np, 26 dB, would be 3 dB.
    """
    dimension = DIFFERENCE if name == "DIFFERENCE" else getattr(units, name)

    with pytest.raises(InputError, match=f"for example {dimension.example}") as error:
        quantity(text, dimension)

    assert str(error.value).startswith(f"'{text}' ")
    assert dimension.name in str(error.value)


# Documents


def test_data_text_is_read_back_as_it_was() -> None:
    """Words of YAML 1.1 and numbers among text come back too."""
    data = {"z": ["NO", "0x10", "1", 1, 1.5, None, True], "a": {"b": "12 in", "c": "1:30"}}

    document = parse_document("new", data_text(data))

    assert document.data == data
    assert list(document.data) == ["z", "a"]


@pytest.fixture(params=[yaml.SafeLoader, yaml.CSafeLoader])
def loader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading without libyaml and with it."""
    monkeypatch.setattr(reading, "YAML_LOADER", request.param)


@pytest.mark.usefixtures("loader")
def test_document_keeps_the_line_of_every_key(tmp_path: Path) -> None:
    """Lines count from one; a missing key has that of the nearest above it."""
    document = read(tmp_path, "# note\na: 1\n\nb:\n  c: [1,\n    2]\n  d: x\n")

    assert document.data == {"a": 1, "b": {"c": [1, 2], "d": "x"}}
    lines = {
        ("a",): 2,
        ("b",): 4,
        ("b", "c"): 5,
        ("b", "c", 0): 5,
        ("b", "c", 1): 6,
        ("b", "d"): 7,
        ("b", "missing", "deeper"): 4,
        ("missing",): 1,
    }
    assert {path: document.line_of(path) for path in lines} == lines


SCALARS: Mapping[str, Any] = {
    "1": 1,
    "-7": -7,
    "007": 7,
    "1.5": 1.5,
    "70e9": 70e9,
    ".5": 0.5,
    ".inf": math.inf,
    "true": True,
    "False": False,
    "null": None,
    "~": None,
    "": None,
    "'1'": "1",
    "'true'": "true",
}


@pytest.mark.parametrize("text", SCALARS)
def test_scalar_is_a_decimal_number_boolean_or_null(tmp_path: Path, text: str) -> None:
    """As in the core schema of YAML 1.2, section 10.3, with decimal numbers only."""
    value = read(tmp_path, f"key: {text}\n").data["key"]

    assert value == SCALARS[text]
    assert type(value) is type(SCALARS[text])


@pytest.mark.parametrize("directive", ["", "%YAML 1.1\n---\n"])
def test_keys_are_text(tmp_path: Path, directive: str) -> None:
    """A key such as NO stays that word, also with a directive of YAML 1.1."""
    document = read(tmp_path, f"{directive}NO: NO\n5: 2\ntrue: 3\n<<: 4\n")

    assert document.data == {"NO": "NO", "5": 2, "true": 3, "<<": 4}


@pytest.mark.parametrize(
    ("content", "location"),
    [
        ("a:\N{NO-BREAK SPACE}1\n", "U+00A0 in column 3"),
        ("\ta: 1\n", "tab in col"),
        ("s:\n\N{NO-BREAK SPACE} a: 1\n\n  b: 2\n", "U+00A0 in column 1 of line 2"),
        ("s:\n  a:1 # one\n  # two\n  b: 2\n", "a space in column 4 of line 2"),
        ("s:\n  a\N{FULLWIDTH COLON} 1\n  b: 2\n", "a space in column 4 of line 2"),
        ("a:1\n", "a space in column 2"),
    ],
)
def test_wrong_blank_is_located(tmp_path: Path, content: str, location: str) -> None:
    """Even if the parser notices the missing space only in the next line."""
    with pytest.raises(ConfigError, match=re.escape(location)):
        read(tmp_path, content)


@pytest.mark.usefixtures("loader")
@pytest.mark.parametrize(
    ("content", "line", "location"),
    [
        ("s:\n  A: {x: 12 mm y: 1}\n", 2, "mm in column 14"),
        ("s:\n  A: {x: 1}\n  B: {x: 1,\n      y: 2 # two\n      z: 3}\n", 4, "2 in column 10"),
        ("s:\n  A: {x: 'a' 'b': 1}\n", 2, "'a' in column 12"),
        ("s:\n  A: {x: 1\n  B: {x: 1}\n", 2, "1 in column 10"),
        ("s: [1, 2\n", 1, "2 in column 8"),
    ],
)
def test_missing_comma_is_located(tmp_path: Path, content: str, line: int, location: str) -> None:
    """In the first mapping below a key, before quotes, and at the end of the previous line."""
    with pytest.raises(ConfigError) as error:
        read(tmp_path, content)

    (problem,) = error.value.problems
    assert problem.line == line
    assert problem.message.partition("closes, after ")[2] == location


@pytest.mark.parametrize("name", ["none.yaml", ".", "a\0b"])
def test_missing_file_is_refused(tmp_path: Path, name: str) -> None:
    """As a folder, and a name that no file can have."""
    with pytest.raises(ConfigError) as error:
        read_document(tmp_path / name)

    (problem,) = error.value.problems
    assert problem.line is None


def test_document_with_too_many_values_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than the limit, lowered here from 50 000."""
    monkeypatch.setattr("model.config.document.MAX_DOCUMENT_VALUES", 100)

    with pytest.raises(ConfigError) as error:
        read(tmp_path, "a: [" + "1," * 200 + "1]")

    (problem,) = error.value.problems
    assert problem.line == 1


@for_all(st.binary(max_size=200) | st.text(alphabet="ab:-[]{}#&*!|>'\"%@ \n\t1.,?", max_size=80))
def test_any_content_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str
) -> None:
    """No content raises anything but ConfigError."""
    try:
        read(tmp_path_factory.getbasetemp(), content)
    except ConfigError:
        return
