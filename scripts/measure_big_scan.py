"""Measure one pass over a generated scan of any size: ``measure_big_scan.py FILE.las MILLIONS [--keep]``.

The file is written first (20 bytes a point as LAS), and removed afterwards unless ``--keep`` is given; a file
that is there already is measured as it is.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from bimfit.pipeline.bench_size import measure, row_text, write_site


def main() -> None:
    """Write, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("millions", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--keep", action="store_true")
    options = parser.parse_args()
    made = not options.file.exists()
    if made:
        write_site(options.file, round(options.millions * 1e6), options.seed)
    try:
        print(row_text(measure(options.file, options.repeats)))
    finally:
        if made and not options.keep:
            options.file.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
