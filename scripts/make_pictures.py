"""Draw the README's pictures into scripts/pictures: python scripts/make_pictures.py."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from bimfit.pipeline.demo import demo

TARGET = Path(__file__).resolve().parent / "pictures"
PICTURES = {
    "scene-*.png": "scene.png",
    "gap-poses-*.png": "gap-poses.png",
    "slice-*.png": "slice.png",
    "compare.png": "compare.png",
}


def main() -> int:
    """Run the demonstration and keep its pictures under lasting names."""
    TARGET.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        demo(Path(folder), joints=1)
        for pattern, name in PICTURES.items():
            (found,) = Path(folder).glob(pattern)
            shutil.copy(found, TARGET / name)
    return 0


if __name__ == "__main__":
    sys.exit(main())
