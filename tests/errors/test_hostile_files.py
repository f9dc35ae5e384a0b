"""Files that users name and that are no such file: each reader refuses each of them in words."""

import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from controller.content.formats import read_content
from controller.effects.layout import load_layout
from controller.effects.player import read_strengths
from controller.gateway.settings import read_token
from controller.sources.tuio import read_capture
from drivers.errors import CommandError
from era_haptics.lab.design.problem import area_of
from era_haptics.lab.measuring.impedance import read_impedance
from era_haptics.lab.measuring.loopback import read_stepped
from era_haptics.lab.measuring.sound_card import Desk
from era_haptics.lab.witness import capture
from model.calibration.responses import WiredSensor, read_measured, read_places, read_sensors
from model.errors import InputError
from model.identification.learned_plate import load_learned
from model.rig.rig_file import example_rig_path, load_rig
from model.table.table_file import load_table

RIG = load_rig(example_rig_path())
DESK = Desk(RIG, (WiredSensor("P1", 0.1, 0.1, 1, 1.0),))

READERS: dict[str, Callable[[Path], object]] = {
    "rig.yaml": load_rig,
    "layout.yaml": lambda path: load_layout(path, None),
    "polygons.yaml": lambda path: area_of(str(path), RIG.plate),
    "mask.png": lambda path: area_of(str(path), RIG.plate),
    "mask.jpg": lambda path: area_of(str(path), RIG.plate),
    "strengths.json": read_strengths,
    "token.txt": read_token,
    "taps.tuio": read_capture,
    "wires.txt": lambda path: [*capture.read_capture(path, wires=["wire1"])],
    "tap.ahap": read_content,
    "tap.haptic": read_content,
    "tap.hjif": read_content,
    "tap.wav": read_content,
    "measured.csv": read_measured,
    "measured.uff": read_measured,
    "places.csv": lambda path: read_places(path, RIG.plate),
    "sensors.csv": lambda path: read_sensors(path, RIG.plate),
    "free.zma": read_impedance,
    "P1-1.wav": lambda path: read_stepped(path, DESK),
    "P1-1.csv": lambda path: read_stepped(path, DESK),
    "table.npz": load_table,
    "learned.npz": lambda path: load_learned(path, table=""),
}
"""By a name of a file, what reads it."""

_DIGITS = b"9" * 100_000


def _sparse(path: Path) -> None:
    with path.open("wb") as stream:
        stream.truncate(1 << 40)


HOSTILE: dict[str, Callable[[Path], object]] = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
    "missing": lambda path: None,
    "sparse": _sparse,
    "zeros": lambda path: path.write_bytes(bytes(1 << 16)),
    "digits": lambda path: path.write_bytes(_DIGITS),
    "digits in JSON": lambda path: path.write_bytes(b'{"a": %s}' % _DIGITS),
    "digits in a list": lambda path: path.write_bytes(b"[%s, 1]" % _DIGITS),
    "digits of a dataset": lambda path: path.write_bytes(b"    -1\n%s\n 1\n    -1\n" % _DIGITS),
    "digits of a binary dataset": lambda path: path.write_bytes(
        b"    -1\n    58b 1 2 11 %s 0 0\n 1\n    -1\n" % _DIGITS
    ),
    "brackets": lambda path: path.write_bytes(b"[" * 100_000),
    "no UTF-8": lambda path: path.write_bytes(b'{"a": "\xfc\xff\xfe"}\n1,\xe9,3\n'),
    "lines": lambda path: path.write_bytes(b"\n\r\n" * 100_000),
    "chunks": lambda path: path.write_bytes(b"RIFF\0\0\0\0WAVEdata\0\0\0\0" + bytes(999)),
    "archive": lambda path: path.write_bytes(b"PK\x05\x06" + b"\xff" * 18),
}
"""By what it is, how it is made."""


@pytest.mark.parametrize("kind", HOSTILE)
@pytest.mark.parametrize("name", READERS)
def test_reader_refuses_in_words_what_is_no_such_file(tmp_path: Path, name: str, kind: str) -> None:
    """At once, without waiting for a writer or the end; with the file's name, and none of Python's.

    Strengths that were never set have no file, wires may be still, and a token may be any text.
    """
    path = tmp_path / name
    HOSTILE[kind](path)
    if path.is_file():
        path.chmod(0o600)
    if (name, kind) in (("strengths.json", "missing"), ("wires.txt", "lines")):
        READERS[name](path)
        return
    if name == "token.txt" and path.is_file():
        with suppress(InputError):
            READERS[name](path)
        return
    with pytest.raises((InputError, CommandError), match=re.escape(name)) as caught:
        READERS[name](path)
    assert not re.search(r"Errno|Error\(|object at|local variable", str(caught.value))
    assert len(str(caught.value)) < 2000 + len(str(path))
    if kind == "sparse" and name != "wires.txt":  # which is read line by line
        assert "must be up to" in str(caught.value)
