"""Every reader of files from outside, by the name of such a file, and a valid file for each.

A reader that is missing here is not tested against hostile files (`tests.errors.hostile_files`).
"""

import contextlib
import io
import struct
import tempfile
from collections.abc import Callable, Mapping
from functools import cache, partial
from pathlib import Path

import numpy as np

from controller.content.formats import named_content, read_content
from controller.daemon.config import load_daemon_config
from controller.effects.layout import load_layout
from controller.effects.strengths import read_strengths
from controller.gateway.gateway_settings import read_token
from controller.sources.tuio_capture import read_capture
from era_haptics.command import run_era
from era_haptics.lab.design.contact_rule import anywhere, contact_rule
from era_haptics.lab.design.era_area import area_of
from era_haptics.lab.design.given_layouts import layouts_of
from era_haptics.lab.design.problem import DesignProblem
from era_haptics.lab.measuring.sensor_file import read_sensors
from kit.plates import small_table
from model.config.document import parse_document
from model.errors import InputError
from model.files.modal_file import read_modes
from model.files.uff import read_measured_bytes
from model.response_files import read_measured, read_places
from model.rig.rig_file import base_fingerprint, example_rig_path, load_rig
from model.table.table_file import load_table, save_table
from registry.command_line import BUG
from sim.faults import load_faults

EXAMPLES = Path(__file__).parents[3] / "examples"

RIG = load_rig(example_rig_path())
DESIGN = DesignProblem(RIG, 4, area_of("edge", RIG.plate), anywhere(RIG.plate))


def _run_command(words: str, path: Path) -> str:
    """Run a command that reads a file; raises InputError with its message if it fails.

    words: separated by spaces; FILE and TABLE stand for the file and for a table.
    """
    names = {"FILE": str(path), "TABLE": str(table_file())}
    arguments = [names.get(word, word) for word in words.split()]
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        status = run_era(arguments)
    text = printed.getvalue().strip()
    if status == BUG:
        raise RuntimeError(text)
    if status:
        raise InputError(text)
    return text


def _fitted_on(path: Path) -> object:
    """Read a fitted rig that has this file as its base."""
    sample = parse_document("base.yaml", SAMPLES["base.yaml"]().decode())
    fitted = path.with_name("fitted.yaml")
    fitted.write_text(f"base: {path.name}\nbase_fingerprint: {base_fingerprint(sample)}\n", "utf-8")
    return load_rig(fitted)


READERS: Mapping[str, Callable[[Path], object]] = {
    "rig.yaml": load_rig,
    "layout.yaml": lambda path: load_layout(path, None),
    "daemon.yaml": load_daemon_config,
    "polygons.yaml": lambda path: area_of(str(path), RIG.plate),
    "contacts.yaml": lambda path: contact_rule(path, RIG.plate),
    "layouts.yaml": lambda path: layouts_of(str(path), DESIGN),
    "faults.yaml": lambda path: load_faults(path, amplifiers=["main"]),
    "strengths.json": read_strengths,
    "token.txt": read_token,
    "taps.tuio": read_capture,
    "tap.ahap": read_content,
    "tap.haptic": read_content,
    "tap.hjif": read_content,
    "tap.wav": read_content,
    "measured.csv": read_measured,
    "measured.uff": read_measured,
    "places.csv": lambda path: read_places(path, RIG.plate),
    "sensors.csv": lambda path: read_sensors(path, RIG.plate),
    "moved.csv": lambda path: read_sensors(path, RIG.plate, may_move=True),
    "modes.npz": lambda path: read_modes(path, read_measured_bytes(path)),
    "modes.uff": lambda path: read_modes(path, read_measured_bytes(path)),
    "modes.csv": lambda path: read_modes(path, read_measured_bytes(path)),
    "table.npz": load_table,
    "checked.yaml": partial(_run_command, "config check FILE"),
    "base.yaml": _fitted_on,
    "questions.jsonl": partial(_run_command, "table query TABLE --batch FILE"),
}
"""By a name of a file, what reads it."""


@cache
def table_file() -> Path:
    """A small table of the paper's plate."""
    path = Path(tempfile.mkdtemp()) / "table.npz"
    save_table(small_table(), path)
    return path


def wav(samples: bytes, *, code: int, channels: int, rate: int, bits: int) -> bytes:
    """A WAV file of these samples."""
    frame = channels * bits // 8
    form = struct.pack("<HHIIHH", code, channels, rate, rate * frame & 0xFFFFFFFF, frame, bits)
    chunks = [b"fmt ", struct.pack("<I", len(form)), form]
    chunks += [b"data", struct.pack("<I", len(samples)), samples]
    body = b"WAVE" + b"".join(chunks)
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _tone() -> bytes:
    """A tone of 200 Hz in 16 bits."""
    times = np.arange(8000) / 8000
    samples = (0.5 * 32767 * np.sin(2 * np.pi * 200 * times)).astype("<i2")
    return wav(samples.tobytes(), code=1, channels=1, rate=8000, bits=16)


