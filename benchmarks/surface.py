"""A surface by its modes against the plate that they come from: fields, contrast and promises.

    python -m benchmarks.surface [--sets N] [--page]

The paper's plate is exported as another program would, by its modes at 25 x 19 nodes up to 1.5, 3
and 5 times the highest frequency of its limits, and read again as a surface. Beside the plate's own
table: the largest difference of the field of any ERA at any frequency, its mean, and what the
surface's table states as its error, mean; two to four fingers, one of which feels a content: the
median of what each table promises to it, phased. Last, the share of the promises of each table that
hold on plates drawn around the plate and solved by its own table. With --page the table goes to
docs/how-to/surface.md.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.contents import promised_worst, share_kept
from benchmarks.page import write_parts
from benchmarks.setting import RIG, random_contacts, use_one_thread

if TYPE_CHECKING:
    from model.arrays import FloatArray
    from model.rig.rig import Rig

PAGE = Path(__file__).parents[1] / "docs" / "how-to" / "surface.md"
MULTIPLES = (1.5, 3.0, 5.0)
NODES = 25, 19


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sets", type=int, default=67, help="sets of fingers for each row")
    parser.add_argument("--page", action="store_true", help="write the table to its page")
    options = parser.parse_args()
    use_one_thread()
    import numpy as np

    from model.answer.plan import answer
    from model.answer.stimulus import Finger, Stimulus
    from model.rig.rig_file import load_rig
    from model.table.table_file import build_table

    rig = load_rig(RIG)
    own = build_table(rig, drive_mode="phased")
    size = rig.plate.length, rig.plate.width
    rows = [
        "| modes up to | field differs, most | mean | stated, mean | promised by the plate / dB "
        "| by the surface / dB | kept of the plate's | kept of the surface's |",
        "|---|---|---|---|---|---|---|---|",
    ]
    print(*rows, sep="\n")
    for multiple in MULTIPLES:
        highest = multiple * rig.limits.frequency_max
        with tempfile.TemporaryDirectory() as folder:
            surface = build_table(_as_surface(rig, highest, Path(folder)), drive_mode="phased")
        fields, others = (each.unit_fields(own.cell_centres) for each in (own, surface))
        off = np.linalg.norm(others - fields, axis=-1) / np.linalg.norm(fields, axis=-1)
        promised, kept = list[list[float]](), list[list[float]]()
        rng = np.random.default_rng(1)
        for number in range(options.sets):
            places = [(float(x), float(y)) for x, y in random_contacts(rng, 2 + number % 3, size)]
            asked = [Finger(places[0], Stimulus())]
            found = [
                answer(
                    each,
                    asked,
                    quiet=places[1:],
                    drive_mode="phased",
                    min_contrast_db=-np.inf,
                )
                for each in (own, surface)
            ]
            promised.append([promised_worst(each) for each in found])
            kept.append([share_kept(own, each, places[1:], seed=number) for each in found])
        by_plate, by_surface = np.median(promised, axis=0)
        shares = 100 * np.mean(kept, axis=0)
        rows.append(
            f"| {multiple:g} times the highest frequency | {100 * off.max():.0f} % "
            f"| {100 * off.mean():.1f} % | {100 * surface.discretisation_error.mean():.1f} % "
            f"| {by_plate:.1f} | {by_surface:.1f} | {shares[0]:.0f} % | {shares[1]:.0f} % |"
        )
        print(rows[-1], flush=True)
    if options.page:
        write_parts(PAGE, {"figures": "\n".join(rows)})


def _as_surface(rig: "Rig", highest: float, folder: Path) -> "Rig":
    """Return a rig with a surface in place of its plate, by the plate's modes up to a frequency."""
    import numpy as np
    import yaml

    from model.rig.rig_file import load_rig

    arrays: dict[str, Any] = {**exported_modes(rig, highest, NODES)}
    arrays["damping_ratios"] = np.full(len(arrays["frequencies"]), rig.plate.loss_factor / 2)
    np.savez(folder / "modes.npz", **arrays)
    keys = yaml.safe_load(RIG.read_text("utf-8"))
    keys.pop("mesh", None)
    del keys["plate"]
    file = folder / "rig.yaml"
    file.write_text(yaml.safe_dump({**keys, "surface": "modes.npz"}, sort_keys=False), "utf-8")
    return replace(load_rig(file), uncertainty=rig.uncertainty)


def exported_modes(rig: "Rig", highest: float, nodes: tuple[int, int]) -> "dict[str, FloatArray]":
    """Return the modes of a rig's free plate up to a frequency [Hz], as another program has them.

    nodes: numbers of nodes along x and y, at which shapes along z are given.
    """
    import numpy as np

    from model.arrays import lattice
    from model.reduction.free_plate import FREQUENCY_MARGIN, solve_free_plate

    plate = rig.plate
    free = solve_free_plate(plate, rig.mesh, frequency_max=highest / FREQUENCY_MARGIN)
    places = lattice(np.linspace(0, plate.length, nodes[0]), np.linspace(0, plate.width, nodes[1]))
    order = np.argsort(free.modes.eigenvalues)
    return {
        "nodes": np.column_stack([places, np.zeros(len(places))]),
        "frequencies": np.sqrt(free.modes.eigenvalues[order].clip(0)) / (2 * np.pi),
        "shapes": free.modes.shapes_at(places)[:, order].T,
    }


if __name__ == "__main__":
    main()
