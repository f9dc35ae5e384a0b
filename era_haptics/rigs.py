"""Plates, ERAs and exciters by the keys of a rig file."""

from typing import Any

from model.rig.actuator_keys import EraSection, ExciterSection
from model.rig.rig_writing import checked_keys
from model.rig.sections import PlateSection


class Plate(dict[str, Any]):
    """A plate by the keys of `plate` in a rig file.

    `Plate(length="12 in", width="9 in", thickness=0.0015, material="aluminium")`. Raises
    ConfigError, an InputError, with all problems.
    """

    def __init__(self, **keys: Any) -> None:
        super().__init__(checked_keys("era.Plate", PlateSection, keys))


class Era(dict[str, Any]):
    """An ERA by the keys below `eras` in a rig file.

    `Era(at=(0, 0), stiffness="17 kN/m", amplifier="main", channel=0)`. Raises ConfigError.
    """

    def __init__(self, **keys: Any) -> None:
        super().__init__(checked_keys("era.Era", EraSection, keys))


class Exciter(dict[str, Any]):
    """An exciter by the keys below `eras` in a rig file, of which `kind` is stated already.

    `Exciter(type="DAEX25CT-4", at=(0.1, 0.1), amplifier="card", channel=0)`. Raises ConfigError.
    """

    def __init__(self, **keys: Any) -> None:
        keys = {"kind": "exciter", **keys}
        super().__init__(checked_keys("era.Exciter", ExciterSection, keys))
