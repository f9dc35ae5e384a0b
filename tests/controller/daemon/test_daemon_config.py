import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controller.api.socket_path import default_socket
from controller.daemon.config import load_daemon_config
from controller.sources.touch import Touch
from model.commands.config_cli import config_app
from model.config.document import ConfigError
from model.errors import InputError
from model.rig.file import example_rig_path

RUNNER = CliRunner()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the example's rig in it."""
    (tmp_path / "rig.yaml").write_text(example_rig_path().read_text("utf-8"), "utf-8")
    return tmp_path


def written(folder: Path, text: str) -> Path:
    """A daemon's file of this text."""
    path = folder / "daemon.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def problems(path: Path) -> list[tuple[int | None, str]]:
    """Line and key of everything that is wrong with a daemon's file."""
    with pytest.raises(ConfigError) as caught:
        load_daemon_config(path)
    return [(problem.line, problem.key) for problem in caught.value.problems]


def test_a_file_that_names_a_rig_only_is_enough(folder: Path) -> None:
    """Everything else has a default; the amplifier is simulated over the rig itself."""
    config = load_daemon_config(written(folder, "rig: rig.yaml\n"))
    assert [era.name for era in config.rig.eras] == ["SW", "SE", "NE", "NW"]
    assert config.urls == {"main": f"sim://{folder}/rig.yaml?amplifier=main"}
    assert config.touch == ()
    assert (config.table, config.layout, config.dump_folder, config.log_file) == (None,) * 4
    assert config.section.longest_lease == 60.0
    assert config.section.touch_wait == 0.030
    assert config.socket == default_socket()
    assert config.rig_text == example_rig_path().read_text("utf-8")


def test_daemon_refuses_a_rig_that_does_not_support_its_plate(folder: Path) -> None:
    """At the key that names the rig."""
    rig = folder / "rig.yaml"
    lines = rig.read_text("utf-8").splitlines(keepends=True)
    rig.write_text("".join(line for line in lines if line[:5] not in ("  NE:", "  NW:")), "utf-8")
    assert problems(written(folder, "rig: rig.yaml\n")) == [(1, "rig")]


def test_files_count_from_the_folder_of_the_configuration(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever the daemon is started, its files are the same."""
    (folder / "t.npz").touch()
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    text = "rig: rig.yaml\ntable: t.npz\nsocket: s.sock\nlog: {file: log}\ndumps: {folder: /d}\n"
    config = load_daemon_config(written(folder, text))
    assert config.table == folder / "t.npz"
    assert config.socket == folder / "s.sock"
    assert config.log_file == folder / "log"
    assert config.dump_folder == Path("/d")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            r'rig: "a\0b"',
            r"1: rig: .*",
        ),
        (
            f"rig: rig.yaml\nsocket: {'a' * 4097}",
            r"2: socket: .*4096.*",
        ),
    ],
)
def test_config_refuses_impossible_file_names(folder: Path, text: str, said: str) -> None:
    """A zero byte and too long a name are reported with line and key."""
    with pytest.raises(ConfigError, match=rf"daemon\.yaml:{said}$"):
        load_daemon_config(written(folder, text))


def test_what_is_written_later_has_a_place(folder: Path) -> None:
    """No folder for the log, a folder in its place, a file where the dumps' folder shall be."""
    text = "rig: rig.yaml\nlog: {file: none/log}\ndumps: {folder: rig.yaml/dumps}\n"
    assert problems(written(folder, text)) == [(2, "log.file"), (3, "dumps.folder")]
    assert problems(written(folder, "rig: rig.yaml\nlog: {file: .}\n")) == [(2, "log.file")]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("plate: {}\neras: {}\n", "rig: FILE"),
        ("regions: {}\n", "layout: FILE"),
    ],
)
def test_another_kind_of_file_is_named_as_such(folder: Path, text: str, message: str) -> None:
    """In one sentence, not by every key that a daemon's file has not."""
    with pytest.raises(InputError) as caught:
        load_daemon_config(written(folder, text))
    assert message in str(caught.value)
    assert "unknown key" not in str(caught.value)


