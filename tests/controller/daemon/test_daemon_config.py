"""The daemon's configuration file and its reload.

Defaults, paths, calibrations, and problems by line and key; what a reload applies and refuses, that
it is read in another process, and what it costs the loop.
"""

import asyncio
import itertools
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from controller.api.link import default_socket
from controller.cli.config_cli import config_app
from controller.daemon.children import read_in_child
from controller.daemon.config import DAEMON, DaemonConfig, DaemonSection, load_daemon_config
from controller.daemon.daemon import prepared_table
from controller.daemon.reload import config_change
from controller.sources.touch import Touch
from kit.clock import in_virtual_time
from kit.plates import TWO_AMPLIFIERS, write_rig
from model.config.document import ConfigError
from model.errors import InputError
from model.rig.rig_file import example_rig_path
from processes.daemons import ENABLED, ready_daemon

RUNNER = CliRunner()
EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with two rigs, two layouts and a table."""
    rig = example_rig_path().read_text("utf-8")
    (tmp_path / "rig.yaml").write_text(rig, "utf-8")
    (tmp_path / "other.yaml").write_text(rig.replace("level: 1.0", "level: 0.5"), "utf-8")
    for level in ("10", "neighbours"):
        effect = f"effects: {{hum: {{kind: buzz, level: {level}}}}}\n"
        (tmp_path / f"{level}.yaml").write_text(f"{effect}regions: {{}}\nelsewhere: hum\n", "utf-8")
    (tmp_path / "t.npz").touch()
    return tmp_path


def written(folder: Path, further_lines: str = "", *, rig: str = "rig.yaml") -> Path:
    """A daemon's file with these further lines."""
    path = folder / "daemon.yaml"
    path.write_text(f"rig: {rig}\n{further_lines}", encoding="utf-8")
    return path


def problems(path: Path) -> list[tuple[int | None, str]]:
    """Line and key of every problem of a daemon's file."""
    with pytest.raises(ConfigError) as caught:
        load_daemon_config(path)
    return [(problem.line, problem.key) for problem in caught.value.problems]


def test_config_has_defaults_for_all_keys_but_rig(folder: Path) -> None:
    """The amplifier is then simulated over the rig itself.

    ERA_HAPTICS_SOCKET names the socket; else XDG_RUNTIME_DIR is used if it is set.
    """
    config = load_daemon_config(written(folder))
    assert [era.name for era in config.rig.eras] == ["SW", "SE", "NE", "NW"]
    assert config.urls == {"main": f"sim://{folder}/rig.yaml?amplifier=main"}
    assert config.touch == ()
    assert (config.table, config.log_file, *config.layouts) == (None,) * 3
    assert config.socket == default_socket()
    assert config.rig_text == example_rig_path().read_text("utf-8")
    named = {"ERA_HAPTICS_SOCKET": "/a/b.sock", "XDG_RUNTIME_DIR": "/run/x"}
    assert default_socket(named) == Path("/a/b.sock")
    assert default_socket({"XDG_RUNTIME_DIR": "/run/x"}) == Path("/run/x/era-haptics/daemon.sock")
    assert default_socket({}).name == "daemon.sock"


