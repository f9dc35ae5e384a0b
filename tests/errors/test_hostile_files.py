"""Every reader of files from outside, fed the same hostile files."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from cases import shortly
from kit.outside_files import READERS, SAMPLES, write_sample
from processes.error_cases import INTERNALS
from tests.errors.hostile_files import MIB, VARIANTS, HostileReading, Report

MAX_MEMORY = 64 * MIB
"""Memory of a reader above the size of the file [bytes]."""

MAX_SECONDS = 5.0
"""Processor time for a hostile file of 8 MiB [s]."""

_IN_UTF_16 = {"UTF-16"}
_BETWEEN_DATASETS = {"UTF-16", "surrogates as UTF-8"}

READ: dict[str, set[str]] = {
    # Strengths have no file until they are set.
    "strengths.json": {"missing", "UTF-16", "UTF-32"},
    "measured.csv": {"UTF-16", "cut in half"},
    "measured.uff": {*_BETWEEN_DATASETS, "zero bytes inside"},  # in a description
    "modes.uff": _BETWEEN_DATASETS,
    **dict.fromkeys(("places.csv", "sensors.csv", "moved.csv", "modes.csv"), _IN_UTF_16),
}
"""The variants that the reader of a file can read."""


READ_BY_LINES = {"token.txt", "questions.jsonl"}
"""Files of any size, of which no more than a first wrong line is read."""

SHORT = (
    "daemon.yaml",
    "polygons.yaml",
    "tap.ahap",
    "measured.csv",
    "modes.npz",
    "modes.uff",
    "table.npz",
    "questions.jsonl",
)
"""Files of each format that `make test` takes."""


@pytest.fixture(scope="module")
def hostile() -> Iterator[HostileReading]:
    """A process in which all readers are loaded."""
    with HostileReading() as reading:
        yield reading


@pytest.mark.parametrize("name", READERS)
def test_reader_reads_a_valid_file(name: str, tmp_path: Path) -> None:
    """Hostile files are made of valid ones, so that only their harm is refused."""
    READERS[name](write_sample(tmp_path, name))


@pytest.mark.parametrize("name", shortly(READERS, SHORT))
def test_reader_refuses_hostile_files_within_bounds(
    name: str, hostile: HostileReading, tmp_path: Path
) -> None:
    """One message that names the file, within 64 MiB above its size and in time; no bug."""
    reports = [*hostile.reports(name, tmp_path)]
    assert len(reports) > 0.8 * len(VARIANTS)
    variants = {report.variant for report in reports if report.outcome == "read"}
    assert variants == READ.get(name, set())
    faults = {report.variant: _fault_of(report, name) for report in reports}
    assert {variant: fault for variant, fault in faults.items() if fault} == {}


def _fault_of(report: Report, name: str) -> str:
    """The fault of a report, or an empty text."""
    if report.outcome == "bug":
        return report.text
    if report.memory - report.size > MAX_MEMORY:
        return f"{report.memory / MIB:.0f} MiB for a file of {report.size / MIB:.0f} MiB"
    if report.seconds > MAX_SECONDS:
        return f"{report.seconds:.1f} s"
    if report.outcome == "read":
        return ""
    return _fault_of_message(report, name)


def _fault_of_message(report: Report, name: str) -> str:
    message = report.text
    first, *further = message.splitlines()
    if name == "questions.jsonl" and first.startswith("{"):
        return "" if '"line": ' in message else message  # the error of a line
    if name not in first:
        return f"does not name the file: {message}"
    if further and not first.endswith(":"):  # problems of a file, or of one that it names, follow
        return f"more than one message: {message}"
    if INTERNALS.search(message) or not first.isprintable():
        return f"words of Python, or control characters: {message}"
    if report.variant.startswith("sparse") and "must be up to" not in message:
        return "" if name in READ_BY_LINES else f"reads on: {message}"
    return ""


def test_every_reader_has_a_valid_file() -> None:
    """A reader without one would not be tested."""
    assert SAMPLES.keys() == READERS.keys()
