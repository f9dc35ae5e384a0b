"""Contents of a bug report, and what is removed from them."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from era_haptics.lab.report import MAX_DUMPS, MAX_FILE_SIZE, collect, shown, versions
from model.rig.rig_file import example_rig_path

HOME = Path("/home/user")


@pytest.mark.parametrize(
    ("text", "expected", "is_recorded"),
    [
        *(
            (text, expected, False)
            for text, expected in (
                ("thickness: 1.5mm, mesh: auto 1 %", "thickness: 1.5mm, mesh: auto 1 %"),
                (
                    "url: serial:///dev/ttyUSB0?baud=921600",
                    "url: serial:///dev/ttyUSB0?baud=921600",
                ),
                ("url: 'socket://me:1234@amp:4000'", "url: 'socket://hidden'"),
                ("url: modbus+tcp://plc.example/7", "url: modbus+tcp://hidden/7"),
                ("url: socket:///x?pin=1234&baud=9600", "url: socket:///x?pin=hidden&baud=9600"),
                ("token: 123456  # my bank's", "token: hidden"),
                ('{"access_key": 1234, "stroke": 1}', '{"access_key": hidden, "stroke": 1}'),
                ('serial_numbers: {main: "A1234"}', "serial_numbers: {main: hidden}"),
                ('{"serial_number": "A1234"}', '{"serial_number": hidden}'),
                ("rig: /home/user/rig.yaml", "rig: ~/rig.yaml"),
            )
        ),
        (  # of a record: state, fault and message, neither a host nor a home in free text
            '"state": 7, "serial_number": "A-17", "access_token": 4, '
            '"cause": "no tcp://me:1@amp # /home/user/x"',
            '"state": 7, "serial_number": hidden, "access_token": hidden, '
            '"cause": "no tcp://hidden # ~/x"',
            True,
        ),
    ],
)
def test_report_hides_values_of_unknown_keys(text: str, expected: str, is_recorded: bool) -> None:
    """And hosts, serial numbers, comments and the home folder."""
    assert shown(text, home=HOME, is_recorded=is_recorded).rstrip() == expected


def test_example_rig_is_shown_without_its_comments() -> None:
    """All values of plate, ERAs, amplifier and limits."""
    text = example_rig_path().read_text("utf-8")
    assert yaml.safe_load(shown(text, home=HOME)) == yaml.safe_load(text)


@pytest.mark.parametrize("given", [["d.yaml"], ["rig.yaml", "d.yaml"]])
def test_report_includes_files_of_daemon(tmp_path: Path, given: list[str]) -> None:
    """Its rig, layout, log and last dumps once, and no table; missing files are listed."""
    (tmp_path / "rig.yaml").write_text(example_rig_path().read_text("utf-8"), "utf-8")
    (tmp_path / "d.yaml").write_text(
        "rig: rig.yaml\nlayouts: {panel: none.yaml}\ntable: t.npz\ndumps: {folder: dumps}\n"
        "log: {file: era.out}\n",
        "utf-8",
    )
    begun = "x" * MAX_FILE_SIZE
    (tmp_path / "era.out").write_text(f'{begun}\n{{"message": "link main: lost"}}\n', "utf-8")
    (tmp_path / "t.npz").write_bytes(b"x" * 100)
    (tmp_path / "dumps").mkdir()
    for number in range(MAX_DUMPS + 2):
        (tmp_path / "dumps" / f"era-fault-2026-{number}.jsonl").write_text(str(number), "utf-8")
    (tmp_path / "dumps" / "other.txt").write_text("x", "utf-8")
    files, missing = collect(
        [tmp_path / name for name in given], socket=tmp_path / "no.sock", home=HOME
    )
    dumps = [f"era-fault-2026-{number}.jsonl" for number in range(2, MAX_DUMPS + 2)]
    assert set(files) == {"d.yaml", "rig.yaml", "era.out", *dumps, "versions.json"}
    log = files["era.out"]
    assert len(log) == MAX_FILE_SIZE
    assert log.endswith('x\n{"message": "link main: lost"}\n')
    layout, daemon = missing
    assert "none.yaml" in layout
    assert "daemon" in daemon
    found = json.loads(files["versions.json"])
    assert found["packages"]["numpy"][0].isdigit()
    assert set(found) >= {"packages", "plug-ins"}


def test_versions_list_packages_of_plug_ins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All packages that provide the same name are listed with it."""
    for name, version in (("cork", "1.5"), ("oak", "2.0")):
        package = tmp_path / f"{name}-{version}.dist-info"
        package.mkdir()
        (package / "METADATA").write_text(
            f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", "utf-8"
        )
        (package / "entry_points.txt").write_text(
            f"[era_haptics.materials]\ncork = {name}:CORK\n", "utf-8"
        )
    monkeypatch.syspath_prepend(tmp_path)
    assert versions()["plug-ins"]["materials"] == {
        "cork": "cork:CORK (cork 1.5), oak:CORK (oak 2.0)"
    }


def test_report_includes_invalid_files(tmp_path: Path) -> None:
    """An invalid file may be the subject: it is included, shown like any other, and listed once."""
    (tmp_path / "broken.yaml").write_text("rig: [\napi_token: abc\n\tx", "utf-8")
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\x00: \x80")
    files = [tmp_path / name for name in ("broken.yaml", "bytes.yaml", "none.yaml")]
    found, missing = collect(files, socket=tmp_path / "no.sock", home=HOME)
    assert set(found) == {"broken.yaml", "bytes.yaml", "versions.json"}
    assert found["broken.yaml"] == "rig: [\napi_token: hidden\n\tx"
    assert [sum(path.name in each for each in missing) for path in files] == [1, 1, 1]


def test_report_command_writes_new_folder_for_owner_only(tmp_path: Path) -> None:
    """And no other file; a folder that is there is left as it is."""
    era = Path(sys.executable).with_name("era")
    command = [str(era), "report", "-o", "r", "--socket", "no.sock"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "r").stat().st_mode & 0o777 == 0o700
    assert set(os.listdir(tmp_path / "r")) == {"versions.json", "missing.txt"}  # noqa: PTH208
    assert os.listdir(tmp_path) == ["r"]  # noqa: PTH208
    (tmp_path / "r" / "missing.txt").write_text("mine", "utf-8")
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (again.returncode, again.stderr.count("\n")) == (2, 1)
    assert (tmp_path / "r" / "missing.txt").read_text("utf-8") == "mine"
