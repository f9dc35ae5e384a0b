"""The daemon with answers of the table that it remembers: what a set costs beside its answer.

    python -m benchmarks.latency.remembered SECONDS CONFIG

SECONDS as for `benchmarks.latency.daemon`. A question is computed when it is first asked. Fingers
within 0.1 mm ask the same.
"""

import sys
from collections.abc import Sequence
from typing import Any

from benchmarks.latency.daemon import run_daemon
from controller.loop import selection, table_query
from controller.loop.table_query import TableAnswer
from controller.sources.contacts import Contact

_DIGITS = 4  # of a metre


def _remembering_query(
    table: Any, contact: Contact, target: Any, quiet: Sequence[Contact], *others: Any
) -> TableAnswer:
    """Answer as `query_table`, from memory where possible."""
    fingers = tuple((round(each.x, _DIGITS), round(each.y, _DIGITS)) for each in (contact, *quiet))
    if fingers not in _known:
        _known[fingers] = table_query.query_table(table, contact, target, quiet, *others)
    return _known[fingers]


_known: dict[tuple[tuple[float, float], ...], TableAnswer] = {}

if __name__ == "__main__":
    vars(selection)["query_table"] = _remembering_query
    sys.exit(run_daemon())
