"""`era design`: optimize or rank ERA positions by promised felt contrast."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from model.commands.options import (
    ClusterOption,
    ContactsOption,
    FolderOption,
    JsonOption,
    LowestOption,
    MeshOption,
    RigArgument,
    Stopwatch,
    next_line,
    print_report,
    progress_bar,
)
from model.config.units import LENGTH, STIFFNESS, Dimension, quantity
from model.errors import InputError
from model.quantities import counted
from registry.limits import MAX_CONTENTS

if TYPE_CHECKING:
    from era_haptics.lab.design.design_files import UnfinishedDesign

LIGHT = 0.2
"""Fraction of the ERAs' mean load below which the plate can tip when a finger presses elsewhere."""

design_app = typer.Typer()


@design_app.command()
def design(
    rig_file: RigArgument,
    output: FolderOption,
    eras: Annotated[
        str,
        typer.Option(
            metavar="N|LO-HI",
            help="Number of ERAs, including kept ones. The plate needs at least 3 mounts in total "
            "(ERAs and supports). Default: the rig's.",
        ),
    ] = "",
    layouts: Annotated[
        str,
        typer.Option(
            metavar="random:N|FILE",
            help="Rank layouts instead of searching: the first N of the named and then random "
            "layouts, or the layouts in a file.",
        ),
    ] = "",
    finalists: Annotated[
        int,
        typer.Option(
            min=1,
            max=1000,
            help="Number of candidate layouts evaluated in full, per ERA count and stiffness.",
        ),
    ] = 5,
    keep: Annotated[
        str, typer.Option(metavar="NAME,NAME", help="ERAs of the rig that keep their positions.")
    ] = "",
    where: Annotated[
        str,
        typer.Option(
            metavar="edge|anywhere|FILE",
            help="Area allowed for ERAs; FILE contains polygons in YAML.",
        ),
    ] = "edge",
    contents: Annotated[
        int,
        typer.Option(
            min=1, max=MAX_CONTENTS, help="Number of simultaneous vibrations, one per finger."
        ),
    ] = 1,
    contacts: ContactsOption = None,
    apart: Annotated[
        str, typer.Option(metavar="LENGTH", help="Minimum distance between ERAs.")
    ] = "30 mm",
    lowest: LowestOption = 20.0,
    stiffness: Annotated[
        str,
        typer.Option(
            metavar="STIFFNESS,...",
            help="Candidate stiffnesses for new ERAs; the best is used. Default: the rig's.",
        ),
    ] = "",
    seed: Annotated[
        int, typer.Option(min=0, help="Random seed of contact sets and starting layouts.")
    ] = 0,
    starts: Annotated[
        int, typer.Option(min=1, max=64, help="Number of starting layouts of the search.")
    ] = 4,
    workers: Annotated[
        int | None, typer.Option(min=1, max=256, help="Number of local processes. Default: 2.")
    ] = None,
    cluster: ClusterOption = None,
    mesh: MeshOption = None,
    as_json: JsonOption = False,
) -> None:
    """Optimize or rank ERA positions by promised felt contrast.

    Ctrl-C prints the layouts found so far and writes them to a file for --layouts.
    """
    from era_haptics.lab.design.design_files import UnfinishedDesign, design_summary, write_design
    from era_haptics.lab.design.design_run import design as find
    from model.config.document import read_document
    from model.rig.rig_file import rig_of

    document = read_document(rig_file)
    rig = rig_of(document, mesh=mesh)
    counts = _counts(eras) if eras else None
    distance = _quantity(apart, LENGTH, "--apart")
    springs = [_quantity(text, STIFFNESS, "--stiffness") for text in _listed(stiffness)]
    is_new_folder = not output.exists()
    output.mkdir(parents=True, exist_ok=True)
    unfinished = UnfinishedDesign()
    try:
        with Stopwatch() as stopwatch, progress_bar("tasks") as progress:
            designed = find(
                rig,
                counts,
                layouts=layouts or None,
                keep=_listed(keep),
                where=where,
                contacts=contacts,
                contents=contents,
                apart=distance,
                lowest=lowest,
                stiffness=springs,
                finalists=finalists,
                starts=starts,
                seed=seed,
                workers=workers or (None if cluster else 2),
                cluster=cluster,
                progress=progress,
                on_layout=unfinished.add,
            )
    except InputError:
        if is_new_folder:
            output.rmdir()
        raise
    except KeyboardInterrupt:
        _report_unfinished(unfinished, rig_file, output, as_json=as_json)
        raise
    files = [str(path) for path in write_design(output, designed, document.data)]
    result = {**design_summary(designed), "time_s": stopwatch.elapsed, "files": files}
    _warn_of_light(result["eras"])
    table = output / "table.npz"
    rows = [
        *_rows(result, own_count=len(rig.eras)),
        "wrote",
        *(f"  {name}" for name in files),
        next_line("era", "table", "build", files[0], "-o", table),
    ]
    print_report(rows, result, as_json=as_json)


