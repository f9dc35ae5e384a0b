"""`era study`: layouts, numbers and stiffnesses of ERAs compared."""

import json
import time
from enum import StrEnum
from typing import Annotated, Any

import typer

from model.commands.next_line import next_line
from model.commands.options import (
    ClusterOption,
    ContactsOption,
    FolderOption,
    JsonOption,
    LowestOption,
    MeshOption,
    RigArgument,
    cluster_at,
)
from model.counting import counted

study_app = typer.Typer()


class Study(StrEnum):
    """Quantity that is varied."""

    PLACEMENT = "placement"
    COUNT = "count"
    STIFFNESS = "stiffness"


class Driven(StrEnum):
    """Number of active ERAs."""

    ONE = "1"
    TWO = "2"
    ALL = "all"


@study_app.command()
def study(
    what: Annotated[
        Study,
        typer.Argument(
            help=(
                "Vary places of the rig's ERAs; their number, from one to six or the rig's own if "
                "it has more; their stiffness."
            ),
            metavar="WHAT",
        ),
    ],
    rig_file: RigArgument,
    output: FolderOption,
    layouts: Annotated[int, typer.Option(min=1, help="Number of layouts.")] = 200,
    active: Annotated[
        Driven, typer.Option(help="Loudness of the best single ERA, the best pair, or all ERAs.")
    ] = Driven.TWO,
    frequencies: Annotated[
        str,
        typer.Option(
            metavar="LO:HI:STEP", help="Frequencies of loudness in Hz, both ends included."
        ),
    ] = "60:320:10",
    contacts: ContactsOption = None,
    lowest: LowestOption = 20.0,
    finalists: Annotated[
        int, typer.Option(min=1, max=1000, help="Layouts judged by their tables' answers.")
    ] = 5,
    candidates: Annotated[
        str, typer.Option(metavar="NXxNY", help="Candidate places, edges included.")
    ] = "13x13",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random layouts.")] = 0,
    workers: Annotated[
        int | None, typer.Option(min=1, max=256, help="Local processes, at most; default: 1.")
    ] = None,
    cluster: ClusterOption = None,
    mesh: MeshOption = None,
    as_json: JsonOption = False,
) -> None:
    """Rank layouts of ERAs by robust felt contrast.

    Resume an interrupted study.
    """
    from model.commands.progress import progress_bar
    from model.config.document import read_document
    from model.config.points import parse_frequencies, parse_pair
    from model.design.contacts import contact_rule
    from model.rig.file import rig_of
    from model.studies.finalists import judge_finalists
    from model.studies.finished import FinishedCases
    from model.studies.kinds import STUDIES
    from model.studies.outcome import ranking_summary, write_outcome
    from model.studies.ranking import score_order
    from model.studies.run import run_study
    from model.studies.solve import DRIVES, study_problem
    from model.studies.supported import check_supported_cases, support_of
    from model.studies.workers import on_cluster, on_processes, useful_processes

    machines = cluster_at(cluster, workers=workers)
    document = read_document(rig_file)
    rig = rig_of(document, mesh=mesh)
    started = time.perf_counter()
    cases = STUDIES[what](
        rig, layouts=layouts, seed=seed, raster=parse_pair(candidates, what="--candidates")
    )
    check_supported_cases(support_of(rig, cases, lowest=lowest))
    rule = contact_rule(contacts, rig.plate)
    problem = study_problem(
        rig, cases, parse_frequencies(frequencies), contacts=rule, lowest=lowest
    )
    output.mkdir(parents=True, exist_ok=True)
    finished = FinishedCases(output, problem.digest)
    done = 0
    with progress_bar("layouts") as update:

        def advance(count: int) -> None:
            nonlocal done
            done += count
            update(done, len(cases))

        try:
            run = run_study(
                problem,
                cases,
                workers=(
                    on_processes(useful_processes(problem, cases, workers or 1))
                    if machines is None
                    else on_cluster(machines)
                ),
                finished=finished,
                progress=advance,
            )
        except KeyboardInterrupt:
            typer.echo(
                f"era: interrupted; finished cases are in {finished.path}; run the same command "
                "to resume",
                err=True,
            )
            raise
    scored = score_order(rig, cases, run.results, drive=DRIVES.index(active), lowest=lowest)
    with progress_bar("finalists") as update:
        ranking = judge_finalists(
            rig,
            scored,
            contacts=rule,
            finalists=finalists,
            workers=workers or 1,
            cluster=machines,
            progress=update,
        )
    files = [
        str(path) for path in write_outcome(output, what, rig, data=document.data, ranking=ranking)
    ]
    elapsed = time.perf_counter() - started
    summary = {
        "study": what.value,
        "cases": len(cases),
        "solved": run.solved_count,
        "from_cache": run.cached_count,
        "drive_frequencies_hz": problem.frequencies.tolist(),
        "points": len(problem.points),
        "mesh_name": str(rig.mesh),
        **ranking_summary(rig, ranking),
        "time_s": elapsed,
        "files": files,
    }
    if as_json:
        print(json.dumps(summary))
        return
    _show(summary)
    print("wrote")
    for name in files:
        print(f"  {name}")
    print(next_line("era", "table", "build", files[0], "-o", output / "recommended.npz"))


def _show(summary: dict[str, Any]) -> None:
    """Print the head of the ranking, the present rig, and the recommendation."""
    from model.vibration.peak import G

    print(
        f"{counted(summary['cases'], 'case')} in {summary['time_s']:.1f} s "
        f"({summary['from_cache']} from an earlier run), mesh {summary['mesh_name']}"
    )
    print(f"not supported: {summary['tipping']} tip over, {summary['too_low']} have too low a mode")
    recommended = summary["recommended"]
    kinds = [key for key in recommended["contrast_db"] if key != "mean"]
    quiet = " / ".join(key.split("_")[1] for key in kinds)
    print(
        f"ranked by robust felt contrast, mean over {quiet} quiet fingers: "
        f"{summary['judged']} finalists by answers to {summary['sets']} contact sets, others as "
        "expected"
    )
    print(f"loudness: median over the plate, {summary['driven']} driven")
    print("rank  layout                        stiffness  contrast  expected  loudness   unfelt")
    for case in summary["ranking"]:
        stiffness = max(case["stiffness_n_m"].values()) / 1000
        contrast = case["contrast_db"] and case["contrast_db"]["mean"]
        loudness = case["median_m_s2"] and case["median_m_s2"] / G
        unfelt = case["unfelt_share"] and 100 * case["unfelt_share"]
        print(
            f"{case['rank']:4d}  {case['layout']:28s} {stiffness:6.4g} kN/m "
            f"{_cell(contrast, 'dB', 1)}  {_cell(case['expected_contrast_db'], 'dB', 1)}  "
            f"{_cell(loudness, 'g', 1)}  {_cell(unfelt, '%', 2)}"
            f"{'' if case['supported'] else '  ' + case['support_problem']}"
        )
    why = "" if recommended["rank"] == 1 else ", fewest and softest within 1 dB of the best"
    medians = " / ".join(f"{recommended['contrast_db'][key]:.1f}" for key in kinds)
    print(
        f"Recommended{why}: {recommended['words']} Contrast: mean "
        f"{recommended['contrast_db']['mean']:.1f} dB, median {medians} dB with {quiet} quiet "
        f"fingers; level reached in {100 * recommended['reached_share']:.0f} % of the sets."
    )


def _cell(value: float | None, unit: str, digits: int) -> str:
    """A number with its unit, right-aligned; a dash for none."""
    return f"{'-' if value is None else f'{value:.{digits}f} {unit}':>8s}"
