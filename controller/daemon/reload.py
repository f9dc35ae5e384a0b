"""A configuration that is read again while its daemon runs: what has changed, and may be applied.

Nothing here runs in the event loop, as large layouts take a while to compare.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

from controller.daemon.children import read_in_child
from controller.daemon.config import DaemonConfig
from controller.effects.layout import SurfaceLayout
from model.arrays import FloatArray
from registry.threads import without_collections

_logger = logging.getLogger(__name__)

_APPLIED = ("layouts", "level_db_sl")  # keys that a running daemon can apply


@dataclass(frozen=True)
class ConfigChange:
    """A configuration, and how it differs from the one in use.

    restart: changed keys that need a restart; changes: all others, in words; layouts: names of
    those that differ, None for what every touch feels without any; old_max_db_sl, max_db_sl: the
    highest level of all layouts before and after [dB SL].
    """

    config: DaemonConfig
    restart: list[str]
    changes: list[str]
    layouts: frozenset[str | None]
    old_max_db_sl: float
    max_db_sl: float

    def refusals(self, *, is_armed: bool) -> list[str]:
        """Why nothing of it may be applied; empty if all may."""
        reasons = [f"{key}: changed, which needs a restart" for key in self.restart]
        if is_armed and self.max_db_sl > self.old_max_db_sl:
            reasons.append(
                f"maximum level must not increase while armed, got {self.max_db_sl:g} dB SL (was "
                f"{self.old_max_db_sl:g}); disarm, then reload"
            )
        return reasons


def read_again(old: DaemonConfig, frequencies: FloatArray) -> ConfigChange:
    """Read a daemon's configuration again for a table's frequencies [Hz]; blocks.

    Raises as `read_in_child`.
    """
    with without_collections():  # of large layouts
        change = config_change(old, read_in_child(old.source, frequencies))
        warn_of_bands(
            {name: change.config.layouts.get(name) for name in change.layouts}, frequencies
        )
        return change


def warn_of_bands(
    layouts: Mapping[str | None, SurfaceLayout | None], frequencies: FloatArray
) -> None:
    """Log what layouts play in place of bands that a table of frequencies [Hz] lacks."""
    for name, layout in layouts.items():
        for problem in layout.band_problems(frequencies) if layout else ():
            _logger.warning("layout %s: %s", name, problem)


def config_change(old: DaemonConfig, new: DaemonConfig) -> ConfigChange:
    """Compare all keys and layouts, and the content of the rig's file."""
    before, after = old.section.model_dump(), new.section.model_dump()
    restart = [key for key in before if before[key] != after[key] and key not in _APPLIED]
    if old.rig_text != new.rig_text and "rig" not in restart:
        restart.append("rig")
    was, now = old.layouts, new.layouts
    differ = [name for name in {**was, **now} if was.get(name) != now.get(name)]
    changes = [
        f"layouts.{name}: {'added' if name not in was else 'changed' if name in now else 'removed'}"
        for name in differ
        if name is not None
    ]
    if before["level_db_sl"] != after["level_db_sl"]:
        changes.append(f"level_db_sl: from {before['level_db_sl']:g} to {after['level_db_sl']:g}")
    kept = {name: now[name] if name in differ else was[name] for name in now}
    highest = [max(each.max_db_sl for each in layouts.values()) for layouts in (was, now)]
    new = replace(new, layouts=kept)
    return ConfigChange(new, restart, changes, frozenset(differ), *highest)
