"""Contents of a bug report: harmless values of known keys, and nothing else of a user's."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
import yaml

from cases import read_yaml
from era_haptics.lab.harmless import Names, harmless_records
from era_haptics.lab.report import (
    MAX_FILE_SIZE,
    ReportContents,
    collect,
    write_report,
)
from model.rig.rig_file import example_rig_path

SECRET, NUMBER = "swordfish", "4077361"
LEAKS = read_yaml(Path(__file__).with_name("leaks.yaml"))
BEFORE = {
    "rig.yaml": example_rig_path().read_text("utf-8"),
    "daemon.yaml": "rig: rig.yaml\ntable: table.npz\n",
    "layout.yaml": "effects:\n  tick: {kind: click}\nmax_level_db_sl: 30\n",
    "alone.yaml": "",
}
"""Valid files, at whose end a shape stands."""


def report_of(folder: Path, *names: str) -> ReportContents:
    """The report of files in a folder, where no daemon runs."""
    return collect([folder / name for name in names], socket=folder / "no.sock")


def written(folder: Path, report: ReportContents) -> str:
    """All that is in a report's folder: names and content of its files."""
    write_report(folder, report)
    return "".join(f"{path.name}\n{path.read_text('utf-8')}\n" for path in folder.iterdir())


@pytest.mark.parametrize("shape", LEAKS)
def test_report_has_nothing_of_a_secret_in_a_configuration(tmp_path: Path, shape: str) -> None:
    """In no file and no name of a file, wherever it stands; the rest of a valid file is shown."""
    text = shape.replace("CANARY", SECRET).replace("NUMBER", NUMBER)
    for name, before in BEFORE.items():
        folder = tmp_path / name.removesuffix(".yaml")
        folder.mkdir()
        (folder / name).write_text(before + text, "utf-8")
        content = written(folder / "report", report_of(folder, name))
        assert not re.search(f"{SECRET}|{NUMBER}", content, re.IGNORECASE)


@pytest.mark.parametrize("name", ["paper_plate", "car_display", "eight_eras", "weekend/rig"])
def test_report_shows_the_numbers_of_an_example(tmp_path: Path, name: str) -> None:
    """All values of plate, ERAs and limits; only names of ERAs and amplifiers may differ."""
    text = (Path(__file__).parents[3] / "examples" / f"{name}.yaml").read_text("utf-8")
    (tmp_path / "rig.yaml").write_text(text, "utf-8")
    shown = yaml.safe_load(report_of(tmp_path, "rig.yaml").files["rig.yaml"].text)
    given = yaml.safe_load(text)
    assert shown.keys() == given.keys()
    for key in given.keys() - {"eras", "supports", "masses", "amplifiers"}:
        assert shown[key] == given[key]
    for key in given.keys() & {"eras", "supports", "masses"}:
        assert [_numbers(part) for part in shown[key].values()] == [
            _numbers(part) for part in given[key].values()
        ]


def _numbers(part: dict[str, object]) -> dict[str, object]:
    return {key: value for key, value in part.items() if key != "amplifier"}


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("level_db_sl: 14 dB", {"level_db_sl": "14 dB"}),
        ("lvel_db_sl: 14", {"hidden": "unknown keys at line 2; similar to level_db_sl"}),
        ("password: 14\nuser: me", {"hidden": "unknown keys at line 2, line 3"}),
        ("log: {level: debug, file: /var/me.txt}", {"log": {"level": "debug", "file": "hidden"}}),
        (
            "touch: [{name: panel, url: 'tuio:127.0.0.1:3333?timeout=3'}]",
            {"touch": [{"name": "hidden", "url": "tuio:hidden?timeout=3"}]},
        ),
    ],
)
def test_report_says_what_it_hides(tmp_path: Path, given: str, expected: dict[str, object]) -> None:
    """Unknown keys by their lines and the known keys that they are like; schemes and options."""
    (tmp_path / "rig.yaml").write_text(BEFORE["rig.yaml"], "utf-8")
    (tmp_path / "daemon.yaml").write_text(f"rig: rig.yaml\n{given}\n", "utf-8")
    shown = report_of(tmp_path, "daemon.yaml").files["daemon.yaml"].text
    assert yaml.safe_load(shown) == {"rig": "rig.yaml", **expected}


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("sim://", "sim://"),
        ("serial:///dev/ttyUSB0?baud=921600", "serial:///dev/ttyUSB0?baud=921600"),
        ("serial:///dev/serial/by-id/usb-A17?baud=9600", "serial://hidden?baud=9600"),
        ("modbus+tcp://plc.example/7", "modbus+tcp://hidden"),
        ("can+socketcan://can0#7", "can+socketcan://hidden#7"),
        ("serial+tcp://me:1@amp:4001?pin=1", "serial+tcp://hidden"),
        ("ftp://amp/x?baud=1", "hidden"),
    ],
)
def test_report_shows_the_kind_of_a_line(tmp_path: Path, url: str, shown: str) -> None:
    """Scheme, usual device, options and number of a valid URL, without host, user or path."""
    rig = BEFORE["rig.yaml"].replace("sim://", url)
    (tmp_path / "rig.yaml").write_text(rig, "utf-8")
    report = yaml.safe_load(report_of(tmp_path, "rig.yaml").files["rig.yaml"].text)
    assert report["amplifiers"]["main"]["url"] == shown


