"""The command `era`: as `import era_haptics`, it looks first where its packages come from."""

from controller.cli.main import main as main
