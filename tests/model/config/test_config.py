"""Configuration: sections, units, points, and edits that keep what a file says."""

import re
import subprocess
import sys
from decimal import Decimal
from pathlib import Path
from typing import Annotated

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from model.config import document as reading
from model.config import units
from model.config.document import ConfigError, data_text, parse_document, read_document
from model.config.fields import Quantity, Section, Validation
from model.config.units import (
    DAMPING,
    DENSITY,
    FREQUENCY,
    LENGTH,
    MASS,
    MODULUS,
    RATIO,
    STIFFNESS,
    TEMPERATURE,
    Dimension,
    in_meters,
    quantity,
    unit_scale,
)
from model.errors import InputError


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


def test_validation_reports_all_problems_in_the_order_of_lines(tmp_path: Path) -> None:
    """Unknown and missing keys, wrong types and bounds are reported, with suggestions."""
    text = "rate: 20\nparst: 1\narmed: yes\nparts:\n  a: {sise: 1, size: 0}\n  b: {word: 5}\n  c:\n"
    found = problems(read(tmp_path, text))
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
    assert [each[:2] for each in found] == [each[:2] for each in expected]
    assert all(part in each[2] for each, (*_, part) in zip(found, expected, strict=True))


def test_validation_reports_no_more_than_the_first_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fifty of a thousand unknown keys are reported, and no suggestion made for the others."""
    suggested: list[str] = []
    monkeypatch.setattr(
        "model.config.fields.did_you_mean", lambda name, known: suggested.append(name) or ""
    )
    text = "parts: {}\n" + "".join(f"key{number}: 1\n" for number in range(1000))
    found = problems(read(tmp_path, text))
    assert [line for line, _, _ in found] == list(range(2, 52))
    assert len(suggested) == 51


def test_validation_returns_valid_parts_of_an_invalid_file(tmp_path: Path) -> None:
    """Sections and fields are returned by themselves; invalid or missing ones are None.

    Of a valid file it is the section, with values converted from their units. Problems of the
    caller are reported with its own, in the order of lines.
    """
    whole = read(tmp_path, "parts:\n  a: {size: 2 mm}\nrate: 10\narmed: true\n")
    assert whole.finish() == Outer(parts={"a": Inner(size=0.002)}, rate=10, armed=True)
    validation = read(
        tmp_path, "parts:\n  a: {size: 1 cm, word: 5}\n  b: {size: 2 cm}\nrate: 5 m\n"
    )
    assert validation.part(("parts", "a"), Inner) is None
    assert validation.part(("parts", "b"), Inner) == Inner(size=0.02)
    assert validation.part(("parts", "c"), Inner) is None
    assert validation.field(("parts", "a", "size"), Inner) == 0.01
    assert validation.field(("parts", "a", "word"), Inner) is None
    assert list(validation.mapping(("parts",))) == ["a", "b"]
    assert validation.mapping(("rate",)) == {}
    validation.add(("parts", "b", "size"), "odd")
    found = [(line, key) for line, key, _ in problems(validation)]
    assert found == [(2, "parts.a.word"), (3, "parts.b.size"), (4, "rate")]


def test_data_text_is_read_back_as_it_was() -> None:
    """Words of YAML 1.1 and numbers among text come back too."""
    data = {"z": ["NO", "0x10", "1", 1, 1.5, None, True], "a": {"b": "12 in", "c": "1:30"}}
    assert parse_document("new", data_text(data)).data == data
    assert list(parse_document("new", data_text(data)).data) == ["z", "a"]


@pytest.mark.parametrize(
    ("place", "remedy"),
    [
        ((8.0, 6.0), "0.08,0.06"),
        ((20.0, 0.0), "0.2,0"),
        ((80.0, 60.0), "0.08,0.06"),
        ((0.4, 0.1), ""),
        ((1.0, 0.1), ""),
        ((-8.0, 6.0), ""),
        ((800.0, 6.0), ""),
        ((float("nan"), 6.0), ""),
        ((float("inf"), 6.0), ""),
    ],
)
def test_in_meters_converts_places_that_smaller_units_put_on_the_plate(
    place: tuple[float, float], remedy: str
) -> None:
    """The plate is 0.3 m by 0.2 m; no finger is half a centimeter from a corner."""
    assert in_meters(*place, length=0.3, width=0.2).rpartition(" ")[2] == remedy


SI = {
    # An inch is 25.4 mm by definition; micro is written with the micro sign or the Greek letter.
    LENGTH: {
        "12 in": 0.3048, "9in": 0.2286, "1.5 mm": 0.0015, "2 mm": 0.002, "100 um": 1e-4,
        "100 µm": 1e-4, "100 μm": 1e-4, "1 ft": 0.3048, ".5 m": 0.5, "1e-3 m": 0.001,
        "-2 cm": -0.02, 3: 3.0, -1.5: -1.5, 0: 0.0,
    },
    MODULUS: {"70 GPa": 70e9, "70000 N/mm^2": 70e9, "70 kN/mm²": 70e9, "70e9": 70e9},
    DENSITY: {"2700 kg/m^3": 2700, "2700 kg/m**3": 2700, "2700 kg/m³": 2700, "2.7 g/cm^3": 2700},
    STIFFNESS: {"17 kN/m": 17000, "17 N/mm": 17000, "17000": 17000},
    DAMPING: {"2 N s/m": 2, "2 N*s/m": 2, "2 N·s/m": 2, "2 kg/s": 2},
    MASS: {"5 g": 0.005},
    FREQUENCY: {"0.25 kHz": 250},
    RATIO: {"1 %": 0.01, "5e-2": 0.05},
}  # fmt: skip


@pytest.mark.parametrize("dimension", SI, ids=lambda dimension: dimension.name)
def test_quantity_converts_to_si_exactly(dimension: Dimension) -> None:
    """Common units and spellings are exact to the last bit; a bare number is in SI."""
    expected = SI[dimension]
    assert {value: quantity(value, dimension) for value in expected} == expected


NO_VALUES = [
    "9**9**9 m", "9^9^9 m", "2 m^99999999", "2 m**9**9**9", "(3) m", "3 * 4 m",
    "__import__('os') m", "1,5 mm", "1.5 mmm", "1.5 m/", "m", "", " ", "one m", "1" * 41,
    "1 " + "m" * 41, "1e999 m", "1e99 Ym Ym Ym Ym Ym", "nan", "inf m", float("nan"), float("inf"),
    -float("inf"), 10**400, True, False, None, [1], {"m": 1}, b"1 m",
    "٣ m",  # digits of another script
]  # fmt: skip


@pytest.mark.parametrize("value", NO_VALUES)
def test_quantity_refuses_what_is_not_a_value(value: object) -> None:
    """Nothing is evaluated or guessed; the error is short and has a remedy."""
    with pytest.raises(InputError, match=r"1\.5 mm") as caught:
        quantity(value, LENGTH)
    assert len(str(caught.value)) < 200


@given(st.text(max_size=60) | st.text(alphabet="0123456789.eE+-*/^% mkgNsPainHz()", max_size=60))
def test_quantity_raises_input_error_only(text: str) -> None:
    """No text raises anything but InputError."""
    try:
        quantity(text, LENGTH)
    except InputError:
        return


def test_quantity_of_bare_numbers_does_not_load_pint() -> None:
    """A rig of bare numbers does not pay for loading the unit library."""
    script = (
        "import sys; from model.config.units import LENGTH, quantity; "
        "quantity('0.3', LENGTH); quantity(2, LENGTH); print('pint' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "False"


@pytest.mark.parametrize(
    ("dimension", "unit"),
    [
        (each, unit)
        for each in vars(units).values()
        if isinstance(each, Dimension)
        for unit in each.factors
        if unit != each.unit
    ],
)
def test_common_factors_are_those_of_pint(dimension: Dimension, unit: str) -> None:
    """They agree to the last digit, so that it does not matter which of the two is used."""
    assert unit_scale(f"1 {unit}", unit, dimension) == (Decimal(dimension.factors[unit]), 0)


@pytest.mark.parametrize(
    ("text", "celsius"),
    [
        *(("300 K", 26.85), ("0 K", -273.15), ("23 °C", 23.0), ("-5.5 degC", -5.5), ("20", 20.0)),
        *(("86 degF", 30.0), ("-40 °F", -40.0), ("491.67 degR", 0.0), ("300000 mK", 26.85)),
    ],
)
def test_temperature_counts_from_the_zero_of_its_unit(text: str, celsius: float) -> None:
    """By the definitions of the scales: 0 degC is 273.15 K, 32 degF and 491.67 degR.

    Units per degree count degrees of difference: 0.05 % per degC is as many per K, and 0.09 % of it
    per 1.8 degF.
    """
    assert quantity(text, TEMPERATURE) == celsius
    slope = Dimension("a temperature coefficient", "1/K", "0.05 %/K")
    assert quantity("0.05 %/degC", slope) == quantity("0.05 %/K", slope) == 0.0005
    assert quantity("0.05 %/degF", slope) == pytest.approx(0.0009)


@pytest.mark.parametrize(
    ("text", "dimension"),
    [
        ("1.5 kg", LENGTH),
        ("70 GN", MODULUS),
        ("1.5 mm^2", LENGTH),
        ("2 %", LENGTH),
        ("1 m", RATIO),
        ("17 lb/in", STIFFNESS),  # pounds are a mass
        ("100 rpm", FREQUENCY),  # has the dimension of Hz, but 100 rpm are not 100 Hz
        ("100 rad/s", FREQUENCY),
        ("100 Bq", FREQUENCY),
        ("1 deg", RATIO),
        # By a factor 30 dBm, 1 W, would be 0.03 W, and 3 Np, 26 dB, would be 3 dB.
        ("5 degC", Dimension("a temperature difference", "K", "5 K")),
        ("9 degF", Dimension("a temperature difference", "K", "5 K")),
        ("3 degC", LENGTH),
        ("30 dBm", units.POWER),
        ("3 dB", units.RATIO),
        ("3 Np", units.LEVEL),
        ("2 %", units.LEVEL),
        ("20 dB", TEMPERATURE),
    ],
)
def test_quantity_refuses_another_dimension(text: str, dimension: Dimension) -> None:
    """The error has the value, the dimension wanted and an example; units with a zero too."""
    with pytest.raises(InputError, match=f"for example {dimension.example}") as caught:
        quantity(text, dimension)
    assert str(caught.value).startswith(f"'{text}' ")
    assert dimension.name in str(caught.value)


def write(folder: Path, content: str | bytes) -> Path:
    """A file with this content."""
    path = folder / "file.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@pytest.mark.parametrize("loader", [yaml.SafeLoader, yaml.CSafeLoader])
def test_document_keeps_the_line_of_every_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loader: object
) -> None:
    """Lines count from one; a missing key has that of the nearest above it; with libyaml or not."""
    monkeypatch.setattr(reading, "YAML_LOADER", loader)
    document = read_document(write(tmp_path, "# note\na: 1\n\nb:\n  c: [1,\n    2]\n  d: x\n"))
    assert document.data == {"a": 1, "b": {"c": [1, 2], "d": "x"}}
    expected = {("a",): 2, ("b",): 4, ("b", "c"): 5, ("b", "c", 0): 5, ("b", "c", 1): 6}
    expected |= {("b", "d"): 7, ("b", "missing", "deeper"): 4, ("missing",): 1}
    assert {path: document.line_of(path) for path in expected} == expected


def test_scalar_is_text_unless_decimal_number_boolean_or_null(tmp_path: Path) -> None:
    """Words follow the core schema of YAML 1.2, section 10.3, with decimal numbers only."""
    values = {
        "1": 1, "-7": -7, "007": 7, "1.5": 1.5, "70e9": 70e9, ".5": 0.5, ".inf": float("inf"),
        "true": True, "False": False, "null": None, "~": None, "": None, "'1'": "1",
        "'true'": "true",
    }  # fmt: skip
    words = ["yes", "NO", "on", "1:30", "0x10", "1_000", "48x36", "2020-01-01", "<<", "1" * 40]
    values |= {word: word for word in words}
    for text, expected in values.items():
        value = read_document(write(tmp_path, f"key: {text}\n")).data["key"]
        assert (value, type(value)) == (expected, type(expected))


@pytest.mark.parametrize("directive", ["", "%YAML 1.1\n---\n"])
def test_keys_are_text(tmp_path: Path, directive: str) -> None:
    """A key such as NO stays that word, also with a directive of YAML 1.1.

    Files that Windows editors save, with a byte order mark, read like others.
    """
    document = read_document(write(tmp_path, f"{directive}NO: NO\n5: 2\ntrue: 3\n<<: 4\n"))
    assert document.data == {"NO": "NO", "5": 2, "true": 3, "<<": 4}
    assert read_document(write(tmp_path, b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")).data == {"a": 1, "b": 2}


def test_blanks_that_look_right_are_read_or_named(tmp_path: Path) -> None:
    """Tabs where YAML 1.2 lets white space stand, blanks of word processors behind a value.

    Where the parser sees the lack of a space only in the next line, its own line is named.
    """
    content = "a: 1\t# first\nb:\t[1,\t2]\t\nc: 3\N{NO-BREAK SPACE}\nd: 12\N{NO-BREAK SPACE}in\n"
    data = read_document(write(tmp_path, content)).data
    assert (data["a"], data["b"], data["c"]) == (1, [1, 2], 3)
    assert quantity(data["d"], LENGTH) == 0.3048
    for wrong, name in (
        ("a:\N{NO-BREAK SPACE}1\n", "U+00A0 in column 3"),
        ("\ta: 1\n", "tab in col"),
        ("s:\n\N{NO-BREAK SPACE} a: 1\n\n  b: 2\n", "U+00A0 in column 1 of line 2"),
        ("s:\n  a:1 # one\n  # two\n  b: 2\n", "a space in column 4 of line 2"),
        ("s:\n  a\N{FULLWIDTH COLON} 1\n  b: 2\n", "a space in column 4 of line 2"),
        ("a:1\n", "a space in column 2"),
    ):
        with pytest.raises(ConfigError, match=re.escape(name)):
            read_document(write(tmp_path, wrong))


@pytest.mark.parametrize("loader", [yaml.SafeLoader, yaml.CSafeLoader])
def test_missing_comma_is_named_where_it_lacks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loader: object
) -> None:
    """In the first mapping below a key too, before quotes, and at the end of the line before."""
    monkeypatch.setattr(reading, "YAML_LOADER", loader)
    for wrong, line, after in (
        ("s:\n  A: {x: 12 mm y: 1}\n", 2, "mm in column 14"),
        (
            "s:\n  A: {x: 1, y: 2}\n  B: {x: 1,\n      y: 2 # two\n      z: 3}\n",
            4,
            "2 in column 10",
        ),
        ("s:\n  A: {x: 'a' 'b': 1}\n", 2, "'a' in column 12"),
        ("s:\n  A: {x: 1\n  B: {x: 1}\n", 2, "1 in column 10"),
        ("s: [1, 2\n", 1, "2 in column 8"),
    ):
        with pytest.raises(ConfigError) as caught:
            read_document(write(tmp_path, wrong))
        (problem,) = caught.value.problems
        assert (problem.line, problem.message.partition("closes, after ")[2]) == (line, after)


@pytest.mark.parametrize("name", ["none.yaml", ".", "a\0b", "large.yaml"])
def test_document_refuses_what_is_not_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A missing file, a folder, and a name that no file can have are refused as a whole.

    So are more values than the limit, lowered here from 50 000.
    """
    monkeypatch.setattr("model.config.document.MAX_DOCUMENT_VALUES", 100)
    (tmp_path / "large.yaml").write_text("a: [" + "1," * 200 + "1]")
    with pytest.raises(ConfigError) as caught:
        read_document(tmp_path / name)
    line = 1 if name == "large.yaml" else None
    assert [(each.line, each.key) for each in caught.value.problems] == [(line, "")]


@given(st.binary(max_size=200) | st.text(alphabet="ab:-[]{}#&*!|>'\"%@ \n\t1.,?", max_size=80))
def test_any_content_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str
) -> None:
    """No content raises anything but ConfigError."""
    try:
        read_document(write(tmp_path_factory.getbasetemp(), content))
    except ConfigError:
        return
