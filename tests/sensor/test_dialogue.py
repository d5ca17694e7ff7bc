import struct

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.sensor.dialogue import Speaker, read_dialogue, read_log, read_speaker
from bimfit.sensor.models import URG_04LX
from bimfit.sensor.scip import Parameters


def log(pieces):
    return b"".join(struct.pack(">III", int(t), int(t % 1 * 1e6), len(data)) + data for t, data in pieces)


def test_the_recorded_dialogues(dialogue, ug01_reply, tmp_path):
    read = dialogue[1]
    (tmp_path / "read.logr").write_bytes(log(read))
    (sweep,) = read_dialogue(tmp_path / "read.logr")
    assert sweep.ranges.size == 682 and np.nanmax(sweep.ranges) == 4.166
    assert sweep.stamp_host == pytest.approx(read[-1][0] - 0.101, abs=1e-3)
    (tmp_path / "bare").write_bytes(ug01_reply)
    (bare,) = read_dialogue(tmp_path / "bare")
    assert np.count_nonzero(np.isnan(bare.ranges)) == 85 and np.isnan(bare.stamp_host)


def test_a_log_that_was_cut_off_keeps_what_is_whole(ug01_reply, tmp_path):
    path = tmp_path / "cut"
    whole = log([(1000.5, ug01_reply), (1001.5, ug01_reply)])
    path.write_bytes(whole[:-700])
    assert read_log(path) == [(1000.5, ug01_reply)]
    assert len(read_dialogue(path)) == 1
    path.write_bytes(whole)
    assert [sweep.index for sweep in read_dialogue(path)] == [0, 1]


def test_a_pp_reply_sets_the_geometry(ug01_reply, dialogue, tmp_path):
    path = tmp_path / "log"
    text = b"".join(data for _, data in dialogue[1]).replace(b"AFRT:384;6", b"AFRT:385;7")
    path.write_bytes(text)
    (sweep,) = read_dialogue(path)
    assert sweep.bearings[385 - 44] == 0.0


def test_what_is_no_dialogue(tmp_path):
    path = tmp_path / "x"
    for data in (b"", b"hello\n\nworld\n\n", bytes(range(256)) * 10, b"VV\n00P\n\n"):
        path.write_bytes(data)
        with pytest.raises(ScanError, match="x: not a SCIP dialogue"):
            read_dialogue(path)
    with pytest.raises(ScanError, match="cannot be read"):
        read_dialogue(tmp_path / "none")


def test_who_speaks_in_a_dialogue(dialogue, ug01_reply, tmp_path):
    path = tmp_path / "log"
    path.write_bytes(log(dialogue[1]))
    assert read_speaker(path) == Speaker(
        URG_04LX, Parameters("URG-04LX(Hokuyo Automatic Co.,Ltd.)"), lit=True
    )
    path.write_bytes(ug01_reply)  # GD is answered only by a device whose laser is on
    assert read_speaker(path) == Speaker(lit=True)
    path.write_bytes(b"BM\n00P\n\nPP\n00P\nDMIN:20;5\n\nVV\n00P\n\n" + ug01_reply)
    assert read_speaker(path) == Speaker()
    path.write_bytes(b"\xff" * 100)
    assert read_speaker(path) == Speaker()