def test_config_paths_are_relative_to_its_folder(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The working directory does not matter."""
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    text = "table: t.npz\nsocket: s.sock\nlog: {file: log}\nstrengths: /tmp/kept.json\n"
    config = load_daemon_config(written(folder, text))
    assert config.table == folder / "t.npz"
    assert config.socket == folder / "s.sock"
    assert config.log_file == folder / "log"
    assert config.strengths == Path("/tmp/kept.json")


@pytest.mark.parametrize(
    ("rig", "further_lines", "expected"),
    [
        (r'"a\0b"', "", [(1, "rig")]),
        ("[1]", "", [(1, "rig")]),
        ("rig.yaml", f"socket: {'a' * 4097}", [(2, "socket")]),
        ("rig.yaml", f"socket: {'a' * 107}", [(2, "socket")]),
        ("rig.yaml", "socket: rig.yaml", [(2, "socket")]),
        (
            "rig.yaml",
            "log: {file: none/log}\nstrengths: none/kept.json\n",
            [(2, "log.file"), (3, "strengths")],
        ),
        ("rig.yaml", "log: {file: .}\n", [(2, "log.file")]),
        ("rig.yaml", "serial_numbers: {man: A1}\n", [(2, "serial_numbers.man")]),
        ("rig.yaml", 'touch: [{name: api, url: "tuio:3333"}]\n', [(2, "touch[0].name")]),
        ("rig.yaml", "learn: learned.npz\n", [(2, "learn")]),
        ("rig.yaml", "strengths: none/kept.json\n", [(2, "strengths")]),
        ("rig.yaml", "strengths: /dev/zero\n", [(2, "strengths")]),
        ("rig.yaml", "touch: 3\n", [(2, "touch")]),
        ("rig.yaml", "touch: [3]\n", [(2, "touch[0]")]),
        pytest.param(
            "rigg.yaml",
            "tabel: x.npz\n"
            "mode: loud\n"
            "layouts: {home: none.yaml, climate: gone.yaml}\n"
            "touch:\n"
            '  - {name: a, url: "tuioo:1"}\n'
            '  - {name: a, url: "tuio:3333"}\n'
            '  - {name: b, url: "tuio:3333", calibration: {turned: 45}}\n'
            '  - {name: c, url: "tuio:3333", calibration: {mirror: x, matrix: [[1,0,0],[0,1,0]]}}\n'
            "log: {level: loud}\n"
            "dashboard: 0.0.0.0:80\n",
            [
                (1, "rig"),
                (2, "tabel"),
                (3, "mode"),
                (4, "layouts.home"),
                (4, "layouts.climate"),
                (6, "touch[0].url"),
                (7, "touch[1].name"),
                (8, "touch[2].calibration.turned"),
                (9, "touch[3].calibration.matrix"),
                (10, "log.level"),
                (11, "dashboard"),
            ],
            id="all at once",
        ),
    ],
)
def test_config_refuses(
    folder: Path, rig: str, further_lines: str, expected: list[tuple[int, str]]
) -> None:
    """Impossible paths, unknown amplifiers, reserved names, wrong shapes; all at once."""
    assert problems(written(folder, further_lines, rig=rig)) == expected


@pytest.mark.parametrize("name", ["car_display", "table"])
def test_example_with_several_simulated_amplifiers_is_accepted(name: str) -> None:
    """With its layout; all amplifiers are of one rig."""
    config = load_daemon_config(EXAMPLES / f"{name}_daemon.yaml")
    rig = EXAMPLES.resolve() / f"{name}.yaml"
    assert len(config.urls) > 2
    assert config.urls == {name: f"sim://{rig}?amplifier={name}" for name in config.urls}
    assert None not in config.layouts


@pytest.mark.parametrize("of_main", ["sim://", "serial:///dev/x?baud=9600", "serial:///dev/x"])
def test_config_refuses_amplifiers_with_which_no_daemon_starts(
    of_main: str, tmp_path: Path
) -> None:
    """A plate is simulated as a whole or not at all; a line is fast enough; an address has one."""
    changes = ('main: {url: "sim://"}', f'main: {{url: "{of_main}"}}')
    side = ('side: {url: "sim://"}', 'side: {url: "serial:///dev/x"}')
    write_rig(tmp_path / "rig.yaml", *TWO_AMPLIFIERS, changes, side)
    assert set(problems(written(tmp_path))) == {(1, "rig")}


def test_calibrations_map_sensor_to_plate(folder: Path) -> None:
    """By hand: turned clockwise, as is said or by its three corners, and by three touched points.

    Turned by 90 degrees the sensor's top left corner is the plate's top right. The last panel is
    upside down and 1 cm too far east on a plate of 0.3048 m by 0.2286 m: (x, y) is shown at
    (0.3048 - x + 0.01, 0.2286 - y).
    """
    path = written(
        folder,
        "touch:\n"
        '  - {name: a, url: "tuio:3333", calibration: {turned: 90}}\n'
        '  - {name: b, url: "tuio:3334", calibration: {points: [\n'
        "     {shown: [0, 0.2286], at: [0.3048, 0.2286]}, {shown: [0, 0], at: [0, 0.2286]},\n"
        "     {shown: [0.3048, 0.2286], at: [0.3048, 0]}]}}\n"
        '  - {name: c, url: "tuio:3335", calibration: {points: [\n'
        "     {shown: [304.8 mm, 21.86 cm], at: [1 cm, 1 cm]},\n"
        "     {shown: [2.48 cm, 21.86 cm], at: [29 cm, 1 cm]},\n"
        "     {shown: [304.8 mm, 0.0286], at: [1 cm, 20 cm]}]}}\n",
    )
    a, b, c = (source.calibration for source in load_daemon_config(path).touch)
    for turned in (a, b):
        placed = turned.apply(Touch(1, 0.25, 0.0))
        assert (placed.x, placed.y) == pytest.approx((1.0, 0.25))
    placed = c.apply(Touch(1, 0.0, 1.0))  # shown at the south-west corner
    assert (placed.x * 0.3048, (1 - placed.y) * 0.2286) == pytest.approx((0.3148, 0.2286))


FIVE_POINTS = """touch:
  - {name: exact, url: "tuio:3333"}
  - {name: panel, url: "tuio:3334", calibration: {points: [
     {shown: [0.05, 0.05], at: [0.05, 0.05]}, {shown: [0.25, 0.05], at: [0.25, 0.05]},
     {shown: [0.25, 0.15], at: [0.25, 0.15]}, {shown: [0.05, 0.15], at: [0.05, 0.15]},
     {shown: [0.15, 0.1], at: [15.5 cm, 0.1]}]}}
"""
"""Four corners of a rectangle, and its middle 5 mm off."""


@pytest.mark.parametrize(
    ("touch", "stated", "expected"),
    [
        ("", "", 0.002),
        (FIVE_POINTS, "", math.sqrt((0.004**2 + 4 * 0.001**2 + 3 * 0.002**2) / 5)),
        (FIVE_POINTS, "uncertainty: {touch_position: 1 mm}", 0.001),
        (FIVE_POINTS, "uncertainty: {gain: 0.03}", 0.00253),
    ],
    ids=["no source", "calibrated", "stated", "other key stated"],
)
def test_touch_position_is_as_uncertain_as_the_calibration(
    folder: Path, touch: str, stated: str, expected: float
) -> None:
    """The fit moves all points by 1 mm, and leaves 4 mm in the middle and 1 mm at the corners.

    With the default of 2 mm for each of the three points that a map fits. A value in the rig file
    comes first.
    """
    with (folder / "rig.yaml").open("a", encoding="utf-8") as rig:
        rig.write(f"\n{stated}\n")

    config = load_daemon_config(written(folder, touch))

    assert config.touch_position == pytest.approx(expected, rel=1e-3)


def test_daemon_promises_with_the_calibrated_touch_position(folder: Path) -> None:
    """Its table has the value of the configuration; the cached one keeps the rig's."""
    config = load_daemon_config(written(folder, FIVE_POINTS))

    table = prepared_table(config)

    assert table.uncertainty.touch_position == config.touch_position > 0.002
    assert config.rig.uncertainty.touch_position == 0.002


def test_config_commands_create_and_check_daemon_files(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The example that `init` writes is valid, has a schema and every key; `check` finds errors."""
    monkeypatch.chdir(folder)
    created = RUNNER.invoke(config_app, ["init", "d.yaml", "--kind", "daemon"])
    assert created.exit_code == 0, created.output
    assert json.loads((folder / "d.schema.json").read_text("utf-8"))["required"] == ["rig"]
    for key in DaemonSection.model_fields:
        assert f"\n{key}:" in DAEMON.example() or f"\n# {key}:" in DAEMON.example(), key
    good = RUNNER.invoke(config_app, ["check", "d.yaml"])
    assert good.exit_code == 0, good.output
    for name in ("SW", "NW", "main"):
        assert name in good.stdout
    assert "--check" not in good.stdout  # it would read no table
    text = (folder / "d.yaml").read_text("utf-8")
    (folder / "e.yaml").write_text(f"{text}\ntable: t.npz\n", "utf-8")
    assert "era daemon e.yaml --check" in RUNNER.invoke(config_app, ["check", "e.yaml"]).stdout
    (folder / "d.yaml").write_text(text.replace("level_db_sl: 20", "level: 20"), "utf-8")
    bad = RUNNER.invoke(config_app, ["check", "d.yaml", "--json"])
    assert bad.exit_code == 1
    assert [error["key"] for error in json.loads(bad.stdout)["errors"]] == ["level"]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ('{"a": -1000}', "must have strengths of -40 to 0 dB by name"),
        ('{"": -3}', "must have strengths of -40 to 0 dB by name"),
        ('{"a": NaN}', "must have strengths of -40 to 0 dB by name"),
        ('{"a": -3, "a": -6}', "strengths must have each name once, got 'a' twice"),
        ('{"a": -3, "a": -6}'.replace("a", "a" * 10**5), "each name once, got 'a{39}[.]{3} twice"),
        ("{'a': -3}", "is not JSON"),
        ('{"a": -3, "b', "is not JSON"),
        ('{"a": ' + "1" * 10**5 + "}", "must have strengths of -40 to 0 dB by name"),
        (" " * (1 << 21) + "{}", "must be up to 2 MiB"),
        ("[" * 100_000, "is not JSON"),
    ],
)
def test_kept_strengths_are_those_of_the_api(folder: Path, text: str, problem: str) -> None:
    """A file that was written by hand is refused at the line that names it, with what is wrong."""
    (folder / "kept.json").write_text(text, "utf-8")
    with pytest.raises(ConfigError, match=f"daemon.yaml:2: strengths: .*{problem}"):
        load_daemon_config(written(folder, "strengths: kept.json\n"))


FREQUENCIES = np.arange(60.0, 301.0, 20.0)  # Hz; of a table

MOST_EVENTS = 4000
"""Of a callback that handles input of clients or files: 2000 calls and returns, about 1 ms."""

DEFAULTS = {
    "rig": "rig.yaml",
    "level_db_sl": "20",
    "touch": '[{name: a, url: "tuio:3333"}]',
    "log": "{level: info}",
    "socket": "s",
}


@pytest.mark.parametrize(
    ("change", "while_armed", "disarmed"),
    [
        ({}, "", ""),
        ({"level_db_sl": "19"}, "", ""),
        ({"layouts": "{a: 10.yaml}"}, "", ""),
        ({"level_db_sl": "21"}, "while armed", ""),
        pytest.param(
            {"layouts": "{a: 10.yaml, b: neighbours.yaml}"},
            "while armed",
            "",
            id="a stronger layout is added",
        ),
        *(
            ({"level_db_sl": "10", key: value}, key, key)
            for key, value in (
                ("rig", "other.yaml"),
                ("table", "t.npz"),
                ("mode", "switched"),
                ("serial_numbers", "{main: A1}"),
                ("touch", "[]"),
                ("log", "{level: debug}"),
                ("socket", "t"),
                ("dashboard", "127.0.0.1:1"),
            )
        ),
    ],
)
def test_reload_applies_layouts_alone_and_raises_no_level_while_armed(
    folder: Path, change: dict[str, str], while_armed: str, disarmed: str
) -> None:
    """From 20 dB SL to 21, or to whatever the neighbors allow, in use or not, only once disarmed.

    A layout that changed with another key is not applied either; the key is named. Of the rig's
    file the content counts, not its name, for limits may have changed in it.
    """

    def loaded(changes: dict[str, str]) -> DaemonConfig:
        keys = {"rig": "rig.yaml", **DEFAULTS, **changes}
        lines = "".join(f"{key}: {value}\n" for key, value in keys.items() if key != "rig")
        return load_daemon_config(written(folder, lines, rig=keys["rig"]))

    old, new = loaded({}), loaded(change)
    for is_armed, reason in ((True, while_armed), (False, disarmed)):
        refusals = "; ".join(config_change(old, new).refusals(is_armed=is_armed))
        assert reason in refusals
        assert bool(refusals) is bool(reason)
    text = (folder / "rig.yaml").read_text("utf-8")
    (folder / "rig.yaml").write_text(text.replace("level: 1.0", "level: 0.9"), "utf-8")
    assert config_change(old, loaded(change)).refusals(is_armed=False)


REGIONS = 64  # as many as a layout may have


def write_layout(path: Path) -> None:
    """A layout of many regions, each with an effect of its own."""
    lines = ["effects:"]
    lines += [
        f"  e{number}: {{kind: buzz, level: {10 + number % 10}}}" for number in range(REGIONS)
    ]
    lines += ["regions:"]
    for number in range(REGIONS):
        x, y = 0.01 * (number % 20), 0.01 * (number // 20)
        corners = f"start: [{x}, {y}], end: [{x + 0.009:g}, {y + 0.009:g}]"
        lines.append(f"  r{number}: {{rectangle: {{{corners}}}, on_press: e{number}}}")
    path.write_text("\n".join([*lines, "elsewhere: null", ""]), encoding="utf-8")


@in_virtual_time
async def test_reload_costs_the_loop_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A large layout, added while armed and subscribed, is read in another process.

    No thread of the daemon holds the interpreter's lock for it; problems come back as text. Calls
    are counted: unlike a time they are the same on every machine.
    """
    events: list[int] = []
    run = asyncio.Handle._run

    def counted(handle: asyncio.Handle) -> None:
        count = itertools.count()
        sys.setprofile(lambda *_: next(count))
        try:
            run(handle)
        finally:
            sys.setprofile(None)
        events.append(next(count))

    def fail(*arguments: object, **options: object) -> None:
        raise AssertionError("read in the daemon's process")

    write_layout(tmp_path / "large.yaml")
    async with ready_daemon(tmp_path, "level_db_sl: 20\n", has_reader=True) as (bench, era):
        await era.subscribe("layout", "log")
        await era.arm("me", lease_s=60)
        for name in ("controller.daemon.config", "controller.effects.layout"):
            monkeypatch.setattr(f"{name}.read_document", fail)
        with (tmp_path / "daemon.yaml").open("a", encoding="utf-8") as file:
            file.write("layouts: {large: large.yaml}\n")
        with monkeypatch.context() as counting:
            counting.setattr(asyncio.Handle, "_run", counted)
            await asyncio.create_task(bench.daemon.reload())
            await asyncio.sleep(0.2)  # until all is as the layout says
        assert len(bench.daemon.config.layouts["large"].regions) == REGIONS
        assert len(events) > 10
        assert max(events) <= MOST_EVENTS
        assert (await era.status()).state == ENABLED
    with pytest.raises(InputError, match=r"missing\.yaml"):
        read_in_child(tmp_path / "missing.yaml", FREQUENCIES)


def test_plugin_installed_meanwhile_needs_a_restart(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the child reads by a plug-in that this process cannot load is bad input."""
    package = tmp_path / "installed"
    info = package / "late_effect-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late-effect\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[era_haptics.effects]\nlate = late_effect:Late\n")
    (package / "late_effect.py").write_text(
        "from controller.effects.kinds import Click\nclass Late(Click):\n    kind = 'late'\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(package))  # of children started from now on
    (folder / "layout.yaml").write_text("effects: {tap: {kind: late}}\nelsewhere: null\n")
    (folder / "daemon.yaml").write_text("rig: rig.yaml\nlayouts: {panel: layout.yaml}\n")
    with pytest.raises(InputError, match="restart the daemon"):
        read_in_child(folder / "daemon.yaml", FREQUENCIES)
