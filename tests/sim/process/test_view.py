"""The live view."""

import numpy as np
from rich.console import Console

from bench_driving import play
from drivers.contents import Tone
from model.rig.rig import Rig
from sim.bench.bench import Bench
from sim.control.context import SimulationContext
from sim.process.view import PlateView, draw


def shown(context: SimulationContext, plate: PlateView) -> str:
    """The view as text on a usual terminal."""
    console = Console(width=80, force_terminal=False)
    with console.capture() as capture:
        console.print(draw(context, plate))
    return capture.get()


def rows_of(text: str) -> list[str]:
    """The plate's rows, the top one first."""
    return [line[1:-1] for line in text.splitlines() if line.startswith("|")]


def test_view_shows_eras_fingers_and_peaks_in_place(coarse_rig: Rig) -> None:
    """y points upwards; peaks are darkest near the driven ERA; nothing at rest."""
    bench = Bench(coarse_rig, now=0.0)
    context = SimulationContext(bench, urls={"main": "serial:///dev/pts/7?baud=921600"})
    plate = PlateView(bench)
    bench.probes.append(plate)
    untouched = shown(context, plate).splitlines()
    assert len(untouched) < 24
    assert max(map(len, untouched)) <= 80
    bench.place_fingers({"1": (0.25, 0.05)}, now=0.0)
    still = shown(context, plate)
    rows = rows_of(still)
    assert [row[0] + row[-1] for row in (rows[0], rows[-1])] == ["EE", "EE"]
    # 0.25 of 0.3048 m from the left, 0.05 of 0.2286 m from below.
    assert rows[-1 - int(0.05 / 0.2286 * len(rows))].index("O") == int(0.25 / 0.3048 * 28)
    assert set("".join(rows)) == {"E", "O", " "}
    play(bench, Tone(0, 40.0, 0.5), now=0.1, watchdog=2.0)
    bench.advance(1.0)
    bench.advance(1.3)
    moving = shown(context, plate)
    assert "OPERATION_ENABLED" in moving
    assert " 50%    0%    0%    0%" in moving
    assert "1.3 s" in moving
    shades = " ·-+*#@"
    depth = np.array([[max(shades.find(c), 0) for c in row] for row in rows_of(moving)])
    # SW, where the drive is, is below on the left.
    assert depth[-3:, :8].mean() > depth[:3, -8:].mean()
