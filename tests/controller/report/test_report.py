"""What a bug report holds, and what it does not."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from controller.report.collect import MAX_DUMPS, collect, versions
from controller.report.redaction import redacted
from model.rig.file import example_rig_path

HOME = Path("/home/somebody")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("url: socket://me:pass@amp:4000", "url: socket://[hidden]@amp:4000"),
        ("token: abc123  # mine", "token: [hidden]  # mine"),
        ('{"api_token": "a b", "x": 1}', '{"api_token": [hidden], "x": 1}'),
        ("PASSWORD=hunter2&x=1", "PASSWORD=[hidden]&x=1"),
        ("http://127.0.0.1:1/#token=xyz", "http://127.0.0.1:1/#token=[hidden]"),
        ("Authorization: Bearer abc.def", "Authorization: Bearer [hidden]"),
        ("private_key: k.pem", "private_key: [hidden]"),
        ("file: /home/somebody/rig.yaml", "file: ~/rig.yaml"),
        ("keep_phase: true, token 7 of 9", "keep_phase: true, token 7 of 9"),
    ],
)
def test_redacted(text: str, expected: str) -> None:
    """Secrets and the home folder are gone, all else stays."""
    assert redacted(text, home=HOME) == expected


def test_home_that_is_everywhere() -> None:
    """A system's user may have / as home; paths stay as they are then."""
    assert redacted("/etc/x", home=Path("/")) == "/etc/x"


def test_everything_that_a_daemon_names(tmp_path: Path) -> None:
    """Its rig and layout, and the last of its dumps; a table is left where it is.

    So is whatever else lies where the dumps are.

    What is not there is said, and nothing fails for it.
    """
    (tmp_path / "rig.yaml").write_text(example_rig_path().read_text("utf-8"), "utf-8")
    (tmp_path / "d.yaml").write_text(
        "rig: rig.yaml\nlayout: none.yaml\ntable: t.npz\ndumps: {folder: dumps}\n", "utf-8"
    )
    (tmp_path / "t.npz").write_bytes(b"x" * 100)
    (tmp_path / "dumps").mkdir()
    for number in range(MAX_DUMPS + 2):
        (tmp_path / "dumps" / f"era-fault-2026-{number}.jsonl").write_text(str(number), "utf-8")
    (tmp_path / "dumps" / "letter.txt").write_text("dear", "utf-8")
    report = collect([tmp_path / "d.yaml"], socket=tmp_path / "no.sock", home=HOME)
    dumps = [f"era-fault-2026-{number}.jsonl" for number in range(2, MAX_DUMPS + 2)]
    assert set(report.files) == {"d.yaml", "rig.yaml", *dumps, "versions.json"}
    layout, daemon = report.missing
    assert "none.yaml" in layout
    assert "no daemon runs" in daemon
    told = json.loads(report.files["versions.json"])
    assert told["packages"]["numpy"][0].isdigit()
    assert "SerialBackend" in told["plug-ins"]["backends"]["serial"]


def test_plug_ins_of_every_kind_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages that add a material are named with it, as of any other kind, all that claim it."""
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
    told = versions()["plug-ins"]["materials"]
    assert told == {"cork": "cork:CORK (cork 1.5), oak:CORK (oak 2.0)"}


def test_files_that_cannot_be_read_as_they_should(tmp_path: Path) -> None:
    """A broken one may be what it is about: it is put in, without secrets, and nothing fails.

    One that is not there, and what a broken one names, are told once.
    """
    (tmp_path / "broken.yaml").write_text("rig: [\napi_token: abc\n\tx", "utf-8")
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\x00: \x80")
    files = [tmp_path / name for name in ("broken.yaml", "bytes.yaml", "none.yaml")]
    report = collect(files, socket=tmp_path / "no.sock", home=HOME)
    assert set(report.files) == {"broken.yaml", "bytes.yaml", "versions.json"}
    assert report.files["broken.yaml"] == "rig: [\napi_token: [hidden]\n\tx"
    assert [sum(path.name in each for each in report.missing) for path in files] == [1, 1, 1]


def test_command(tmp_path: Path) -> None:
    """It writes one file for its owner alone, and never over another."""
    era = Path(sys.executable).with_name("era")
    command = [str(era), "report", "-o", "r.zip", "--socket", "no.sock"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "r.zip").stat().st_mode & 0o777 == 0o600
    with zipfile.ZipFile(tmp_path / "r.zip") as archive:
        assert set(archive.namelist()) == {"versions.json", "missing.txt"}
    again = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert again.returncode == 2
    assert "there is such a file" in again.stderr
    assert os.listdir(tmp_path) == ["r.zip"]  # noqa: PTH208
