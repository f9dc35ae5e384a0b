"""Changes of the configuration that a running daemon can apply."""

from collections.abc import Sequence
from dataclasses import dataclass

from controller.daemon.config import DaemonConfig

DEFERRED = ("learn", "touch_wait", "socket", "log.file", "metrics", "dashboard")
"""Keys that take effect at the next start."""

BLOCKING = ("rig", "table", "mode", "serial_numbers", "supervised")
"""Keys on which all others depend: a change of any blocks the reload."""


@dataclass(frozen=True)
class ReloadPlan:
    """Outcome of comparing two configurations.

    apply: keys to apply now; restart: changed keys that need a restart.

    refused: why nothing is applied at all, or None.
    """

    apply: tuple[str, ...]
    restart: tuple[str, ...]
    refused: str | None = None


def plan_reload(
    old: DaemonConfig, new: DaemonConfig, changed: Sequence[str], *, is_armed: bool
) -> ReloadPlan:
    """Plan the change from one valid configuration to another with these `changed_keys`."""
    refused = tuple(key for key in BLOCKING if key in changed)
    if refused:
        return ReloadPlan((), refused, f"{', '.join(refused)} changed, which needs a restart")
    before, after = old.effective_layout.max_db_sl, new.effective_layout.max_db_sl
    if is_armed and after > before:
        return ReloadPlan(
            (),
            (),
            f"maximum level must not increase while armed, got {after:g} dB SL (was {before:g}); "
            "disarm, then reload",
        )
    restart = tuple(key for key in DEFERRED if key in changed)
    return ReloadPlan(tuple(key for key in changed if key not in restart), restart)


def changed_keys(old: DaemonConfig, new: DaemonConfig) -> list[str]:
    """Compare all keys, with the files that they name; takes a while."""
    differs = {
        "rig": (old.rig_text, old.urls) != (new.rig_text, new.urls),
        "table": old.table != new.table,
        "learn": old.learn != new.learn,
        "mode": old.section.mode != new.section.mode,
        "serial_numbers": old.section.serial_numbers != new.section.serial_numbers,
        "supervised": old.section.supervised != new.section.supervised,
        "touch_wait": old.section.touch_wait != new.section.touch_wait,
        "layout": old.effective_layout != new.effective_layout,
        "touch": old.touch != new.touch,
        "longest_lease": old.section.longest_lease != new.section.longest_lease,
        "log.level": old.section.log.level != new.section.log.level,
        "log.file": old.log_file != new.log_file,
        "dumps": (old.dump_folder, old.section.dumps) != (new.dump_folder, new.section.dumps),
        "socket": old.socket != new.socket,
        "metrics": old.section.metrics != new.section.metrics,
        "dashboard": old.section.dashboard != new.section.dashboard,
    }
    return [key for key, is_changed in differs.items() if is_changed]
