"""The table of docs/how-to/measure-your-plate.md: every kind of finding and its criterion."""

from model.estimate.finding_kinds import FINDING_KINDS


def finding_kinds() -> str:
    """Return a row for each kind with its name, subject and criterion."""
    rows = [f"| {name} | {kind.about} | {kind.criterion} |" for name, kind in FINDING_KINDS.items()]
    return "\n".join(["| finding | about | reported if |", "|---|---|---|", *rows])
