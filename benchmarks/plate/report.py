"""Tables and a picture for the page docs/measured/benchmarks.md."""

import os
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.page import write_parts

OURS_COLOR, PEER_COLOR = "#d62728", "#7f7f7f"
VERSIONS = ("numpy", "scipy", "scikit-fem", "pyfe3d", "ngsolve")

Result: TypeAlias = dict[Any, Any]
"""Output of one measurement, or the median of several."""


def write_report(
    measured: Mapping[str, Result],
    agreement: Sequence[Result],
    *,
    peers: Sequence[str],
    fastest: str,
    loads: Sequence[float],
    folder: Path,
) -> None:
    """Write measured/benchmarks.md and pictures/benchmarks.png; measured holds medians by name."""
    ours = measured["nothing ours"]
    peer_first = measured[f"nothing {fastest}"]
    peer_again = measured[f"layout {fastest}"]
    name = peer_first["name"]
    places, study = measured["places ours 48"], measured["study"]
    finest, peer_finest = measured["nothing ours 192"], measured["nothing peer finest"]
    high_order = measured["nothing ours 0"]
    new = measured["layout ours"]

    def row(what: str, each: Result, ratio: str = "") -> str:
        spread = f"{_time(each['least'])} to {_time(each['most'])}"
        return (
            f"| {what} | {_time(each['seconds'])} | {spread} | {each['peak_mb']:.0f} MB | {ratio} |"
        )

    def times(slow: Result, quick: Result) -> str:
        return f"{slow['seconds'] / quick['seconds']:.0f}"

    head = [
        "| | median | range | peak memory | speed-up over the fastest peer |",
        "|---|---|---|---|---|",
    ]
    from_nothing = [
        row("era-haptics, 48x36", ours, times(peer_first, ours)),
        row("era-haptics, 10x8 elements of order 5 with strips", high_order,
            times(peer_first, high_order)),
        *(row(f"{measured[f'nothing {p}']['name']}, {measured[f'nothing {p}']['dof']} unknowns",
              measured[f"nothing {p}"]) for p in peers),
        row("era-haptics, 192x144", finest, times(peer_finest, finest)),
        row(f"{name}, {peer_finest['dof']} unknowns (one run)", peer_finest),
    ]  # fmt: skip
    further = [
        row("era-haptics, known positions of a raster", places, times(peer_again, places)),
        row("era-haptics, new positions", new, times(peer_again, new)),
        *(row(f"{measured[f'layout {p}']['name']}, factorised again", measured[f"layout {p}"])
          for p in peers),
    ]  # fmt: skip
    hours = 10_000 * peer_again["seconds"] / 2 / 3600
    checks = [
        f"| {each['name']} | {each['method']} | "
        + " | ".join(
            f"{each[mesh]['all']:.1%} ({each[mesh]['median']:.1%})" for mesh in ((48, 36), (96, 72))
        )
        + " |"
        for each in agreement
    ]
    machine = (
        f"Medians of {len(loads)} runs in {len(loads)} processes. Machine: {_machine()}.\n"
        f"{_versions()}.\nLoad average during the measurement, including the benchmark's own one "
        f"to two: {min(loads):.1f} to {max(loads):.1f}."
    )
    agreed = ["| | plate and element | 48x36 | 96x72 |", "|---|---|---|---|", *checks]
    again = (
        f"Factorising every layout again, {name} would take {hours:.1f} hours on both cores, by "
        "its time above."
    )
    write_parts(
        folder / "measured" / "benchmarks.md",
        {
            "machine": machine,
            "agreement": "\n".join(agreed),
            "nothing": "\n".join(head + from_nothing),
            "layouts": "\n".join(head + further),
            "study": "\n".join([*head, row("era-haptics, two processes", study), "", again]),
        },
    )
    figure = _picture(measured, peers)
    FigureCanvasAgg(figure)
    figure.savefig(folder / "pictures" / "benchmarks.png", dpi=130)


def _picture(measured: Mapping[str, Result], peers: Sequence[str]) -> Figure:
    titles = {
        "nothing": "27 frequencies x 4 drives\ncomplete solution, 48x36",
        "layout": "every further layout\non the same plate",
    }
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, (task, title) in zip(panels, titles.items(), strict=True):
        entries = [(measured[f"{task} {peer}"], PEER_COLOR) for peer in peers]
        entries.sort(key=lambda entry: -entry[0]["seconds"])
        labels = [entry[0]["name"] for entry in entries]
        if task == "nothing":
            entries.append((measured["nothing ours"], OURS_COLOR))
            labels.append("era-haptics")
        else:
            entries += [
                (measured["layout ours"], OURS_COLOR),
                (measured["places ours 48"], OURS_COLOR),
            ]
            labels += ["era-haptics,\nnew positions", "era-haptics,\nknown positions"]
        seconds = [entry[0]["seconds"] for entry in entries]
        colors = [entry[1] for entry in entries]
        axes.hlines(labels, 1e-6, seconds, colors="#dddddd", zorder=0)
        axes.scatter(seconds, labels, color=colors, s=70)
        for number, value in enumerate(seconds):
            axes.annotate(
                _time(value), (value, number), (9, 0), textcoords="offset points", va="center"
            )
        axes.set_xscale("log")
        axes.set_xlim(min(seconds) / 3, max(seconds) * 8)
        axes.set_ylim(-0.6, len(seconds) - 0.4)
        axes.set_xlabel("time / s")
        axes.set_title(title)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    return figure


def _time(seconds: float) -> str:
    if seconds < 0.9995e-3:
        return f"{1e6 * seconds:.0f} µs"
    if seconds < 0.9995:
        return f"{1e3 * seconds:.3g} ms"
    return f"{seconds:.3g} s"


def _machine() -> str:
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        model = next((each.split(":")[1].strip() for each in lines if "model name" in each), model)
    return (
        f"{model}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    )


def _versions() -> str:
    return ", ".join(f"{name} {metadata.version(name)}" for name in VERSIONS)
