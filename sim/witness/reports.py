"""Whether the list of faults that an amplifier reports is what it must be."""

Interval = tuple[float, float]
Faults = tuple[tuple[int, float], ...]
"""Faults, newest first, each with its age [s]."""

_CLOCK = 0.01  # share of an age by which the clock of an amplifier may be wrong
_ROUNDING = 0.002  # s


def fault_list_problem(
    faults: Faults, when: Interval, *, present: int, since: Interval | None
) -> str | None:
    """Describe what is wrong with a list of faults that was read at some time between two [s].

    present: the fault that the amplifier is in, 0 for none; since: when it came, if that is known.
    """
    ages = [age for _, age in faults]
    if ages != sorted(ages):
        return f"lists faults of ages {ages} s, newest first"
    if not present:
        return None
    matching = [age for fault, age in faults if fault == present]
    if not matching:
        return f"is in fault {present}, which its list of faults does not have"
    if since is None:
        return None
    low, high = when[0] - since[1], when[1] - since[0]
    for age in matching:
        error = _ROUNDING + _CLOCK * age
        if low - error <= age <= high + error:
            return None
    return f"fault {present} must be {max(low, 0.0):.3f} to {high:.3f} s old, got {matching} s"
