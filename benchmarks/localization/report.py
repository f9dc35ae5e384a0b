"""The figures as a page of the documentation, with pictures."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from benchmarks.localization.contrast import GOALS, QUIET, Section
from benchmarks.localization.picture import modes_figure

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "measured/localization-benchmarks.md"

INTRODUCTION = """# Localization benchmarks: contrast and speed

Printed by `python -m benchmarks.localization --sets {sets} --draws {draws} --seed {seed} --report`.
The paper's plate on four corner ERAs, 27 frequencies from 40 to 500 Hz. Contact sets: fingertips
(discs of 13 mm radius) anywhere on the plate, at least 5 cm apart, one of them the target, which
reaches at least 1 m/s²; {sets} sets for each count. Contrast is the target's mean peak acceleration
to the loudest quiet point. *Realised*: errors of 5 % in gain and 5 degrees in phase (standard
deviations); for each set the median of {draws} draws. Cells show the median over the sets, in
brackets the tenth percentile.

Other methods, on the same plate and contact sets, each at the best frequency for every set: the
paper's (one or two ERAs at full level, each at its own frequency), and two of the methods it cites.
The inverse filter solves for 1 at the target and 0 at the centres of the other fingertips; time
reversal plays the time-reversed response at the target, at one frequency or as a pulse of all 27
(peaks over time).
"""

READING = """
## Interpretation

- The exact search over all 614 655 patterns of four ERAs is the optimum of `switched`, and the
  bound of the mixture limits all amplitudes of the same sources: a goal above these lines is out of
  reach for this plate and these contact sets.
- `phased` is judged by its contrast under errors. Its robust score is the contrast with the
  mean error of 10 % of each ERA's share added to every quiet point; the bound below it holds for
  any complex weights at any one of the frequencies.
- Two targets take two of the four amplitudes: the remaining contrast is about that of one target
  with one more quiet finger.
"""


def write_report(sections: Sequence[Section], *, sets: int, draws: int, seed: int) -> None:
    """Write the page and its pictures."""
    page = INTRODUCTION.format(sets=sets, draws=draws, seed=seed)
    pictures = ["localization_contrast.png", "localization_growth.png", "localization_modes.png"]
    contrast, two, ensemble, freedom, speed, growth = sections
    (DOCS / "pictures").mkdir(exist_ok=True)
    _save(_contrast_figure(contrast), pictures[0])
    _save(_growth_figure(growth), pictures[1])
    _save(modes_figure(), pictures[2])
    parts = [page, _markdown(contrast), f"![contrast](../pictures/{pictures[0]})", READING]
    parts += [_markdown(each) for each in (two, ensemble, freedom, speed, growth)]
    parts += [f"![growth](../pictures/{pictures[1]})"]
    (DOCS / PAGE).write_text("\n\n".join(part.strip() for part in parts) + "\n", encoding="utf-8")
    print(f"wrote {DOCS / PAGE}")


def _markdown(section: Section) -> str:
    lines = [f"## {section.title}", ""]
    lines.append("| " + " | ".join(section.columns) + " |")
    lines.append("|" + "---|" * len(section.columns))
    lines += ["| " + " | ".join(row) + " |" for row in section.rows]
    if section.notes:
        notes = " ".join(section.notes)
        lines += ["", notes[0].upper() + notes[1:]]
    return "\n".join(lines)


def _save(figure: Figure, name: str) -> None:
    figure.savefig(DOCS / "pictures" / name, dpi=110)


def _contrast_figure(section: Section) -> Figure:
    """Distribution of realised contrast, a panel for each number of quiet fingers."""
    names = [name for name in section.data["names"] if not name.startswith(" ")]
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    for axes, quiet in zip(figure.subplots(1, len(QUIET), sharey=True), QUIET, strict=True):
        values = [section.data["realised"][name, quiet] for name in names]
        axes.boxplot(
            values,
            orientation="horizontal",
            whis=(10, 90),
            showfliers=False,
            widths=0.6,
            medianprops={"color": "#c0392b", "linewidth": 2},
        )
        for drive_mode, color in (("switched", "#2980b9"), ("phased", "#27ae60")):
            goal = float(GOALS[drive_mode][quiet].split()[0])
            axes.axvline(
                goal, color=color, linestyle="--", linewidth=1, label=f"goal, {drive_mode}"
            )
        axes.set_yticks(range(1, len(names) + 1), names)
        axes.invert_yaxis()
        axes.set_xlabel("realised contrast / dB")
        axes.set_title(f"{quiet} quiet finger" + ("s" if quiet > 1 else ""))
        axes.grid(axis="x", alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _growth_figure(section: Section) -> Figure:
    """Times against size on logarithmic axes."""
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    kinds = list(dict.fromkeys(what for what, _ in section.data))
    for axes, what in zip(figure.subplots(1, len(kinds), sharey=True), kinds, strict=True):
        sizes = [value for kind, value in section.data if kind == what]
        for name, label in (
            ("build", "table build"),
            ("exact", "exact search, one contact set"),
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
