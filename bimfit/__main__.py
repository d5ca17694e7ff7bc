"""``python -m bimfit``."""

import sys

from bimfit.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
