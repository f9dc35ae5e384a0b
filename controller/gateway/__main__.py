"""`python -m controller.gateway`: the same as `era gateway`, for the daemon that starts it."""

import sys

from controller.main import main

if __name__ == "__main__":
    sys.argv.insert(1, "gateway")
    sys.exit(main())
