"""`era measure` with one sensor that is moved: what the terminal says, and the report."""

import sys
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drivers.errors import LinkError
from model.errors import InputError

if TYPE_CHECKING:
    from sim.desk.measuring.desk import Desk
    from sim.desk.measuring.moved_sensor import PlacesFile
    from sim.desk.measuring.multisine import Multisine
    from sim.desk.measuring.sound_card import SoundCard


def measure_by_moving(
    desk: "Desk",
    opened: "AbstractContextManager[tuple[SoundCard, Multisine]]",
    output: Path,
    *,
    periods: int,
    is_resumed: bool,
) -> tuple[list[str], dict[str, Any], bool]:
    """Guide a person through the places of a desk.

    Return the report, and whether all places are measured. Raises InputError, LinkError,
    KeyboardInterrupt, having said what is kept.
    """
    from model.commands.options import Stopwatch
    from sim.desk.measuring.moved_sensor import PlacesFile, measure_places, setting_of
    from sim.desk.measuring.sound_card import DeviceLost

    if output.exists() != is_resumed:
        raise InputError(
            f"{output}: a file must be there to go on from with --resume, got none; leave it out"
            if is_resumed
            else f"{output}: exists; go on with --resume, or choose another name"
        )
    with Stopwatch() as timed, opened as (card, multisine):
        file = PlacesFile(output, desk, multisine.frequencies, setting_of(desk, multisine))
        if is_resumed:
            file.read()
            _tell(_kept(file))
        try:
            found = measure_places(file, card, multisine, periods=periods, ask=_ask, tell=_tell)
        except KeyboardInterrupt:
            card.close()  # silent before anything is said
            _tell(f"\nstopped; {_kept(file)}")
            raise
        except DeviceLost as problem:
            raise LinkError(f"{problem}; check its cable; {_kept(file)}") from problem
    missing = [place.name for place in file.missing]
    answer = {
        "frequencies_hz": file.frequencies.tolist(),
        "places": {"measured": [*found], "missing": missing},
        "sensors": {name: each.quality(0) for name, each in found.items()},
        "measure_time_s": timed.elapsed,
        "files": [str(output)] if file.values else [],
    }
    return [_kept(file)], answer, not missing


def _kept(file: "PlacesFile") -> str:
    count, total = len(file.values), len(file.desk.sensors)
    text = f"{count} of {total} places are measured" + (f", in {file.path}" if count else "")
    return f"{text}; go on with --resume" if 0 < count < total else text


def _ask(text: str) -> str:
    sys.stderr.write(text)
    sys.stderr.flush()
    reply = sys.stdin.readline()
    if not reply:
        sys.stderr.write("\n")
        return "q"
    return reply


def _tell(text: str) -> None:
    sys.stderr.write(f"{text}\n")
