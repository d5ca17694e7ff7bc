"""Recordings that grow on disk."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bimfit.errors import ExportError
from bimfit.geometry.line_scan import LineScan
from bimfit.pipeline.spool import Spool
from bimfit.scan.formats import read_scan, write_scan


def sweep(k, count=50):
    rng = np.random.default_rng(k)
    turn = rng.uniform(0, 6, count)
    ranges = np.where(rng.random(count) < 0.2, np.nan, rng.uniform(0, 5, count))
    directions = np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    scan = LineScan.of(np.full(count, k), rng.normal(size=(count, 3)), directions, ranges)
    return LineScan(scan.scan, scan.origins, scan.directions, scan.ranges, extra={"time": 1e9 + turn})


def same(a, b):
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("scan", "origins", "directions", "ranges")
    ) and np.array_equal(a.extra["time"], b.extra["time"])


def whole(count):
    from bimfit.geometry.line_scan import continued

    return continued([sweep(k) for k in range(count)])


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_sweeps_one_by_one_are_the_file_written_at_once(tmp_path, suffix):
    target = tmp_path / "new" / f"s{suffix}"
    spool = Spool(target)
    for k in range(4):
        spool.add(sweep(k))
        assert len(read_scan(spool.path).sweeps) == k + 1  # also while it grows
    spool.finish()
    assert list(target.parent.iterdir()) == [target] and same(read_scan(target), whole(4))
    if suffix == ".csv":
        write_scan(whole(4), tmp_path / "at-once.csv")
        assert target.read_bytes() == (tmp_path / "at-once.csv").read_bytes()


def test_a_torn_end_costs_its_line_alone_wherever_it_is_torn(tmp_path):
    spool = Spool(tmp_path / "s.csv")
    for k in range(3):
        spool.add(sweep(k))
    spool.close()
    data = spool.path.read_bytes()
    lines = data.split(b"\n")
    for cut in range(len(data) - 300, len(data)):
        spool.path.write_bytes(data[:cut])
        kept = data[:cut].count(b"\n") - 1
        scan = read_scan(spool.path)
        assert len(scan) == kept and same(scan, whole(3).taken(np.arange(kept)))
    assert len(lines) == 152


def test_an_earlier_recording_is_never_touched_and_an_empty_one_leaves_nothing(tmp_path):
    first = Spool(tmp_path / "s.csv")
    first.add(sweep(0))
    first.close()
    before = first.path.read_bytes()
    second = Spool(tmp_path / "s.csv")
    second.add(sweep(1))
    second.finish()
    Spool(tmp_path / "s.csv").close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.csv", "s.part.csv"]
    assert first.path.read_bytes() == before and read_scan(tmp_path / "s.csv").scan[0] == 1


FULL = """
import json, resource, signal, sys
from pathlib import Path
sys.path.insert(0, sys.argv[2])
from test_spool import sweep
from bimfit.errors import ExportError
from bimfit.pipeline.spool import Spool
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))
spool, k = Spool(Path(sys.argv[1])), 0
try:
    while True:
        spool.add(sweep(k))
        k += 1
except ExportError as error:
    spool.finish()
    print(json.dumps([k, str(error)]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of a process")
def test_a_disc_that_takes_no_more_keeps_the_whole_sweeps(tmp_path):
    words = [sys.executable, "-c", FULL, str(tmp_path / "s.csv"), str(Path(__file__).parent)]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    count, said = json.loads(done.stdout)
    assert count >= 2 and "s.part.csv: cannot be written" in said
    assert same(read_scan(tmp_path / "s.csv"), whole(count))


def test_where_nothing_can_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ExportError, match="cannot be written"):
        Spool(tmp_path / "file" / "s.csv")
