"""`python -m controller.cli`: the same as `era`, for processes that the daemon starts."""

import sys

from controller.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
