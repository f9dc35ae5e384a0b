"""`python -m controller.cli`: the commands of this package, also for the daemon's children."""

import sys
from collections.abc import Sequence

from registry.command_line import CommandModule, main


def command_modules() -> Sequence[CommandModule]:
    """The modules of this package with commands."""
    from controller.cli import commands, config_cli

    return commands, config_cli


if __name__ == "__main__":
    sys.exit(main(command_modules))
