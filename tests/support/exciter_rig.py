"""Boards on exciters: four of them, and foam at the corners."""

from model.rig.rig import Rig
from model.rig.rig_file import parse_rig

ACRYLIC = "{name: acrylic, E: 4.5 GPa, rho: 1190, nu: 0.37}"

_PLACES = {"SW": (0.18, 0.24), "SE": (0.79, 0.17), "NE": (0.84, 0.78), "NW": (0.27, 0.81)}
_LENGTH, _WIDTH = 0.3, 0.23


def exciter_rig_text(
    keys: str = "type: DAEX13-4SM, power: 1 W", *, frequency: str = "[65, 300]", more: str = ""
) -> str:
    """The acrylic board of 300 x 230 x 5 mm on exciters with these keys."""
    exciters = [
        f"  {name}: {{kind: exciter, at: [{x * _LENGTH:g}, {y * _WIDTH:g}], amplifier: card, "
        f"channel: {channel}, {keys}}}"
        for channel, (name, (x, y)) in enumerate(_PLACES.items())
    ]
    feet = [
        f"  foam{number}: {{at: [{x}, {y}], stiffness: 2000, damping: 0.3}}"
        for number, (x, y) in enumerate(
            [(0, 0), (_LENGTH, 0), (_LENGTH, _WIDTH), (0, _WIDTH)], start=1
        )
    ]
    return "\n".join(
        [
            f"plate: {{length: {_LENGTH}, width: {_WIDTH}, thickness: 5 mm, material: {ACRYLIC}, "
            "loss_factor: 0.05}",
            "eras:",
            *exciters,
            *feet,
            'amplifiers: {card: {url: "sim://", full_level: output}}',
            f"limits: {{frequency: {frequency}}}",
            more,
        ]
    )


def exciter_rig(keys: str = "type: DAEX13-4SM, power: 1 W", **more: str) -> Rig:
    """The rig of that text."""
    return parse_rig("board.yaml", exciter_rig_text(keys, **more))
