"""`era study`: layouts, numbers and stiffnesses of ERAs compared."""

import json
import time
from enum import StrEnum
from typing import Annotated, Any

import typer

from model.commands.next_line import next_line
from model.commands.options import FolderOption, JsonOption, MeshOption, RigArgument
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
            help="Vary places of the rig's ERAs; their number, one to six; their stiffness.",
            metavar="WHAT",
        ),
    ],
    rig_file: RigArgument,
    output: FolderOption,
    layouts: Annotated[int, typer.Option(min=1, help="Number of layouts.")] = 200,
    active: Annotated[
        Driven, typer.Option(help="Rank by the best single ERA, the best pair, or all ERAs.")
    ] = Driven.TWO,
    frequencies: Annotated[
        str, typer.Option(metavar="LO:HI:STEP", help="Frequencies in Hz, both ends included.")
    ] = "60:320:10",
    candidates: Annotated[
        str, typer.Option(metavar="NXxNY", help="Candidate places, edges included.")
    ] = "13x13",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the random layouts.")] = 0,
    workers: Annotated[int, typer.Option(min=1, max=256, help="Local processes, at most.")] = 1,
    cluster: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="Dask scheduler."),
    ] = None,
    mesh: MeshOption = None,
    as_json: JsonOption = False,
) -> None:
    """Rank layouts of ERAs by vibration.

    Resume an interrupted study.
    """
    from model.commands.progress import progress_bar
    from model.config.document import read_document
    from model.config.points import parse_frequencies, parse_pair
    from model.errors import InputError
    from model.rig.file import rig_of
    from model.studies.finished import FinishedCases
    from model.studies.kinds import STUDIES
    from model.studies.outcome import ranking_summary, write_outcome
    from model.studies.ranking import check_supported_cases, rank
    from model.studies.run import run_study
    from model.studies.solve import DRIVES, study_problem
    from model.studies.workers import on_cluster, on_processes, useful_processes

    document = read_document(rig_file)
    rig = rig_of(document, mesh=mesh)
    if cluster is not None and workers != 1:
        raise InputError("only one of --workers and --cluster can be given")
    started = time.perf_counter()
    cases = STUDIES[what](
        rig, layouts=layouts, seed=seed, raster=parse_pair(candidates, what="--candidates")
    )
    check_supported_cases(rig, cases)
    problem = study_problem(rig, cases, parse_frequencies(frequencies))
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
                    on_processes(useful_processes(problem, cases, workers))
                    if cluster is None
                    else on_cluster(cluster)
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
    ranking = rank(rig, cases, run.results, drive=DRIVES.index(active))
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
        f"({summary['from_cache']} from an earlier run), mesh {summary['mesh_name']}, "
        f"{counted(len(summary['drive_frequencies_hz']), 'frequency', plural='frequencies')}"
    )
    print(f"ranked by the median over the plate, {summary['driven']} driven")
    print("rank  layout                        stiffness   lowest   median  highest    unfelt")
    for case in summary["ranking"]:
        lowest, median, highest = (
            case[f"{name}_m_s2"] / G for name in ("minimum", "median", "maximum")
        )
        stiffness = max(case["stiffness_n_m"].values()) / 1000
        print(
            f"{case['rank']:4d}  {case['layout']:28s} {stiffness:6.4g} kN/m {lowest:6.1f} g "
            f"{median:6.1f} g {highest:6.1f} g {100 * case['unfelt_share']:7.2f} %"
            f"{'' if case['supported'] else '  not supported'}"
        )
    recommended = summary["recommended"]
    why = "" if recommended["rank"] == 1 else ", fewest and softest within a tenth of the best"
    print(f"Recommended{why}: {recommended['words']}")
