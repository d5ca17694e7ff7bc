"""``python -m bimfit``, and the command ``bimfit``."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line; Ctrl-C is one line also while it is still being loaded."""
    try:
        from bimfit.cli.main import INTERRUPTED
        from bimfit.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("bimfit: interrupted\n")
        return 130
    try:
        return run()
    except KeyboardInterrupt:  # a second one, on the way out
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