def test_everything_that_is_wrong_is_said_at_once(folder: Path) -> None:
    """Each error with the line and the key that it stands at."""
    path = written(
        folder,
        "rig: rigg.yaml\n"
        "tabel: x.npz\n"
        "mode: loud\n"
        "layout: none.yaml\n"
        "touch:\n"
        '  - {name: a, url: "tuioo:1"}\n'
        '  - {name: a, url: "tuio:3333"}\n'
        '  - {name: b, url: "tuio:3333", calibration: {turned: 45}}\n'
        '  - {name: c, url: "tuio:3333", calibration: {mirror: x, matrix: [[1,0,0],[0,1,0]]}}\n'
        '  - {name: d, url: "tuio:3333", calibration: {matrix: [[1,0,0],[1,0,0]]}}\n'
        "log: {level: loud}\n"
        "dashboard: 0.0.0.0:80\n"
        "metrics: 65536\n"
        "longest_lease: 61 s\n"
        "touch_wait: 101 ms\n",
    )
    assert problems(path) == [
        (1, "rig"),
        (2, "tabel"),
        (3, "mode"),
        (4, "layout"),
        (6, "touch[0].url"),
        (7, "touch[1].name"),
        (8, "touch[2].calibration.turned"),
        (9, "touch[3].calibration"),
        (10, "touch[4].calibration"),
        (11, "log.level"),
        (12, "dashboard"),
        (13, "metrics"),
        (14, "longest_lease"),
        (15, "touch_wait"),
    ]


def test_what_is_wrong_with_the_rig_is_said_too(folder: Path) -> None:
    """Its own lines and keys, and an amplifier URL that no backend understands."""
    text = (folder / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("1.5 mm", "1.5 kg"), "utf-8")
    with pytest.raises(ConfigError, match=r"rig\.yaml:\d+: plate\.thickness") as caught:
        load_daemon_config(written(folder, "rig: rig.yaml\n"))
    assert [problem.key for problem in caught.value.problems] == ["rig"]
    (folder / "rig.yaml").write_text(text.replace("sim://", "serail:///dev/null"), "utf-8")
    with pytest.raises(ConfigError, match=r"amplifiers\.main\.url .* did you mean serial://"):
        load_daemon_config(written(folder, "rig: rig.yaml\n"))


def test_serial_numbers_are_those_of_the_rigs_amplifiers(folder: Path) -> None:
    """A number for an amplifier that is not there would check nothing."""
    path = written(folder, "rig: rig.yaml\nserial_numbers: {man: A1}\n")
    assert problems(path) == [(2, "serial_numbers.man")]


def test_calibrations_put_touches_where_the_plate_is(folder: Path) -> None:
    """Turned by 90 degrees clockwise, the sensor's top left corner is the plate's top right."""
    path = written(
        folder,
        "rig: rig.yaml\n"
        "touch:\n"
        '  - {name: a, url: "tuio:3333", calibration: {turned: 90}}\n'
        '  - {name: b, url: "tuio:3334", calibration: {matrix: [[0.5, 0, 0.25], [0, 1, 0]]}}\n',
    )
    a, b = (source.calibration for source in load_daemon_config(path).touch)
    assert a.place(Touch(1, 0.0, 0.0)) == Touch(1, 1.0, 0.0)
    assert b.place(Touch(1, 1.0, 0.5)) == Touch(1, 0.75, 0.5)


def test_a_calibration_by_points(folder: Path) -> None:
    """A panel mounted upside down and 1 cm too far to the east, by three corners in plate metres.

    The plate is 0.3048 m by 0.2286 m: (x, y) is shown at (0.3048 - x + 0.01, 0.2286 - y).
    """
    path = written(
        folder,
        "rig: rig.yaml\n"
        "touch:\n"
        '  - {name: a, url: "tuio:3333", calibration: {points: [\n'
        "     {shown: [304.8 mm, 21.86 cm], at: [1 cm, 1 cm]},\n"
        "     {shown: [2.48 cm, 21.86 cm], at: [29 cm, 1 cm]},\n"
        "     {shown: [304.8 mm, 0.0286], at: [1 cm, 20 cm]}]}}\n",
    )
    (source,) = load_daemon_config(path).touch
    placed = source.calibration.place(Touch(1, 0.0, 1.0))  # what is shown at the south-west corner
    assert (placed.x * 0.3048, (1 - placed.y) * 0.2286) == pytest.approx((0.3148, 0.2286))


