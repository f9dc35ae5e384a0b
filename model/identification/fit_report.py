"""The report of a fit, the same whatever was fitted to: values, uncertainty, held-out check."""

from collections.abc import Sequence

from model.quantities import percent
from model.rig.uncertainty import Uncertainty


def value_rows(changes: Sequence[tuple[str, str, str]]) -> list[str]:
    """Table of values: name, before, and after with its standard error, as texts with units."""
    width = max((len(name) for name, _, _ in changes), default=0)
    return [f"{name:{width}}  {before} -> {after}" for name, before, after in changes]


def quality_rows(
    uncertainty: Uncertainty, *, held_out: str = "", error: float | None = None, beside: str
) -> list[str]:
    """Lines of the uncertainty that the new rig states, and of the prediction of what was left out.

    held_out: what was; error: of its prediction, relative to the response, None where too little
    was measured to leave any out; beside: what else is known of the fit's errors.
    """
    found = (
        f"{held_out} predicted within {percent(error)} of the response"
        if error is not None
        else "too few sensors to leave any out"
    )
    return [f"uncertainty in the new rig: {uncertainty}", f"held out: {found}; {beside}"]
