"""Files and summary of a design."""

from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any

from model.config.document import Value
from model.config.editing import data_text
from model.design.pictures import contrast_figure, count_figure
from model.design.run import Design
from model.design.support import static_loads
from model.figures import save_figure
from model.files.array_file import whole_or_nothing
from model.rig.rig import Channel, Rig
from model.structure.support import rigid_body_frequencies

MAX_CHANNELS = 4
"""Channels of an amplifier beyond the rig's own ones."""


def write_design(folder: Path, design: Design, data: Mapping[str, Value]) -> list[Path]:
    """Write rig.yaml, contrast.png and count.png; data: of the rig's file.

    Raises OSError if the folder cannot be written.
    """
    rig = folder / "rig.yaml"
    with whole_or_nothing(rig) as stream:
        stream.write(rig_text(design, data).encode())
    pictures = {"contrast.png": contrast_figure, "count.png": count_figure}
    for name, figure in pictures.items():
        save_figure(figure(design), folder / name)
    return [rig, *(folder / name for name in pictures)]


def rig_text(design: Design, data: Mapping[str, Value]) -> str:
    """The text of the rig's file with the ERAs of the best layout, on free channels."""
    problem = design.problem
    rig = problem.rig
    before, amplifiers = data["eras"], data["amplifiers"]
    assert isinstance(before, dict)  # noqa: S101  the rig was read from this data
    assert isinstance(amplifiers, dict)  # noqa: S101
    like = problem.like.name
    channels = iter(_free_channels(rig, problem.kept, count=problem.count))
    eras: dict[str, Value] = {}
    mounts = rig.masses[len(rig.masses) - len(rig.supports) :]
    for name, mount in zip(rig.supports, mounts, strict=True):
        eras[name] = deepcopy(before[name])
        _set_damping(eras[name], mount.damping)
    used = {}
    for era in problem.eras(design.best.found.positions):
        if era.name in problem.kept:
            eras[era.name] = deepcopy(before[era.name])
            _set_damping(eras[era.name], era.damping)
            continue
        section = deepcopy(before[like])  # no aliases in a file
        assert isinstance(section, dict)  # noqa: S101
        channel = next(channels)
        used[channel.amplifier] = True
        section |= {
            "at": [round(era.x, 6), round(era.y, 6)],
            "amplifier": channel.amplifier,
            "channel": channel.number,
            **({} if problem.stiffness is None else {"stiffness": problem.stiffness}),
        }
        _set_damping(section, era.damping)
        eras[era.name] = section
    own = {rig.wiring[name].amplifier for name in problem.kept}
    given = {name: amplifiers[name] for name in amplifiers if name in own or name in used}
    added: dict[str, Value] = {name: {"url": "sim://"} for name in used if name not in amplifiers}
    comment = (
        f"# Designed for contrast: {problem.count} ERAs, "
        f"{design.best.judged.mean_db:.1f} dB over fresh contact sets.\n"
    )
    if added:
        comment += f"# Give the amplifiers {', '.join(added)} the URLs of real ones.\n"
    return comment + data_text({**data, "eras": eras, "amplifiers": {**given, **added}})


def summary(design: Design) -> dict[str, Any]:
    """The design for JSON."""
    problem, best = design.problem, design.best
    eras = problem.eras(best.found.positions)
    rig = problem.rig
    loads = static_loads(rig, eras)
    lowest = float(rigid_body_frequencies(rig.plate, eras, loads=rig.masses)[0])
    return {
        "eras": {
            era.name: {
                "at_m": [era.x, era.y],
                "sensitivity_db_per_mm": float(sensitivity) / 1000,
                "static_load_n": float(load),
            }
            for era, sensitivity, load in zip(eras, design.sensitivities, loads, strict=False)
        },
        "contrast_db": best.judged.summary,
        "own_contrast_db": None if design.own is None else design.own.summary,
        "reached_share": best.judged.reached_share,
        "starts_db": [each.judged.mean_db for each in design.starts],
        "gap_db": design.gap_db,
        "by_count_db": {str(n): each.judged.mean_db for n, each in design.by_count.items()},
        "by_stiffness_db": {
            f"{stiffness:g}": each.judged.mean_db for stiffness, each in design.by_stiffness.items()
        },
        "lowest_rigid_body_hz": lowest,
        "sets": len(design.sets),
        "resumed": design.resumed_count,
    }


def _set_damping(section: Value, damping: float) -> None:
    """State damping by itself: its ratio refers to the number of ERAs."""
    assert isinstance(section, dict)  # noqa: S101
    section.pop("damping_ratio", None)
    section["damping"] = float(f"{damping:.6g}")


def _free_channels(rig: Rig, kept: tuple[str, ...], *, count: int) -> list[Channel]:
    """The rig's channels without those of kept ERAs, and further amplifiers of MAX_CHANNELS."""
    free = [channel for name, channel in rig.wiring.items() if name not in kept]
    names = (
        name for number in range(2, 99) if (name := f"amplifier{number}") not in rig.amplifiers
    )
    while len(free) < count:
        name = next(names)
        free += [Channel(name, number) for number in range(MAX_CHANNELS)]
    return free
