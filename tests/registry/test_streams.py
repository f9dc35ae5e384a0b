"""Standard streams: what steers a terminal is escaped, and closed ones do no harm."""

import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from cases import shortly
from model.errors import InputError
from model.rig.rig_file import example_rig_path
from model.table.table_file import load_table
from registry.streams import PrintableStream, printable

ERA = shlex.quote(str(Path(sys.executable).with_name("era")))
RIG = shlex.quote(str(example_rig_path()))
CONTROL = re.compile(rb"[\x00-\x09\x0b-\x1f\x7f]|\xc2[\x80-\x9f]|\xe2\x80[\x8e\x8f\xa8-\xae]")
"""Bytes that steer a terminal, in UTF-8; a line feed does not count."""


def typed(command: str, folder: Path) -> subprocess.CompletedProcess[bytes]:
    """Run a command in the shell."""
    return subprocess.run(
        ["sh", "-c", command], cwd=folder, capture_output=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a\nb\tc", "a\nb\tc"),
        ("\x1b[2J\x07\r\b\x7f\0", r"\x1b[2J\x07\r\x08\x7f\x00"),
        ("\x9b31m\u202eevil\u2066\u2028", r"\x9b31m\u202eevil\u2066\u2028"),
        ("Fläche 3 × 4 µm, 日本", "Fläche 3 × 4 µm, 日本"),
    ],
)
def test_printable_escapes_what_steers_a_terminal(text: str, expected: str) -> None:
    """Controls of ASCII and Latin-1, and marks of direction; letters of any script stay."""
    assert printable(text) == expected
    assert str(InputError(text)) == expected
    content = io.BytesIO()
    with PrintableStream(content, "utf-8", newline="\n") as stream:
        assert stream.write(text) == len(text)
        stream.flush()
        assert content.getvalue().decode() == expected


@pytest.mark.parametrize(
    ("command", "status"),
    [
        (f"{ERA} config check daemon.yaml", 0),
        (f"{ERA} config check broken.yaml", 1),
        (f'{ERA} plate modes "$(printf "no\\033[2Jsuch.yaml")"', 2),
        (f'{ERA} "$(printf "\\033[2J")"', 2),
    ],
    ids=["a good file", "a file that is missing", "a name", "a command"],
)
def test_commands_print_no_control_characters_of_files_and_arguments(
    tmp_path: Path, command: str, status: int
) -> None:
    """Neither on standard output, as a name of a socket, nor in errors."""
    daemon = f'rig: {example_rig_path()}\nsocket: "\\e[2J.sock"\n'
    (tmp_path / "daemon.yaml").write_text(daemon, "utf-8")
    (tmp_path / "broken.yaml").write_text('rig: "\\e[2J\\u202e.yaml"\n', "utf-8")
    result = typed(command, tmp_path)
    assert result.returncode == status
    assert re.search(rb"\\x1b\[2J", result.stdout + result.stderr)
    assert not CONTROL.search(result.stdout + result.stderr)


ALL_CLOSED = "<&- >&- 2>&-"


@pytest.mark.parametrize("closed", shortly([">&-", "2>&-", "<&-", ALL_CLOSED], [ALL_CLOSED]))
def test_command_writes_its_file_when_streams_are_closed(tmp_path: Path, closed: str) -> None:
    """As of services and programs with windows; nothing goes into a file in place of a stream."""
    build = f"table build {RIG} --frequencies 60:120:60 --grid 2x2 --mesh 6x5"

    result = typed(f"{ERA} {build} -o table.npz {closed}", tmp_path)

    assert result.returncode == 0
    assert b"bug" not in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["table.npz"]
    table = load_table(tmp_path / "table.npz")
    assert table.frequencies.tolist() == [60.0, 120.0]


def test_closed_streams_keep_their_numbers(tmp_path: Path) -> None:
    """What a library writes to standard output by its number must not go into a file."""
    program = (
        "import os; from registry.streams import protect_streams; protect_streams(); "
        "file = open('data', 'wb'); os.write(1, b'lost'); os.write(2, b'lost'); "
        "assert os.read(0, 1) == b''; file.close()"
    )
    result = typed(f'{shlex.quote(sys.executable)} -c "{program}" <&- >&- 2>&-', tmp_path)
    assert result.returncode == 0
    assert (tmp_path / "data").read_bytes() == b""
