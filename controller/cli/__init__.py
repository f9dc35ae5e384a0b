"""The `era` command and the controller's share of it."""
