"""The `era` command and the controller's subcommands."""
