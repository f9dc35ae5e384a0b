"""What a running daemon can take over from a changed configuration, and what it cannot."""

from dataclasses import dataclass

from controller.daemon.config import DaemonConfig

RESTART = ("touch_wait", "socket", "log.file", "metrics", "dashboard")
"""Keys that hold from the start to the end of a daemon."""

BASIS = ("rig", "table", "mode", "serial_numbers")
"""Keys on which all others depend: where one of them changes, nothing is taken over."""


@dataclass(frozen=True)
class ReloadPlan:
    """apply: keys to take over now; restart: keys that have changed but wait for a restart.

    refused: why nothing is taken over at all, or None.
    """

    apply: tuple[str, ...]
    restart: tuple[str, ...]
    refused: str | None = None


def plan_reload(old: DaemonConfig, new: DaemonConfig, *, is_armed: bool) -> ReloadPlan:
    """What follows from a new configuration that is in order by itself."""
    changed = _changed(old, new)
    basis = tuple(key for key in BASIS if key in changed)
    if basis:
        return ReloadPlan(
            (),
            basis,
            f"{', '.join(basis)} changed, which only a restart can take over; nothing was changed",
        )
    before, after = old.meaning.strongest_db_sl, new.meaning.strongest_db_sl
    if is_armed and after > before:
        return ReloadPlan(
            (),
            (),
            f"the strongest effect would rise from {before:g} to {after:g} dB SL while armed; "
            "nothing was changed: disarm, then reload",
        )
    restart = tuple(key for key in RESTART if key in changed)
    return ReloadPlan(tuple(key for key in changed if key not in restart), restart)


def _changed(old: DaemonConfig, new: DaemonConfig) -> list[str]:
    """Keys whose meaning is another."""
    differs = {
        "rig": (old.rig_text, old.urls) != (new.rig_text, new.urls),
        "table": old.table != new.table,
        "mode": old.section.mode != new.section.mode,
        "serial_numbers": old.section.serial_numbers != new.section.serial_numbers,
        "touch_wait": old.section.touch_wait != new.section.touch_wait,
        "layout": old.meaning != new.meaning,
        "touch": old.touch != new.touch,
        "longest_lease": old.section.longest_lease != new.section.longest_lease,
        "log.level": old.section.log.level != new.section.log.level,
        "log.file": old.log_file != new.log_file,
        "dumps": (old.dump_folder, old.section.dumps) != (new.dump_folder, new.section.dumps),
        "socket": old.socket != new.socket,
        "metrics": old.section.metrics != new.section.metrics,
        "dashboard": old.section.dashboard != new.section.dashboard,
    }
    return [key for key, is_other in differs.items() if is_other]
