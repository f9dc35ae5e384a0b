"""Daemon files as a kind of configuration for `era config`."""

from collections import Counter
from pathlib import Path
from typing import Any

from controller.daemon.config import daemon_config_of, is_daemon_document
from controller.daemon.config_sections import DaemonSection
from drivers.by_hand.rig_check import check_links
from model.config.document import Document
from model.config.kinds import CheckedFile
from model.rig.kind import gain_notes


class DaemonKind:
    """The daemon's configuration file."""

    def recognises(self, document: Document) -> bool:
        """Whether a document is a daemon's file."""
        return is_daemon_document(document)

    def check(self, document: Document) -> CheckedFile:
        """Check a file and the files that it names; return a one-line summary."""
        config = daemon_config_of(document)
        rig = config.rig
        wired = Counter(channel.amplifier for channel in rig.wiring.values())
        _, warnings = check_links(config.urls, channels=wired, limits=rig.limits)
        layout_warnings = config.layout.warnings() if config.layout else []
        daemon = f"era daemon {document.source}"
        hint = "" if config.table is None else f". {daemon} --check reads its table, too"
        line = (
            f"good: ERAs {', '.join(era.name for era in config.rig.eras)} on "
            f"{', '.join(f'{name} ({url})' for name, url in config.urls.items())}; touches from "
            f"{', '.join(source.name for source in config.touch) or 'the API only'}; "
            f"socket {config.socket}{hint}"
        )
        note = rig.uncertainty.note
        notes = [*layout_warnings, *gain_notes(rig), *([note] if note else [])]
        return CheckedFile(line, [*warnings, *notes])

    def example(self) -> str:
        """A commented example with every key."""
        return Path(__file__).with_name("example.yaml").read_text(encoding="utf-8")

    def schema(self) -> dict[str, Any]:
        """The JSON schema for editors."""
        schema = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
        return schema | DaemonSection.model_json_schema() | {"title": "A daemon of era-haptics"}


DAEMON = DaemonKind()