def test_report_gives_a_name_one_replacement_in_all_files(tmp_path: Path) -> None:
    """An amplifier of the rig, and of an ERA, is the same in the daemon's file and its log."""
    rig = re.sub(r"\bmain\b", "left-panel", BEFORE["rig.yaml"])
    (tmp_path / "rig.yaml").write_text(rig, "utf-8")
    (tmp_path / "daemon.yaml").write_text(
        "rig: rig.yaml\nserial_numbers: {left-panel: A17}\nlog: {file: log.txt}\n", "utf-8"
    )
    (tmp_path / "log.txt").write_text('{"message": "link left-panel: lost"}\n', "utf-8")
    files = report_of(tmp_path, "daemon.yaml").files
    daemon, rig = (yaml.safe_load(files[name].text) for name in ("daemon.yaml", "rig.yaml"))
    (name,) = daemon["serial_numbers"]
    assert daemon["serial_numbers"][name] == "hidden"
    assert [*rig["amplifiers"]] == [name]
    assert {era["amplifier"] for era in rig["eras"].values()} == {name}
    assert json.loads(files["log.jsonl"].text) == {"message": f"link {name}: lost"}
    assert "left" not in "".join(file.text for file in files.values())


RECORDS = {
    "level and time": (
        {
            "time": "2026-01-02T03:04:05.123Z",
            "level": "warning",
            "message": "no reply within 30 ms",
        },
        {
            "time": "2026-01-02T03:04:05.123Z",
            "level": "warning",
            "message": "no reply within 30 ms",
        },
    ),
    "URL in a message": (
        {"message": "link main: no tcp://me:1@amp:4001 of swordfish, 10.0.0.2:4001 -> lost"},
        {"message": "link main: no … of … … -> lost"},
    ),
    "URL of a port": (
        {"url": "serial:///dev/ttyUSB0?baud=9600", "cause": "at serial+tcp://me:1@amp:4001, lost"},
        {"url": "serial:///dev/ttyUSB0?baud=9600", "cause": "at serial+tcp://hidden, lost"},
    ),
    "path and address": (
        {"message": "wrote /home/swordfish/era.log for swordfish@example.com, attempts=3"},
        {"message": "wrote … for … attempts=3"},
    ),
    "serial number and token": (
        {"serial_number": "A17", "access_token": 4},
        {"serial_number": "hidden", "hidden-2": "hidden"},
    ),
    "unknown key": ({"time_s": 1.5, "swordfish": 4077361}, {"time_s": 1.5, "hidden-2": "hidden"}),
    "unknown key of a part": (
        {"content": {"state": 7, "channels": [1, None, True], "swordfish": {"state": 1}}},
        {"content": {"state": 7, "channels": [1, None, True], "hidden-3": "hidden"}},
    ),
    "traceback": (
        {
            "traceback": 'Traceback:\n  File "/home/swordfish/x.py", line 3, in f\n'
            '  File "/opt/era/controller/cli/commands.py", line 12, in run\nValueError: swordfish'
        },
        {
            "traceback": "Traceback\n  File hidden, line 3\n"
            "  File controller/cli/commands.py, line 12\nValueError: …"
        },
    ),
}


@pytest.mark.parametrize(("record", "expected"), RECORDS.values(), ids=RECORDS)
def test_record_is_shown_in_the_programs_own_words(
    record: dict[str, object], expected: dict[str, object]
) -> None:
    """Numbers and the words of the program stay; names, hosts, paths and other words do not."""
    assert json.loads(harmless_records(json.dumps(record), Names())) == expected


@pytest.mark.parametrize(
    "line", ["swordfish", '{"message": "swordf', "[" * 5000, "\0", '{"a": 1} swordfish']
)
def test_line_that_is_no_record_is_hidden(line: str) -> None:
    """As the first of a long log, which is cut off, or what a library printed."""
    assert harmless_records(line, Names()) == '"hidden: a line that is not a record"\n'


@pytest.mark.parametrize("given", [["d.yaml"], ["rig.yaml", "d.yaml"]])
def test_report_includes_files_of_daemon(tmp_path: Path, given: Sequence[str]) -> None:
    """Its rig, layout and log once, and no table; missing files are listed."""
    (tmp_path / "rig.yaml").write_text(BEFORE["rig.yaml"], "utf-8")
    (tmp_path / "d.yaml").write_text(
        "rig: rig.yaml\nlayouts: {panel: none.yaml}\ntable: t.npz\nlog: {file: era.out}\n",
        "utf-8",
    )
    begun = "x" * MAX_FILE_SIZE
    (tmp_path / "era.out").write_text(f'{begun}\n{{"message": "link main: lost"}}\n', "utf-8")
    (tmp_path / "t.npz").write_bytes(b"x" * 100)
    report = report_of(tmp_path, *given)
    assert {*report.files} == {"daemon.yaml", "rig.yaml", "log.jsonl", "versions.json"}
    assert report.files["log.jsonl"].text.splitlines() == [
        '"hidden: a line that is not a record"',
        '{"message": "link main: lost"}',
    ]
    assert [line.partition(" ")[0] for line in report.missing] == ["unreadable.yaml:", "status"]
    found = json.loads(report.files["versions.json"].text)
    assert found["packages"]["numpy"][0].isdigit()
    assert set(found) >= {"packages", "plug-ins"}


def test_report_has_the_place_of_what_is_invalid(tmp_path: Path) -> None:
    """Of a file that is no YAML only the line of its error is shown."""
    (tmp_path / "broken.yaml").write_text("rig: [\napi_token: abc\n\tx", "utf-8")
    (tmp_path / "bytes.yaml").write_bytes(b"\n\xff\x00: \x80")
    report = report_of(tmp_path, "broken.yaml", "bytes.yaml", "none.yaml")
    assert {*report.files} == {"unreadable.yaml", "unreadable-2.yaml", "versions.json"}
    assert report.files["unreadable.yaml"].text == "# not valid YAML at line 3; hidden\n"
    assert report.files["unreadable-2.yaml"].text == "# not valid YAML at line 2; hidden\n"
    assert len(report.missing) == 4
    assert report.missing[2] == "unreadable-3.yaml: no such file"


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
