from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.config.document import ConfigError, read_document


def write(folder: Path, content: str | bytes) -> Path:
    """A file with this content."""
    path = folder / "file.yaml"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_every_key_keeps_its_line(tmp_path: Path) -> None:
    """Keys and list entries are found again by the line that they stand on, counted from one."""
    document = read_document(write(tmp_path, "# note\na: 1\n\nb:\n  c: [1,\n    2]\n  d: x\n"))
    assert document.data == {"a": 1, "b": {"c": [1, 2], "d": "x"}}
    expected = {("a",): 2, ("b",): 4, ("b", "c"): 5, ("b", "c", 0): 5, ("b", "c", 1): 6}
    assert {path: document.line_of(path) for path in expected} == expected
    assert document.line_of(("b", "d")) == 7
    assert document.line_of(("b", "missing", "deeper")) == 4
    assert document.line_of(("missing",)) == 1


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("1", 1),
        ("-7", -7),
        ("007", 7),
        ("1.5", 1.5),
        ("70e9", 70e9),
        (".5", 0.5),
        ("true", True),
        ("False", False),
        ("null", None),
        ("~", None),
        ("", None),
        (".inf", float("inf")),
        ("'1'", "1"),
        ("'true'", "true"),
        ("yes", "yes"),
        ("NO", "NO"),
        ("on", "on"),
        ("1:30", "1:30"),
        ("0x10", "0x10"),
        ("1_000", "1_000"),
        ("48x36", "48x36"),
        ("2020-01-01", "2020-01-01"),
        ("1" * 40, "1" * 40),
    ],
)
def test_words_mean_what_they_look_like(tmp_path: Path, text: str, expected: object) -> None:
    """Plain words are text; the numbers are decimal (core schema of YAML 1.2, section 10.3)."""
    value = read_document(write(tmp_path, f"key: {text}\n")).data["key"]
    assert value == expected
    assert type(value) is type(expected)


def test_keys_are_text(tmp_path: Path) -> None:
    """A key such as NO stays that word, where YAML 1.1 makes it false."""
    assert list(read_document(write(tmp_path, "NO: 1\n5: 2\ntrue: 3\n")).data) == [
        "NO",
        "5",
        "true",
    ]


def test_a_byte_order_mark_is_left_out(tmp_path: Path) -> None:
    """Files saved by Windows editors read like others."""
    assert read_document(write(tmp_path, b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")).data == {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("content", "line", "key", "message"),
    [
        (b"", None, "", "is empty"),
        (b"# only a comment\n", None, "", "is empty"),
        (b"a: 1\nb: \xff\n", 2, "", "0xff is no UTF-8"),
        (b"a: \x00\n", 1, "", "not allowed"),
        (b"a: 1\nb: [1\nc: 2\n", 3, "", "is not valid YAML"),
        (b"a: 1\n\tb: 2\n", 2, "", "is not valid YAML"),
        (b"- 1\n- 2\n", 1, "", "expected `key: value`"),
        (b"word\n", 1, "", "expected `key: value`"),
        (b"a: 1\nb: 2\na: 3\n", 3, "a", "stands twice, first on line 1"),
        (b"s:\n  t: 1\n  t: 1\n", 3, "s.t", "stands twice, first on line 2"),
        (b"a: 1\n---\nb: 2\n", 2, "", "a second document"),
        (b"a: &x 1\nb: 2\n", 1, "a", "anchors and aliases"),
        (b"a: 1\nb: *x\n", 2, "b", "anchors and aliases"),
        (b"a: &x [1]\nb: [*x, *x]\n", 1, "a", "anchors and aliases"),
        (b"&top\na: 1\n", 1, "", "anchors and aliases"),
        (b"a: 1\nb: !!python/object/apply:os.system [ls]\n", 2, "b", "tags are not used"),
        (b"a: !!int '3'\n", 1, "a", "tags are not used"),
        (b"? [1, 2]\n: 3\n", 1, "", "a key must be a word"),
        (b"a: " + b"[" * 100_000, 1, "a", "nested too deeply"),
        (b"a: 1\n" + b"#" * (1 << 20), None, "", "larger than 1 MiB"),
        (b"PK\x03\x04" + bytes(1 << 20), None, "", "is a .npz file, as localization tables"),
    ],
)
def test_what_is_no_plain_data_is_refused(
    tmp_path: Path, content: bytes, line: int | None, key: str, message: str
) -> None:
    """Each bad file is refused at its line, before anything is built of it."""
    path = write(tmp_path, content)
    with pytest.raises(ConfigError, match=message) as caught:
        read_document(path)
    (problem,) = caught.value.problems
    assert problem.line == line
    assert problem.key.startswith(key)
    place = str(path) if line is None else f"{path}:{line}"
    assert str(caught.value).startswith(f"{place}: ")


@pytest.mark.parametrize(("name", "message"), [("none.yaml", "no such file"), (".", "is a folder")])
def test_what_is_no_file_is_refused(tmp_path: Path, name: str, message: str) -> None:
    """A missing file and a folder are told apart."""
    with pytest.raises(ConfigError, match=message):
        read_document(tmp_path / name)


def test_a_name_that_no_file_can_have_is_refused() -> None:
    """A zero byte in a name, which the system refuses in its own way, is an input error too."""
    with pytest.raises(ConfigError, match="is no file name"):
        read_document(Path("a\0b"))


def test_all_repeated_keys_are_told_at_once(tmp_path: Path) -> None:
    """Several errors are one list, in the order of lines, with their number in front."""
    path = write(tmp_path, "a: 1\na: 2\nb:\n  c: 1\n  c: 2\n")
    with pytest.raises(ConfigError) as caught:
        read_document(path)
    assert str(caught.value) == (
        f"{path} has 2 errors:\n"
        f"  {path}:2: a: stands twice, first on line 1; remove one\n"
        f"  {path}:5: b.c: stands twice, first on line 4; remove one"
    )


def test_a_key_cannot_write_on_the_terminal(tmp_path: Path) -> None:
    """Control characters in a key are escaped where the key is shown."""
    with pytest.raises(ConfigError) as caught:
        read_document(write(tmp_path, '"\\e[2J": 1\n"\\e[2J": 2\n'))
    assert "\x1b" not in str(caught.value)


@given(st.binary(max_size=200) | st.text(alphabet="ab:-[]{}#&*!|>'\"%@ \n\t1.,?", max_size=80))
def test_any_content_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str
) -> None:
    """No file content whatever raises anything but ConfigError."""
    try:
        read_document(write(tmp_path_factory.getbasetemp(), content))
    except ConfigError:
        return
