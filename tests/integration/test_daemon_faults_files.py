"""Corrupt, foreign and malicious files wherever the daemon reads one.

They are refused with file, line and key, and a running daemon keeps its configuration.
"""

import io
import os
import pickle
import random
import time
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.daemon.run import check_daemon
from daemon_bench import ENABLED, daemon_table, holding, ready_daemon, write_daemon
from model.errors import InputError
from model.table.file import save_table
from virtual_sockets import in_virtual_time_on_sockets

MAX_TIME = 5.0  # s; an expanded bomb would take minutes, and gigabytes


class Opened:
    """Runs a command when it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, ("touch pickled",)


BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 12)]
)
LAYOUT = """effects: {hum: {kind: buzz}}
regions:
  pad: {rectangle: {start: [1 cm, 1 cm], end: [20 cm, 18 cm]}, on_press: hum}
"""


def replaced(text: str, old: str, new: str) -> bytes:
    """Replace a text that must be there."""
    assert old in text
    return text.replace(old, new).encode()


INVALID = [
    pytest.param(b"", "", id="empty"),
    pytest.param(pickle.dumps({"rig": Opened()}), "", id="pickle"),
    pytest.param(BOMB.encode(), ":1: a0: ", id="aliases"),
    pytest.param(b"x: !!python/object/apply:os.system ['touch pickled']\n", ":1: x: ", id="tag"),
    pytest.param(b"a: " + b"[" * 100_000, ":1: a", id="nested"),
    pytest.param(b"a: 1\n" + b"#" * (1 << 22), "", id="large"),
    pytest.param(b"a: 1\na: 2\n", ":2: a: ", id="duplicate key"),
    pytest.param(random.Random(5).randbytes(3000), "", id="noise"),
    pytest.param(None, "", id="endless device"),
]


@pytest.mark.parametrize("role", ["daemon.yaml", "rig.yaml", "layout.yaml"])
@pytest.mark.parametrize(("content", "place"), INVALID)
def test_daemon_refuses_files_that_are_no_plain_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, role: str, content: bytes | None, place: str
) -> None:
    """As configuration, rig or layout: with the file's name, at once and without executing it."""
    monkeypatch.chdir(tmp_path)
    path = write_daemon(tmp_path, {"main": "sim://"}, "layout: layout.yaml\n")
    (tmp_path / "layout.yaml").write_text(LAYOUT, encoding="utf-8")
    check_daemon(path)
    (tmp_path / role).unlink()
    if content is None:
        (tmp_path / role).symlink_to("/dev/zero")
    else:
        (tmp_path / role).write_bytes(content)
    begin = time.process_time()
    with pytest.raises(InputError) as caught:
        check_daemon(path)
    assert time.process_time() - begin < MAX_TIME
    assert f"{tmp_path / role}{place}" in str(caught.value)
    assert not (tmp_path / "pickled").exists()


@pytest.mark.parametrize(
    ("role", "old", "new", "place"),
    [
        ("rig.yaml", "stroke: 100 um", "stroke: .nan", r"rig.yaml:\d+: eras.SW.stroke: "),
        ("rig.yaml", "thickness: 1.5 mm", "thickness: .inf", r"rig.yaml:\d+: plate.thickness: "),
        ("rig.yaml", "stiffness: 17000", "stiffness: -1", r"rig.yaml:\d+: eras.SW.stiffness: "),
        ("daemon.yaml", "socket:", "level_db_sl: .nan\nsocket:", r"yaml:2: level_db_sl: "),
        ("daemon.yaml", "socket:", "level_db_sl: 1000\nsocket:", r"yaml:2: level_db_sl: "),
        ("daemon.yaml", "socket:", "levl_db_sl: 3\nsocket:", r"yaml:2: levl_db_sl: "),
        ("layout.yaml", "18 cm]}", ".nan]}", r"layout.yaml:3: regions.pad.rectangle"),
        ("layout.yaml", "18 cm]}", "18 km]}", r"layout.yaml:3: regions.pad.rectangle"),
        ("layout.yaml", "on_press: hum", "on_press: os.system", r"layout.yaml:3: .*pad.on_press"),
        ("layout.yaml", "kind: buzz", "kind: os.system", r"layout.yaml:1: effects.hum.kind"),
    ],
)
def test_daemon_refuses_values_beyond_limits(
    tmp_path: Path, role: str, old: str, new: str, place: str
) -> None:
    """NaN, infinite, negative, too large and unknown values, by line and key."""
    path = write_daemon(tmp_path, {"main": "sim://"}, "layout: layout.yaml\n")
    (tmp_path / "layout.yaml").write_text(LAYOUT, encoding="utf-8")
    (tmp_path / role).write_bytes(replaced((tmp_path / role).read_text("utf-8"), old, new))
    with pytest.raises(InputError, match=place):
        check_daemon(path)