@pytest.mark.parametrize(
    ("calibration", "where", "words"),
    [
        ("{points: [{shown: [0, 0], at: [0, 0]}]}", "calibration.points", "at least 3"),
        ("{turned: 90, points: [A, B, C]}", "calibration", "only one of"),
        ("{points: [A, B, {shown: [0.2, 0.2], at: [0.2, 0.2]}]}", "calibration", "on a line"),
        ("{points: [A, B, C, {shown: [0.1, 0.2], at: [0.1, 0.1]}]}", "calibration", "point 2"),
        ("{points: [A, B, {shown: [0.2 s, 0], at: [0, 0]}]}", "points[2].shown[0]", "length"),
    ],
)
def test_calibrations_by_points_that_say_too_little(
    folder: Path, calibration: str, where: str, words: str
) -> None:
    """Each is refused with its key and the reason."""
    for name, x, y in (("A", 0, 0), ("B", 0.1, 0.1), ("C", 0.2, 0)):
        calibration = calibration.replace(name, f"{{shown: [{x}, {y}], at: [{x}, {y}]}}")
    text = f'rig: rig.yaml\ntouch: [{{name: a, url: "tuio:3333", calibration: {calibration}}}]\n'
    with pytest.raises(ConfigError) as caught:
        load_daemon_config(written(folder, text))
    assert where in str(caught.value)
    assert words in str(caught.value)


def test_no_source_is_called_like_programs(folder: Path) -> None:
    """Contacts of `api` are those of the API's clients, and nobody else's."""
    path = written(folder, 'rig: rig.yaml\ntouch: [{name: api, url: "tuio:3333"}]\n')
    assert problems(path) == [(2, "touch[0].name")]


@pytest.mark.parametrize(
    "text", ["rig: [1]\n", "rig: rig.yaml\ntouch: 3\n", "rig: rig.yaml\ntouch: [3]\n"]
)
def test_any_shape_is_an_error_with_a_line(folder: Path, text: str) -> None:
    """What is no text, list or mapping where one belongs is told as such."""
    assert all(line is not None for line, _ in problems(written(folder, text)))


def test_the_socket_lies_where_the_user_may_write() -> None:
    """The runtime folder of the session, if there is one."""
    assert default_socket({"XDG_RUNTIME_DIR": "/run/x"}) == Path("/run/x/era-haptics/daemon.sock")
    assert default_socket({}).name == "daemon.sock"


def test_era_config_knows_a_daemon_file_by_its_keys(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`init --kind daemon` writes one that `check` finds good, its schema beside it."""
    monkeypatch.chdir(folder)
    made = RUNNER.invoke(config_app, ["init", "d.yaml", "--kind", "daemon"])
    assert made.exit_code == 0, made.output
    assert json.loads((folder / "d.schema.json").read_text("utf-8"))["required"] == ["rig"]
    good = RUNNER.invoke(config_app, ["check", "d.yaml"])
    assert good.exit_code == 0, good.output
    assert "ERAs SW, SE, NE, NW on main" in good.stdout
    assert "--check" not in good.stdout  # there is no table that it would read
    text = (folder / "d.yaml").read_text("utf-8")
    (folder / "t.npz").touch()
    (folder / "e.yaml").write_text(f"{text}\ntable: t.npz\n", "utf-8")
    with_a_table = RUNNER.invoke(config_app, ["check", "e.yaml"]).stdout
    assert with_a_table.endswith(". era daemon e.yaml --check reads its table, too\n")
    (folder / "d.yaml").write_text(text.replace("level_db_sl: 20", "level: 20"), "utf-8")
    bad = RUNNER.invoke(config_app, ["check", "d.yaml", "--json"])
    assert bad.exit_code == 1
    assert [error["key"] for error in json.loads(bad.stdout)["errors"]] == ["level"]


def test_every_key_stands_in_the_example() -> None:
    """The commented file that people begin with leaves no key out."""
    from controller.daemon.config_kind import DAEMON
    from controller.daemon.config_sections import DaemonSection

    for key in DaemonSection.model_fields:
        assert f"\n{key}:" in DAEMON.example() or f"\n# {key}:" in DAEMON.example(), key


def test_a_kind_that_is_none_is_refused(tmp_path: Path) -> None:
    """With those that there are."""
    result = RUNNER.invoke(config_app, ["init", str(tmp_path / "x.yaml"), "--kind", "boat"])
    assert isinstance(result.exception, InputError)
    assert "known are daemon, " in str(result.exception)
