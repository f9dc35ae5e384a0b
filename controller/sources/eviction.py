"""Which contact gives way where a plate has as many as it can, so that no sender takes all."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence


def to_evict(sources: Sequence[str], newcomer: str, origins: Mapping[str, str]) -> int | None:
    """Return which contact to lift for one of a newcomer's source, by number; None for none.

    sources: of all contacts in order of arrival; origins: by source. The newest contact of the
    input, then the origin, then the source with most contacts, if it has at least two more than the
    newcomer's.
    """
    groupings: tuple[Callable[[str], str], ...] = (_input_of, origins.__getitem__, str)
    left: list[int] = [*range(len(sources))]
    for depth, group_of in enumerate(groupings):
        counts = Counter(group_of(sources[each]) for each in left)
        own = group_of(newcomer)
        if max(counts.values(), default=0) > counts[own] + 1:
            for deeper in groupings[depth:]:
                ((fullest, _),) = Counter(deeper(sources[each]) for each in left).most_common(1)
                left = [each for each in left if deeper(sources[each]) == fullest]
            return left[-1]
        left = [each for each in left if group_of(sources[each]) == own]
    return None


def _input_of(source: str) -> str:
    """Return the input of a source, the beginning of its name; without one its kind."""
    return source.partition(":")[0]