def _shapes() -> dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Modes of a beam along x, at 6 x 2 nodes."""
    x, y = np.meshgrid(np.linspace(0, 0.3, 6), [0.0, 0.2])
    nodes = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    numbers = np.arange(1, 9)
    shapes = np.zeros((len(numbers), len(nodes), 3))
    shapes[:, :, 2] = np.cos(np.pi * numbers[:, None] * nodes[:, 0] / 0.3)
    return {"nodes": nodes, "frequencies": 20.0 * numbers**2, "shapes": shapes}


def _modes_npz() -> bytes:
    content = io.BytesIO()
    np.savez(content, **_shapes())  # type: ignore[arg-type]
    return content.getvalue()


def _modes_csv() -> bytes:
    modes = _shapes()
    rows = ["mode,frequency_hz,x_m,y_m,z_m,shape_x,shape_y,shape_z"]
    for number, frequency in enumerate(modes["frequencies"]):
        for node, shape in zip(modes["nodes"], modes["shapes"][number], strict=True):
            values = ",".join(f"{value:.6f}" for value in (frequency, *node, *shape))
            rows.append(f"{number},{values}")
    return "\n".join([*rows, ""]).encode()


def _modes_uff() -> bytes:
    """Nodes (2411), shells (2412) and modes (55), as other programs export them."""
    modes = _shapes()
    rows = ["    -1", "  2411"]
    for number, node in enumerate(modes["nodes"], start=1):
        rows.append(f"{number:10d}{1:10d}{0:10d}{1:10d}")
        rows.append("".join(f"{value:25.16E}" for value in node))
    rows += ["    -1", "    -1", "  2412"]
    for first in range(1, 6):
        rows.append(f"{first:10d}{94:10d}{1:10d}{1:10d}{1:10d}{4:10d}")
        rows.append("".join(f"{node:10d}" for node in (first, first + 1, first + 7, first + 6)))
    rows.append("    -1")
    for number, frequency in enumerate(modes["frequencies"]):
        rows += ["    -1", "    55", *["NONE"] * 5]
        rows.append("".join(f"{code:10d}" for code in (1, 2, 3, 8, 2, 3)))
        rows.append(f"{2:10d}{4:10d}{0:10d}{number:10d}")
        rows.append("".join(f"{value:13.5E}" for value in (frequency, 1.0, 0.005, 0.0)))
        for node, shape in enumerate(modes["shapes"][number], start=1):
            rows.append(f"{node:10d}")
            rows.append("".join(f"{value:13.5E}" for value in shape))
        rows.append("    -1")
    return "\n".join([*rows, ""]).encode()


def _table() -> bytes:
    return table_file().read_bytes()


def _daemon() -> bytes:
    return f"rig: {example_rig_path()}\nlevel_db_sl: 20.0\n".encode()


SAMPLES: Mapping[str, Callable[[], bytes]] = {
    "rig.yaml": (EXAMPLES / "tutorial_rig.yaml").read_bytes,
    "layout.yaml": (EXAMPLES / "panel_layout.yaml").read_bytes,
    "daemon.yaml": _daemon,
    "polygons.yaml": lambda: b"polygons:\n  left: [[0.0, 0.0], [0.1, 0.0], [0.1, 0.2]]\n",
    "contacts.yaml": lambda: (
        b"quiet: [3, 6]\nregions: {a: {circle: {at: [0.1, 0.1], radius: 0.05}}}\n"
    ),
    "layouts.yaml": lambda: b"layouts: {two: [[0.0, 0.0], [0.3, 0.0], [0.3, 0.2], [0.0, 0.2]]}\n",
    "faults.yaml": lambda: (
        b"seed: 7\nfaults:\n  - {fault: drop, at: 2.0, lasts: 10.0, share: 0.2}\n"
    ),
    "strengths.json": lambda: b'{"table": -3.5}',
    "token.txt": lambda: b"0123456789abcdef0123456789abcdef\n",
    "taps.tuio": (EXAMPLES / "touches.tuio").read_bytes,
    "tap.ahap": named_content("tick").read_bytes,
    "tap.haptic": (EXAMPLES / "charging.haptic").read_bytes,
    "tap.hjif": named_content("error").read_bytes,
    "tap.wav": _tone,
    "measured.csv": (EXAMPLES / "measured.csv").read_bytes,
    "measured.uff": (EXAMPLES / "measured.uff").read_bytes,
    "places.csv": lambda: b"sensor,x_m,y_m\nP1,0.1,0.1\nP2,0.2,0.1\n",
    "sensors.csv": lambda: b"sensor,x_m,y_m,input,mv_per_m_s2\nP1,0.1,0.1,1,10.0\n",
    "moved.csv": lambda: (
        b"sensor,x_m,y_m,input,mv_per_m_s2,mass_g\nP1,0.1,0.1,1,10.0,2.5\nP2,0.2,0.1,1,10.0,2.5\n"
    ),
    "modes.npz": _modes_npz,
    "modes.uff": _modes_uff,
    "modes.csv": _modes_csv,
    "table.npz": _table,
    "checked.yaml": (EXAMPLES / "tutorial_rig.yaml").read_bytes,
    "base.yaml": (EXAMPLES / "tutorial_rig.yaml").read_bytes,
    "questions.jsonl": lambda: b'{"target": [0.1, 0.1], "quiet": [[0.2, 0.15]]}\n',
}
"""By a name of a file, a valid content."""


def write_sample(folder: Path, name: str) -> Path:
    """Write a valid file of a name into a folder."""
    path = folder / name
    path.write_bytes(SAMPLES[name]())
    path.chmod(0o600)
    return path
