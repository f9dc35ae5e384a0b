"""Contents of a bug report: harmless values of known keys, and nothing else of a user's."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from cases import read_yaml
from era_haptics.lab.harmless import Names, harmless_records
from era_haptics.lab.report import MAX_FILE_SIZE, ReportContents, collect, write_report
from model.rig.rig_file import example_rig_path

FOLDER = Path(__file__).parent
EXAMPLES = FOLDER.parents[2] / "examples"
RIG = example_rig_path().read_text("utf-8")


def report_of(folder: Path, *names: str) -> ReportContents:
    """Return the report of files in a folder, where no daemon runs."""
    return collect([folder / name for name in names], socket=folder / "no.sock")


def shown(folder: Path, name: str, text: str) -> Any:
    """Return what a report shows of a file with a text."""
    (folder / name).write_text(text, "utf-8")
    return yaml.safe_load(report_of(folder, name).files[name].text)


# Configurations

LEAKS = read_yaml(FOLDER / "leaks.yaml")
SECRET, NUMBER = "swordfish", "4077361"
VALID = {
    "rig.yaml": RIG,
    "daemon.yaml": "rig: rig.yaml\ntable: table.npz\n",
    "layout.yaml": "effects:\n  tick: {kind: click}\nmax_level_db_sl: 30\n",
    "alone.yaml": "",
}
"""Files to whose end a shape is added."""


@pytest.mark.parametrize("shape", LEAKS)
def test_report_has_no_secret_of_a_configuration(tmp_path: Path, shape: str) -> None:
    """In no file and no name of a file, wherever it is."""
    text = shape.replace("CANARY", SECRET).replace("NUMBER", NUMBER)
    for name, valid in VALID.items():
        folder = tmp_path / name.removesuffix(".yaml")
        folder.mkdir()
        (folder / name).write_text(valid + text, "utf-8")

        write_report(folder / "report", report_of(folder, name))

        for path in (folder / "report").iterdir():
            content = f"{path.name}\n{path.read_text('utf-8')}"
            assert not re.search(f"{SECRET}|{NUMBER}", content, re.IGNORECASE), path


def without_amplifiers(parts: dict[str, dict[str, object]]) -> list[dict[str, object]]:
    """Return parts of a rig without their names and those of their amplifiers."""
    return [{**part, "amplifier": None} for part in parts.values()]


@pytest.mark.parametrize("name", ["paper_plate", "car_display", "eight_eras", "weekend/rig"])
def test_report_shows_the_numbers_of_an_example(tmp_path: Path, name: str) -> None:
    """All values of plate, ERAs and limits; only names of ERAs and amplifiers may differ."""
    text = (EXAMPLES / f"{name}.yaml").read_text("utf-8")

    report = shown(tmp_path, "rig.yaml", text)

    rig = yaml.safe_load(text)
    assert report.keys() == rig.keys()
    for key, value in rig.items():
        if key in ("eras", "supports", "masses"):
            assert without_amplifiers(report[key]) == without_amplifiers(value)
        elif key != "amplifiers":
            assert report[key] == value


@pytest.mark.parametrize(
    ("text", "expected"),
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
    ids=["known", "similar", "unknown", "path", "source"],
)
def test_report_states_what_it_hides(
    tmp_path: Path, text: str, expected: dict[str, object]
) -> None:
    """Unknown keys by their lines and the similar known keys; schemes and options."""
    (tmp_path / "rig.yaml").write_text(RIG, "utf-8")

    daemon = shown(tmp_path, "daemon.yaml", f"rig: rig.yaml\n{text}\n")

    assert daemon == {"rig": "rig.yaml", **expected}


def test_report_gives_a_name_one_replacement_in_all_files(tmp_path: Path) -> None:
    """An amplifier of the rig, and of an ERA, is the same in the daemon's file and its log."""
    (tmp_path / "rig.yaml").write_text(re.sub(r"\bmain\b", "left-panel", RIG), "utf-8")
    (tmp_path / "daemon.yaml").write_text(
        "rig: rig.yaml\nserial_numbers: {left-panel: A17}\nlog: {file: log.txt}\n", "utf-8"
    )
    (tmp_path / "log.txt").write_text('{"message": "link left-panel: lost"}\n', "utf-8")

    files = report_of(tmp_path, "daemon.yaml").files

    ((name, number),) = yaml.safe_load(files["daemon.yaml"].text)["serial_numbers"].items()
    assert number == "hidden"
    rig = yaml.safe_load(files["rig.yaml"].text)
    assert list(rig["amplifiers"]) == [name]
    assert {wired["amplifier"] for wired in rig["eras"].values()} == {name}
    assert json.loads(files["log.jsonl"].text) == {"message": f"link {name}: lost"}
    for file in files.values():
        assert "left" not in file.text


