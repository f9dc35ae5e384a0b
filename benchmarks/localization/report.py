"""Figures and pictures for the page docs/measured/localization-benchmarks.md."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.localization.contrast import Section
from benchmarks.localization.picture import modes_figure
from benchmarks.page import write_parts

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "measured/localization-benchmarks.md"


def write_report(sections: Sequence[Section], *, sets: int, seed: int) -> None:
    """Write the figures into their page, and the pictures."""
    contrast, *_, growth = sections
    pictures = DOCS / "pictures"
    pictures.mkdir(exist_ok=True)
    for name, figure in (
        ("contrast", _contrast_figure(contrast)),
        ("growth", _growth_figure(growth)),
        ("modes", modes_figure()),
    ):
        figure.savefig(pictures / f"localization_{name}.png", dpi=110)
    run = f"`python -m benchmarks.localization --sets {sets} --seed {seed} --report`"
    write_parts(
        DOCS / PAGE,
        {
            "contrast": f"Printed by {run}.\n\n{_markdown(contrast)}",
            "further": "\n\n".join(_markdown(each) for each in sections[1:]),
        },
    )


def _markdown(section: Section) -> str:
    lines = [f"## {section.title}", ""]
    lines.append("| " + " | ".join(section.columns) + " |")
    lines.append("|" + "---|" * len(section.columns))
    lines += ["| " + " | ".join(row) + " |" for row in section.rows]
    if section.notes:
        notes = " ".join(section.notes)
        lines += ["", notes[0].upper() + notes[1:]]
    return "\n".join(lines)


def _contrast_figure(section: Section) -> Figure:
    """Distribution of the contrast of nine of ten plates, a panel for each kind of contact set."""
    kinds = list(dict.fromkeys(key[:2] for key in section.data))
    figure = Figure(figsize=(14, 3.6), layout="constrained")
    for axes, (targets, quiet) in zip(
        figure.subplots(1, len(kinds), sharey=True), kinds, strict=True
    ):
        names = [name for t, q, name in section.data if (t, q) == (targets, quiet)]
        axes.boxplot(
            [section.data[targets, quiet, name][1] for name in names],
            orientation="horizontal",
            whis=(10, 90),
            showfliers=False,
            widths=0.6,
            medianprops={"color": "#c0392b", "linewidth": 2},
        )
        axes.set_yticks(range(1, len(names) + 1), names)
        axes.set_xlabel("felt contrast of nine of ten plates / dB")
        axes.set_title(f"{targets} target{'s' if targets > 1 else ''}, {quiet} quiet")
        axes.grid(axis="x", alpha=0.3)
    return figure


def _growth_figure(section: Section) -> Figure:
    """Times against size on logarithmic axes."""
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    kinds = list(dict.fromkeys(what for what, _ in section.data))
    for axes, what in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
        sizes = [value for kind, value in section.data if kind == what]
        for name, label in (
            ("build", "table build"),
            ("phased", "query, phased"),
            ("switched", "query, switched"),
        ):
            times = [1e3 * section.data[what, size][name] for size in sizes]
            axes.plot(sizes, times, "o-", label=label)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.minorticks_off()
        axes.set_xlabel(what)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("time / ms, one thread")
    figure.axes[-1].legend(loc="upper center", bbox_to_anchor=(0.5, 0.8), fontsize=8)
    return figure
