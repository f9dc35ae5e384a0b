"""The command `era`, with the commands of all packages.

It belongs to this package because `import era_haptics` first checks where its packages come from.
"""

from collections.abc import Sequence

from registry import command_line
from registry.command_line import CommandModule


def command_modules() -> Sequence[CommandModule]:
    """The modules with commands of `era`, in the order in which their errors are looked up."""
    from controller.cli import commands, config_cli
    from drivers.by_hand import cli as amplifier_commands
    from era_haptics.lab import cli as lab_commands
    from model import cli as model_commands
    from sim import cli as sim_commands

    return commands, config_cli, amplifier_commands, model_commands, sim_commands, lab_commands


def main() -> int:
    """Run the command line of the process; return the exit status."""
    return command_line.main(command_modules)


def run_era(arguments: Sequence[str]) -> int:
    """Run one command line; return the exit status."""
    return command_line.run(arguments, command_modules)
