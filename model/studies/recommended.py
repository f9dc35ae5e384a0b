"""The recommended case of a study in words, and as a rig file."""

from collections.abc import Mapping
from copy import deepcopy

from model.config.document import Value
from model.config.editing import data_text
from model.rig.rig import Rig
from model.structure.plate import Plate
from model.studies.ranking import Ranking


def in_words(rig: Rig, ranking: Ranking, case: int) -> str:
    """One case in words: places and stiffness of the ERAs."""
    eras = ranking.cases.eras_of(case, rig.eras)
    places = "; ".join(f"{era.name} {place_in_words(era.x, era.y, rig.plate)}" for era in eras)
    stiffness = sorted({era.stiffness for era in eras})
    of_stiffness = " and ".join(f"{value / 1000:.4g}" for value in stiffness)
    count = "one ERA" if len(eras) == 1 else f"{len(eras)} ERAs"
    return f"{count} of {of_stiffness} kN/m: {places}."


def place_in_words(x: float, y: float, plate: Plate) -> str:
    """A place [m] in words: `at the corner (0, 0)`, `on the edge y = 0, 30 % along`."""
    along, across = x / plate.length, y / plate.width
    at_x_end, at_y_end = (min(share, 1 - share) < 1e-6 for share in (along, across))
    millimetres = f"({1000 * x:.0f}, {1000 * y:.0f}) mm"
    if at_x_end and at_y_end:
        return f"at the corner {millimetres}"
    if at_y_end:
        return f"on the edge y = {1000 * y:.0f} mm, {100 * along:.0f} % along, {millimetres}"
    if at_x_end:
        return f"on the edge x = {1000 * x:.0f} mm, {100 * across:.0f} % up, {millimetres}"
    return f"inside, {100 * along:.0f} % along and {100 * across:.0f} % up, {millimetres}"


def rig_yaml(data: Mapping[str, Value], rig: Rig, ranking: Ranking, case: int) -> str:
    """The text of the studied rig file (its data) with the ERAs of one case.

    ERAs keep the wiring of the rig's; further ones get the next channels of its first amplifier.
    ERAs without an amplifier stay.
    """
    wiring = list(rig.wiring.values())
    first = wiring[0].amplifier
    free = 1 + max(channel.number for channel in wiring if channel.amplifier == first)
    before = data["eras"]
    assert isinstance(before, dict)  # noqa: S101 - the rig was read from this data
    eras: dict[str, Value] = {name: before[name] for name in rig.supports}
    for number, era in enumerate(ranking.cases.eras_of(case, rig.eras)):
        # A renamed ERA has the other keys of the first driven one, copied: no aliases in a file.
        section = deepcopy(before.get(era.name, before[rig.eras[0].name]))
        assert isinstance(section, dict)  # noqa: S101
        channel = wiring[number] if number < len(wiring) else None
        eras[era.name] = {
            **{key: value for key, value in section.items() if key != "damping_ratio"},
            "at": [era.x, era.y],
            "stiffness": era.stiffness,
            "damping": era.damping,
            "amplifier": channel.amplifier if channel else first,
            "channel": channel.number if channel else free + number - len(wiring),
        }
    comment = f"# Recommended by a study. {in_words(rig, ranking, case)}\n"
    return comment + data_text({**data, "eras": eras})
