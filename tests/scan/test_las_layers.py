"""LAZ chunks whose layers claim more than there is, for which lazrs would take gigabytes."""

import struct

import numpy as np
import pytest

from bimfit.errors import ScanError
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import read_scan, write_scan


@pytest.fixture
def packed(tmp_path):
    rng = np.random.default_rng(0)
    colors = rng.integers(0, 255, (3000, 3)).astype(np.uint8)
    path = tmp_path / "c.laz"
    write_scan(PointCloud(rng.uniform(-3, 3, (3000, 3)), colors=colors), path)
    return path


def layers(path):
    """Where the sizes of the first chunk's layers are: behind a bare point of 36 bytes and its count."""
    (points,) = struct.unpack_from("<I", path.read_bytes(), 96)
    return points + 8 + 36 + 4


def test_sound_layers_are_read(packed):
    sizes = struct.unpack_from("<10I", packed.read_bytes(), layers(packed))
    assert 10_000 < sum(sizes) < packed.stat().st_size  # the layout is as it is taken to be
    assert len(read_scan(packed)) == 3000


@pytest.mark.parametrize("layer", range(10))
@pytest.mark.parametrize("claimed", [0xFFFFFFFF, 0x7FFFFFF0, 1 << 20])
def test_layers_larger_than_their_chunk_are_refused(packed, layer, claimed):
    data = bytearray(packed.read_bytes())
    struct.pack_into("<I", data, layers(packed) + 4 * layer, claimed)
    packed.write_bytes(data)
    with pytest.raises(ScanError, match="larger than its room"):
        read_scan(packed)
