"""Daemon files as a kind of configuration for `era config`."""

from pathlib import Path

from controller.daemon.config import daemon_config_of, is_daemon_document
from controller.daemon.config_sections import DaemonSection
from drivers.by_hand.rig_check import check_links
from model.config.document import Document
from model.config.kinds import CheckedFile, ConfigKind
from model.rig.kind import gain_notes


def _check(document: Document) -> CheckedFile:
    """Check a file and the files that it names; return a one-line summary."""
    config = daemon_config_of(document)
    rig = config.rig
    _, warnings = check_links(config.urls, channels=rig.channel_counts, limits=rig.limits)
    daemon = f"era daemon {document.source}"
    hint = "" if config.table is None else f". {daemon} --check reads its table, too"
    line = (
        f"good: ERAs {', '.join(era.name for era in config.rig.eras)} on "
        f"{', '.join(f'{name} ({url})' for name, url in config.urls.items())}; touches from "
        f"{', '.join(source.name for source in config.touch) or 'the API only'}; "
        f"socket {config.socket}{hint}"
    )
    note = rig.uncertainty.note
    notes = [*gain_notes(rig), *([note] if note else [])]
    return CheckedFile(line, [*warnings, *notes])


DAEMON = ConfigKind(
    "A daemon of era-haptics",
    recognises=is_daemon_document,
    check=_check,
    example_file=Path(__file__).with_name("example.yaml"),
    keys=DaemonSection.model_json_schema,
)
