import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from model.config import document as reading
from model.config.document import ConfigError, read_document
from model.config.fields import LENGTH, quantity


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
    monkeypatch.setattr(reading, "_LOADER", loader)
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
    """A key such as NO stays that word, also with a directive of YAML 1.1."""
    document = read_document(write(tmp_path, f"{directive}NO: NO\n5: 2\ntrue: 3\n<<: 4\n"))
    assert document.data == {"NO": "NO", "5": 2, "true": 3, "<<": 4}


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
    monkeypatch.setattr(reading, "_LOADER", loader)
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


def test_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    """Files saved by Windows editors read like others."""
    assert read_document(write(tmp_path, b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")).data == {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("content", "line", "key"),
    [
        (b"", None, ""),
        (b"# only a comment\n", None, ""),
        (b"a: 1\nb: \xff\n", 2, ""),
        (b"a: \x00\n", 1, ""),
        (b"a: 1\nb: [1\nc: 2\n", 2, ""),
        (b"a: 1\n\tb: 2\n", 2, ""),
        (b"- 1\n- 2\n", 1, ""),
        (b"word\n", 1, ""),
        (b"a: 1\nb: 2\na: 3\n", 3, "a"),
        (b"s:\n  t: 1\n  t: 1\n", 3, "s.t"),
        (b"a: 1\n---\nb: 2\n", 2, ""),
        (b"a: &x 1\nb: 2\n", 1, "a"),
        (b"a: 1\nb: *x\n", 2, "b"),
        (b"a: &x [1]\nb: [*x, *x]\n", 1, "a"),
        (b"&top\na: 1\n", 1, ""),
        (b"a: 1\nb: !!python/object/apply:os.system [ls]\n", 2, "b"),
        (b"a: !!int '3'\n", 1, "a"),
        (b"a: ! 3\n", 1, "a"),
        (b"? [1, 2]\n: 3\n", 1, ""),
        (b"a: " + b"[" * 900, 1, "a[0][0]"),
        (b"a: " + b"[" * 20_000, 1, ""),  # by libyaml
        (b"%YAML 2.0\n---\na: 1\n", 1, ""),
        (b"a: " + b"{a: " * 20_000, 1, "a.a.a"),
        (b"a: 1\n" + b"#" * (1 << 20), None, ""),
        (b"PK\x03\x04" + bytes(1 << 20), None, ""),
    ],
)
def test_document_refuses_what_is_not_plain_data(
    tmp_path: Path, content: bytes, line: int | None, key: str
) -> None:
    """The error has the line and key, and nothing is built of the content."""
    path = write(tmp_path, content)
    with pytest.raises(ConfigError) as caught:
        read_document(path)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (line, key)
    place = str(path) if line is None else f"{path}:{line}"
    assert str(caught.value).startswith(f"{place}: ")


def test_document_refuses_too_many_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """More than the limit, lowered here from 50 000, is refused as a whole."""
    monkeypatch.setattr("model.config.document._MAX_VALUES", 100)
    path = write(tmp_path, "a: [" + "1," * 200 + "1]")
    with pytest.raises(ConfigError) as caught:
        read_document(path)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (1, "")


@pytest.mark.parametrize("name", ["none.yaml", ".", "a\0b"])
def test_document_refuses_what_is_not_a_file(tmp_path: Path, name: str) -> None:
    """A missing file, a folder, and a name that no file can have are refused as a whole."""
    with pytest.raises(ConfigError) as caught:
        read_document(tmp_path / name)
    assert caught.value.problems[0].line is None


def test_document_reports_all_repeated_keys_in_order_of_lines(tmp_path: Path) -> None:
    """Each has its own line, also where one is nested in another."""
    path = write(tmp_path, "a: 1\nb:\n  c: 1\n  c: 2\na: 2\n")
    with pytest.raises(ConfigError) as caught:
        read_document(path)
    assert [(each.line, each.key) for each in caught.value.problems] == [(4, "b.c"), (5, "a")]
    assert [line.split(": ")[0] for line in str(caught.value).splitlines()[1:]] == [
        f"  {path}:4",
        f"  {path}:5",
    ]


def test_error_escapes_control_characters_of_a_key(tmp_path: Path) -> None:
    """A key cannot send commands to a terminal."""
    with pytest.raises(ConfigError) as caught:
        read_document(write(tmp_path, '"\\e[2J": 1\n"\\e[2J": 2\n'))
    assert "\x1b" not in str(caught.value)


@given(st.binary(max_size=200) | st.text(alphabet="ab:-[]{}#&*!|>'\"%@ \n\t1.,?", max_size=80))
def test_any_content_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str
) -> None:
    """No content raises anything but ConfigError."""
    try:
        read_document(write(tmp_path_factory.getbasetemp(), content))
    except ConfigError:
        return