def bomb() -> bytes:
    """Return a file of a few kilobytes that expands to 200 MiB."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        file.writestr("header.npy", bytes(200 << 20))
    return made.getvalue()


@pytest.mark.parametrize("content", [lambda: pickle.dumps(Opened()), bomb], ids=["pickle", "bomb"])
def test_daemon_refuses_malicious_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: Callable[[], bytes]
) -> None:
    """With the file's name, at once, and without executing or expanding it."""
    monkeypatch.chdir(tmp_path)
    path = write_daemon(tmp_path, {"main": "sim://"}, "table: table.npz\n")
    save_table(daemon_table(), tmp_path / "table.npz")
    assert "3 frequencies" in check_daemon(path)
    (tmp_path / "table.npz").write_bytes(content())
    begin = time.process_time()
    with pytest.raises(InputError, match=r"table\.npz") as refused:
        check_daemon(path)
    assert time.process_time() - begin < MAX_TIME
    assert refused.value.__cause__ is not None
    assert not (tmp_path / "pickled").exists()


def test_daemon_refuses_table_of_another_plate_or_with_nan(tmp_path: Path) -> None:
    """Of a plate that is 0.1 mm thicker, and of NaN with a valid checksum."""
    path = write_daemon(tmp_path, {"main": "sim://"}, "table: table.npz\n")
    good = daemon_table()
    spoilt = good.shapes.copy()
    spoilt[3, 1] = np.nan
    save_table(replace(good, shapes=spoilt), tmp_path / "table.npz")
    with pytest.raises(InputError, match=r"table\.npz: shapes"):
        check_daemon(path)
    save_table(good, tmp_path / "table.npz")
    rig = tmp_path / "rig.yaml"
    rig.write_bytes(replaced(rig.read_text("utf-8"), "thickness: 1.5 mm", "thickness: 1.6 mm"))
    with pytest.raises(InputError, match=r"table\.npz"):
        check_daemon(path)


@in_virtual_time_on_sockets
async def test_running_daemon_keeps_configuration_when_reload_is_invalid(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Each invalid file: nothing is applied, not even valid changes beside it; it plays on."""
    layout, config = tmp_path / "layout.yaml", tmp_path / "daemon.yaml"
    layout.write_text(LAYOUT, encoding="utf-8")
    async with ready_daemon(tmp_path, "layout: layout.yaml\n") as (bench, era):
        await era.arm("test", lease_s=60)
        effects = await era.effects()
        async with holding(era, far=bench.far):
            good = config.read_text("utf-8")
            config.write_text(f"{good}dashboard: 127.0.0.1:1\n", encoding="utf-8")
            invalid = [each.values[0] for each in INVALID if each.values[0] is not None]
            for content in invalid:
                layout.write_bytes(content)
                await bench.daemon.reload()
            rejected = [one for one in caplog.messages if "reload rejected" in one]
            assert len(rejected) == len(invalid)
            assert not any("reload failed" in one for one in caplog.messages)
            assert await era.effects() == effects
            assert any(bench.far.summary().levels)
        status = await era.status()
        assert (status.state, (status.lease_left_s or 0) > 5) == (ENABLED, True)
    with pytest.raises(InputError, match=r"layout\.yaml"):
        check_daemon(config)