def _report_unfinished(
    unfinished: "UnfinishedDesign", rig_file: Path, output: Path, *, as_json: bool
) -> None:
    """Print the result of an interrupted design, and write its layouts, if there are any."""
    result = unfinished.summary()
    files: list[str] = []
    rows = ["interrupted: this design is incomplete; no layout was found so far"]
    if result["layouts"]:
        file = output / "unfinished.yaml"
        unfinished.write(file)
        files = [str(file)]
        layouts = f"{result['layout_count']} layouts were found so far"
        counts = f"{layouts}, {result['judged']} evaluated in full"
        rows = [
            f"interrupted: this design is incomplete; {counts}",
            *_rows_of_layouts(result["layouts"]),
            f"wrote {file}, to evaluate these layouts; give the other options as before",
            next_line("era", "design", rig_file, "--layouts", file, "-o", output),
        ]
    print_report(rows, {**result, "files": files}, as_json=as_json)


def _counts(text: str) -> Sequence[int]:
    """Parse N or LO-HI as a range of ERA counts."""
    low, dash, high = text.partition("-")
    ends = [low.strip(), high.strip() if dash else low.strip()]
    if not all(end.isdecimal() for end in ends):
        raise InputError(f"--eras must be a number, or LO-HI such as 3-6, got {text!r}")
    first, last = map(int, ends)
    if first > last:
        raise InputError(
            f"--eras must be LO-HI with LO at most HI, got {text!r}; write {last}-{first}"
        )
    return range(first, last + 1)


def _listed(text: str) -> list[str]:
    """Split a comma-separated list."""
    return [item.strip() for item in text.split(",") if item.strip()]


def _quantity(text: str, dimension: Dimension, option: str) -> float:
    """Return the value of an option in its SI unit."""
    try:
        return quantity(text, dimension)
    except ValueError as error:
        raise InputError(f"{option} {error}") from None


def _warn_of_light(eras: dict[str, dict[str, Any]]) -> None:
    """Warn of ERAs that carry so little weight that the plate nearly tips."""
    loads = {name: era["static_load_n"] for name, era in eras.items()}
    min_load = LIGHT * sum(loads.values()) / len(loads)
    light = [f"{name} ({load:.2f} N)" for name, load in loads.items() if load < min_load]
    if light:
        typer.echo(
            f"era: warning: {', '.join(light)}: carries less than {min_load:.2f} N of the plate's "
            f"weight, {LIGHT:g} of the mean; a finger can lift the plate off: fasten it there, or "
            "exclude these positions with --where",
            err=True,
        )


def _rows(result: dict[str, Any], *, own_count: int) -> Iterator[str]:
    """Yield positions, contrast, starts, and the gain per ERA; own_count: number of ERAs of the
    rig."""
    yield f"{len(result['eras'])} ERAs in {result['time_s']:.1f} s"
    yield "name      x / mm   y / mm   dB per mm   load / N"
    for name, era in result["eras"].items():
        x, y = era["at_m"]
        yield (
            f"{name:8s} {1000 * x:7.1f}  {1000 * y:7.1f}   {era['sensitivity_db_per_mm']:9.3f}   "
            f"{era['static_load_n']:8.2f}"
        )
    if result["contents"] > 1:
        yield f"{result['contents']} simultaneous vibrations, contrast of the worst finger:"
    yield _contrast_row("this layout", result["contrast_db"])
    if result["own_contrast_db"] is not None:
        own_layout = f"the rig's own {counted(own_count, 'ERA')}"
        yield _contrast_row(own_layout, result["own_contrast_db"])
    reached = f"level reached in {100 * result['reached_share']:.0f} % of {result['sets']} sets"
    if result["starts_db"]:
        starts = len(result["starts_db"])
        gap = f"{starts} starts, the worst {result['gap_db']:.1f} dB behind"
        yield f"{gap if starts > 1 else '1 start'}; {reached}"
    else:
        unsupported = f"{result['unsupported']} do not support the plate"
        yield f"{result['layout_count']} layouts, {unsupported}; {reached}"
        yield from _rows_of_layouts(result["layouts"])
    for stiffness, value in result["by_stiffness_db"].items():
        yield f"ERAs of {stiffness} N/m: mean {value:.1f} dB"
    counts = list(result["by_count_db"].items())
    yield "ERAs      " + "  ".join(f"{count:>5s}" for count, _ in counts)
    yield "mean / dB " + "  ".join(f"{value:5.1f}" for _, value in counts)


def _contrast_row(title: str, contrasts: dict[str, float]) -> str:
    """Format the mean contrast, and the median for each number of quiet fingers."""
    medians = dict(contrasts)
    mean = medians.pop("mean")
    values = " / ".join(f"{value:.1f}" for value in medians.values())
    counts = " / ".join(name.split("_")[1] for name in medians)
    return f"{title}: mean {mean:.1f} dB, median {values} dB with {counts} quiet fingers"


def _rows_of_layouts(layouts: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the best of the given layouts."""
    yield "rank  layout                          stiffness  contrast  score"
    for layout in layouts:
        contrast = f"{layout['contrast_db']['mean']:.1f} dB" if layout["contrast_db"] else "-"
        score = f"{layout['score']:.1f}" if layout["supported"] else "-"
        yield (
            f"{layout['rank']:4d}  {layout['layout']:28s}  "
            f"{layout['stiffness_n_m'] / 1000:6.4g} kN/m  {contrast:>8s}  {score:>5s}"
        )
