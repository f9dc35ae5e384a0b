"""What a running daemon can apply of a configuration: its layout."""

from collections.abc import Sequence

from controller.daemon.config import DaemonConfig

_OF_LAYOUT = ("layout", "level_db_sl")


def reload_problem(
    old: DaemonConfig, new: DaemonConfig, changed: Sequence[str], *, is_armed: bool
) -> str | None:
    """Why nothing of a valid configuration with these `changed_keys` can be applied, or None."""
    if changed:
        return f"{', '.join(changed)} changed, which needs a restart"
    before, after = old.effective_layout.max_db_sl, new.effective_layout.max_db_sl
    if is_armed and after > before:
        return (
            f"maximum level must not increase while armed, got {after:g} dB SL (was {before:g}); "
            "disarm, then reload"
        )
    return None


def changed_keys(old: DaemonConfig, new: DaemonConfig) -> list[str]:
    """Compare all keys but those of the layout, and the content of the rig's file."""
    before, after = old.section.model_dump(), new.section.model_dump()
    keys = [key for key in before if before[key] != after[key] and key not in _OF_LAYOUT]
    if old.rig_text != new.rig_text and "rig" not in keys:
        keys.append("rig")
    return keys
