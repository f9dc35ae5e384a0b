"""The same on every processor? Tests and answers with the arithmetic of several of them.

    python tests/programs/kernels.py [--answers] [--workers N]

OpenBLAS has kernels of its own for each kind of processor, which round in different ways, and so do
our compiled ones of 4, 8 and 16 lanes. First a fixed set of questions is answered with all of them,
each in a process of its own: frequencies must be the same, contrasts within 1e-3 dB. Then the tests
of the model, the typed pages and the demonstration run as on each kind of processor (--answers:
not). What this processor lacks is printed as not run. Status 1 if anything differs or fails.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ctypes import CDLL, c_char_p
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from build_libraries import kernel_library, update
from model.answer.stimulus import Placement
from model.compiled.kernels import processor_features
from model.compiled.versions import versions

ROOT = Path(__file__).parents[2]
TESTS = (
    "tests/model",
    "tests/docs/test_pages.py",
    "tests/examples/test_how_to_pages.py",
    "tests/integration/test_four_amplifiers.py",
)
MAX_CONTRAST = 1e-3
"""Difference of contrast [dB] that rounding may make."""

_SYMBOLS = ("scipy_openblas_get_corename", "scipy_openblas_get_corename64_")

# Run by every Python process at its start: numpy says what the processor has.
_WITHOUT = """
from numpy._core._multiarray_umath import __cpu_features__
__cpu_features__.update(dict.fromkeys({features!r}, False))
"""


@dataclass(frozen=True)
class Processor:
    """A kind of processor: name of its kernels of OpenBLAS, what it needs, lanes of ours."""

    blas: str
    features: frozenset[str]
    lanes: int

    def __str__(self) -> str:
        return f"{self.blas} with {self.lanes} lanes"


BLAS = {
    "Nehalem": frozenset[str](),
    "Sandybridge": frozenset({"AVX"}),
    "Haswell": frozenset({"AVX2", "FMA3"}),
    "SkylakeX": frozenset({"AVX512F", "AVX512DQ", "AVX512VL", "AVX2", "FMA3"}),
}
LANES = {version.lanes: frozenset(version.features) for version in versions()}
EVERY = [
    Processor(blas, needs | LANES[lanes], lanes)
    for blas, needs in BLAS.items()
    for lanes in sorted(LANES)
]
KINDS = [
    Processor(blas, needs, max(lanes for lanes, features in LANES.items() if features <= needs))
    for blas, needs in BLAS.items()
]
"""As they are built: kernels of OpenBLAS, and the most lanes that go with them."""


Answers = list[tuple[list[float], float | None]]
"""Of each question the frequencies [Hz] that play, and the contrast [dB] beside quiet fingers."""


def answers() -> Answers:
    """Answers to the fixed questions: one target, none to five quiet fingers, both drive modes."""
    from kit.plates import contact_sets, smooth_table
    from kit.set_table import only

    results = []
    for quiet in (0, 1, 2, 3, 5):
        for target, *quiet_fingers in contact_sets(12, fingers=max(2, 1 + quiet), seed=quiet):
            for drive_mode in ("phased", "switched"):
                placed = Placement((target,), tuple(quiet_fingers[:quiet]))
                layer, felt = only(smooth_table(), placed, 10.0, drive_mode=drive_mode)
                tones = sorted({tone.frequency for tone in layer.excitation.values()})
                results.append((tones, felt.promised_contrast_db))
    return results


def blas_in_use() -> set[str]:
    """Names of the kernels that the loaded libraries of OpenBLAS say they use."""
    import scipy.linalg  # noqa: F401 - which loads its own beside numpy's

    mapped = Path("/proc/self/maps").read_text("utf-8").splitlines()
    kernels_in_use = set()
    for path in {line.split()[-1] for line in mapped if "openblas" in line}:
        library = CDLL(path)
        (symbol,) = (name for name in _SYMBOLS if hasattr(library, name))
        name_of = library[symbol]
        name_of.restype = c_char_p
        kernels_in_use.add(name_of().decode().lower())
    return kernels_in_use


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


@contextmanager
def environment_of(processor: Processor) -> Iterator[dict[str, str]]:
    """Environment in which Python computes as on a processor."""
    faster = {name for features in LANES.values() for name in features} - LANES[processor.lanes]
    with tempfile.TemporaryDirectory() as folder:
        text = _WITHOUT.format(features=sorted(faster))
        (Path(folder) / "sitecustomize.py").write_text(text, "utf-8")
        yield {
            **os.environ,
            "OPENBLAS_CORETYPE": processor.blas,
            "OPENBLAS_NUM_THREADS": "1",
            "PYTHONPATH": folder,
        }


def answer_here(expected: str) -> None:
    """Print the answers of this process, if it computes as it should."""
    from model.compiled.kernels import kernels

    loaded = kernels()
    blas, lanes = expected.split(":")
    if blas_in_use() != {blas.lower()} or loaded is None or loaded.lanes != int(lanes):
        raise SystemExit(f"expected {expected}, got {blas_in_use()} and {loaded}")
    json.dump(answers(), sys.stdout)


def compare(processors: Sequence[Processor]) -> bool:
    """Print how answers differ from those of the first processor; whether they may."""
    first: Answers = []
    is_same = True
    for processor in processors:
        with environment_of(processor) as environment:
            command = [sys.executable, __file__, "--here", f"{processor.blas}:{processor.lanes}"]
            done = subprocess.run(command, env=environment, check=True, stdout=subprocess.PIPE)
        results = json.loads(done.stdout)
        first = first or results
        pairs = list(zip(first, results, strict=True))
        turned = [
            number
            for number, (expected, computed) in enumerate(pairs)
            if expected[0] != computed[0]
        ]
        contrasts = [
            abs(expected[1] - computed[1])
            for expected, computed in pairs
            if None not in (expected[1], computed[1])
        ]
        is_same &= not turned and max(contrasts) < MAX_CONTRAST
        _say(
            f"{processor}: {len(results)} answers, {len(turned)} other frequencies {turned or ''}, "
            f"contrast differs by {max(contrasts):.1e} dB at most"
        )
    return is_same


def passes(processor: Processor, workers: int) -> bool:
    """Run the tests as on a processor; print how long that took; whether they pass."""
    start = time.monotonic()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    # Tests in real time prove nothing about arithmetic.
    command += ["-m", "not long and not real_time"]
    command += ["--numprocesses", str(workers), "--dist", "loadfile", *TESTS]
    with environment_of(processor) as environment:
        done = subprocess.run(command, env=environment, cwd=ROOT, check=False)
    verdict = "failed" if done.returncode else "passed"
    _say(f"{processor}: {verdict} in {(time.monotonic() - start) / 60:.1f} min")
    return done.returncode == 0


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--answers", action="store_true", help="compare answers only")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--here", metavar="BLAS:LANES", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        answer_here(options.here)
        return 0
    update(kernel_library(version) for version in versions())
    has = processor_features()
    for processor in EVERY:
        if lacks := sorted(processor.features - has):
            _say(f"{processor}: not run, this processor lacks {', '.join(lacks)}")
    is_good = compare([processor for processor in EVERY if processor.features <= has])
    for processor in KINDS if not options.answers else ():
        if processor.features <= has:
            is_good &= passes(processor, options.workers)
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
