"""Cases of the latency benchmark, and their figures for the page docs/measured/latency.md."""

import platform
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.latency.run import Case, Failed, Found
from benchmarks.latency.touches import Work
from benchmarks.page import write_parts

PAGE = Path(__file__).parents[2] / "docs" / "measured" / "latency.md"
TARGETS = (2.0, 5.0, 10.0)  # ms: median, 99th percentile, 99.9th

FAST, CALM = 1000.0, 100.0  # Hz
DEFAULT_SECONDS = 100.0  # a hundred thousand touches
SHORTER = 5  # ratio of the first case's duration to that of most others
MAX_OTHERS = 0.25  # processors busy with other work; more is reported as a disturbance

HEAD = (
    "| case | touches | commands | unmatched | median | 99th | 99.9th | maximum | jitter | "
    "oldest touch: median | 99th | 99.9th | daemon: median | 99th | 99.9th | CPU | "
    "other load |\n"
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|"
)

HEAD_CELLS = HEAD.split("\n")[1].count("---")


def cases(seconds: float, seed: int) -> list[Case]:
    """All cases, that of the targets first, for some seconds, most others for a fifth of them."""
    shorter = seconds / SHORTER
    fast = Work("taps", _count(seconds, FAST), FAST, seed)
    some = Work("taps", _count(shorter, FAST), FAST, seed)
    slide = Work("slide", _count(shorter, FAST), FAST, seed)
    calm = Work("taps", _count(shorter, CALM), CALM, seed)
    return [
        Case("taps, loaded", fast, True, 0.0),
        Case("plain asyncio, loaded", fast, True, None),
        Case("taps", some, False, 0.0),
        Case("plain asyncio", some, False, None),
        Case("slide, loaded", slide, True, 0.0),
        Case("taps at 100 Hz, loaded", calm, True, 0.0),
        Case("taps at 100 Hz", calm, False, 0.0),
        Case("plain asyncio at 100 Hz", calm, False, None),
    ]


def check_case(wire: str, seconds: float, seed: int) -> Case:
    """The case for tests."""
    work = Work("taps", _count(seconds, CALM), CALM, seed)
    return Case("taps at 100 Hz", work, False, 0.0, wire=wire)


def _count(seconds: float, rate: float) -> int:
    return max(1, round(seconds * rate))


def as_json(found: Found) -> dict[str, object]:
    """Times of all commands [ms], and those that the daemon reports."""
    matched = found.matched
    return {
        "sent": found.sent,
        "unmatched": matched.unmatched,
        "touch": matched.touch.tolist(),
        "newest_ms": (1e3 * matched.newest).tolist(),
        "oldest_ms": (1e3 * matched.oldest).tolist(),
        "own": None if found.own is None else found.own.model_dump(),
    }


def lines(found: Sequence[Found | Failed], *, first: bool) -> str:
    """Rows of the table; first: with its head."""
    return "\n".join([*([HEAD] if first else []), *map(_row, found)])


def write_report(
    found: Sequence[Found | Failed], *, seconds: float, seed: int, minutes: float
) -> None:
    """Write the figures into their page; minutes: of the run."""
    part = report(found, seconds=seconds, seed=seed, minutes=minutes)
    write_parts(PAGE, {"figures": part})


def report(found: Sequence[Found | Failed], *, seconds: float, seed: int, minutes: float) -> str:
    """The figures as Markdown."""
    is_default = (seconds, seed) == (DEFAULT_SECONDS, 1)
    options = "" if is_default else f" --seconds {seconds:g} --seed {seed}"
    parts = [
        f"`python -m benchmarks.latency --report{options}` took {minutes:.0f} minutes (Python "
        f"{platform.python_version()}, {platform.system()} {platform.machine()}).",
        lines(found, first=True),
        *filter(None, map(_disturbance, found)),
    ]
    first, second = found[:2]
    if isinstance(first, Found) and isinstance(second, Found):
        parts.append(_verdict(first, second))
    return "\n\n".join(parts)


def _disturbance(one: Found | Failed) -> str | None:
    """What disturbed a case, or None."""
    if isinstance(one, Failed):
        attempts = "; then: ".join(one.why)
        return f"**No figures of *{one.case.name}***: {attempts}."
    if one.others > MAX_OTHERS:
        return (
            f"***{one.case.name}* was disturbed**: other programs kept {one.others:.1f} processors "
            "busy, so its figures are not those of an idle machine."
        )
    return None


def _row(found: Found | Failed) -> str:
    if isinstance(found, Failed):
        return f"| {' | '.join([found.case.name, 'no figures', *[''] * (HEAD_CELLS - 2)])} |"
    matched = found.matched
    cells = [
        found.case.name + ("" if found.is_urgent else " (nice not allowed)"),
        str(found.sent),
        str(len(matched.touch)),
        str(matched.unmatched),
        *_quantiles(matched.newest),
        _ms(matched.newest.max(initial=0.0)),
        _ms(float(np.std(matched.newest)) if len(matched.newest) else 0.0),
        *_quantiles(matched.oldest),
    ]
    own = found.own
    cells += ["", "", ""] if own is None else [_own(own.median), _own(own.p99), _own(own.p999)]
    computing = found.computed / max(1, len(matched.touch))
    return f"| {' | '.join([*cells, _ms(computing), f'{found.others:.2f}'])} |"


def _quantiles(times: np.ndarray) -> list[str]:
    if len(times) == 0:
        return ["", "", ""]
    return [_ms(value) for value in np.quantile(times, [0.5, 0.99, 0.999], method="inverted_cdf")]


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.2f}"


def _own(milliseconds: float | None) -> str:
    return "" if milliseconds is None else f"{milliseconds:.2f}"


def _verdict(daemon: Found, exchange: Found) -> str:
    """Comparison of a case with the targets and with the plain exchange."""
    ours, plain = (
        1e3 * np.quantile(one.matched.newest, [0.5, 0.99, 0.999], method="inverted_cdf")
        for one in (daemon, exchange)
    )
    limits = ", ".join(
        f"{name} {value:.2f} of {limit:g} ms ({'met' if value <= limit else '**missed**'})"
        for name, value, limit in zip(_NAMES, ours, TARGETS, strict=True)
    )
    ratios = ", ".join(
        f"{name} {value:.1f}" for name, value in zip(_NAMES, ours / plain, strict=True)
    )
    more = ours[0] - plain[0]
    return (
        f"Targets, loaded: {limits}. Ratio to the baseline in the same run: {ratios}; the "
        f"table, the guard and the rest take {more:.2f} ms of the median."
    )


_NAMES = ("median", "99th percentile", "99.9th")