# Records

RECORDS = {case["name"]: case for case in read_yaml(FOLDER / "records.yaml")}


@pytest.mark.parametrize("name", RECORDS)
def test_record_is_shown_in_the_programs_own_words(name: str) -> None:
    """Numbers and the words of the program stay; names, hosts, paths and other words do not."""
    line = json.dumps(RECORDS[name]["record"])

    assert json.loads(harmless_records(line, Names())) == RECORDS[name]["shown"]


# Files


@pytest.mark.parametrize("names", [["d.yaml"], ["rig.yaml", "d.yaml"]], ids=len)
def test_report_includes_files_of_the_daemon(tmp_path: Path, names: list[str]) -> None:
    """Its rig, layout and log once, and no table; missing files are listed."""
    (tmp_path / "rig.yaml").write_text(RIG, "utf-8")
    (tmp_path / "d.yaml").write_text(
        "rig: rig.yaml\nlayouts: {panel: none.yaml}\ntable: t.npz\nlog: {file: era.out}\n",
        "utf-8",
    )
    cut_off = "x" * MAX_FILE_SIZE
    (tmp_path / "era.out").write_text(f'{cut_off}\n{{"message": "link main: lost"}}\n', "utf-8")
    (tmp_path / "t.npz").write_bytes(b"x" * 100)

    report = report_of(tmp_path, *names)

    assert set(report.files) == {"daemon.yaml", "rig.yaml", "log.jsonl", "versions.json"}
    assert report.files["log.jsonl"].text.splitlines() == [
        '"hidden: a line that is not a record"',
        '{"message": "link main: lost"}',
    ]
    assert [line.partition(" ")[0] for line in report.missing] == ["unreadable.yaml:", "status"]
    versions = json.loads(report.files["versions.json"].text)
    assert versions["packages"]["numpy"][0].isdigit()
    assert "plug-ins" in versions


def test_report_has_the_location_of_a_syntax_error(tmp_path: Path) -> None:
    """Of a file that is not YAML only the line of its error is shown."""
    (tmp_path / "broken.yaml").write_text("rig: [\napi_token: abc\n\tx", "utf-8")
    (tmp_path / "bytes.yaml").write_bytes(b"\n\xff\x00: \x80")

    report = report_of(tmp_path, "broken.yaml", "bytes.yaml", "none.yaml")

    texts = {name: file.text for name, file in report.files.items()}
    del texts["versions.json"]
    assert texts == {
        "unreadable.yaml": "# not valid YAML at line 3; hidden\n",
        "unreadable-2.yaml": "# not valid YAML at line 2; hidden\n",
    }
    assert len(report.missing) == 4
    assert report.missing[2] == "unreadable-3.yaml: no such file"


def test_report_command_writes_a_new_folder_for_its_owner_only(tmp_path: Path) -> None:
    """And no other file; an existing folder is not changed."""
    era = Path(sys.executable).with_name("era")
    command = [str(era), "report", "-o", "r", "--socket", "no.sock"]
    folder = tmp_path / "r"

    first = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert first.stderr == ""
    assert first.returncode == 0
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.name for path in folder.iterdir()} == {"versions.json", "missing.txt"}
    assert list(tmp_path.iterdir()) == [folder]

    (folder / "missing.txt").write_text("mine", "utf-8")
    second = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert second.returncode == 2
    assert second.stderr.count("\n") == 1
    assert (folder / "missing.txt").read_text("utf-8") == "mine"
