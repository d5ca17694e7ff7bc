import struct
from pathlib import Path

import pytest

DIALOGUES = Path(__file__).parents[3] / "shared" / "data" / "scip"


def _records(path):
    data, records, at = path.read_bytes(), [], 0
    while at < len(data):
        seconds, micros, length = struct.unpack(">III", data[at : at + 12])
        records.append((seconds + micros * 1e-6, data[at + 12 : at + 12 + length]))
        at += 12 + length
    return records


@pytest.fixture(scope="session")
def dialogue():
    """The recorded URG-04LX: (what the client wrote, what it read), lists of (time, bytes)."""
    if not DIALOGUES.is_dir():
        pytest.skip("the recorded dialogues are not here")
    return tuple(_records(DIALOGUES / f"example_urg_04lx.log{letter}") for letter in "wr")


@pytest.fixture(scope="session")
def ug01_reply():
    """A whole GD reply of a real URG-04LX-UG01."""
    path = DIALOGUES / "ug01_fw3.4.03_GD0044072501.reply"
    if not path.is_file():
        pytest.skip("the recorded dialogues are not here")
    return path.read_bytes()
