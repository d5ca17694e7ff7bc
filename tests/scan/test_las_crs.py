"""Units of length that LAS and LAZ files state in their coordinate systems."""

import laspy
import numpy as np
import pytest
from laspy.vlrs.known import GeoDoubleParamsVlr, GeoKeyDirectoryVlr, WktCoordinateSystemVlr

from bimfit.errors import ScanError
from bimfit.scan.formats import read_scan, scan_chunks, unit_taken
from bimfit.scan.formats.las_crs import units_of_wkt
from bimfit.scan.formats.options import ReadOptions

USFT, FT = 1200.0 / 3937.0, 0.3048
GEOGRAPHIC = (
    'GEOGCS["NAD83",DATUM["North_American_Datum_1983",SPHEROID["GRS 1980",6378137,298.257222101]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'
)


def projected(unit, size):
    return (
        f'PROJCS["NAD83 / New York, ""Long"" Island (ftUS)",{GEOGRAPHIC},'
        'PROJECTION["Lambert_Conformal_Conic_2SP"],PARAMETER["false_easting",984250.0000000002],'
        f'UNIT["{unit}",{size}],AXIS["X",EAST],AXIS["Y",NORTH],AUTHORITY["EPSG","2263"]]'
    )


def compound(flat, upright):
    vertical = f'VERT_CS["NAVD88",VERT_DATUM["NAVD88",2005],UNIT["x",{upright}],AXIS["Up",UP]]'
    return f'COMPD_CS["both",{projected("x", flat)},{vertical}]'


WKT2 = (
    'PROJCRS["NAD83 / Maine",BASEGEOGCRS["NAD83",DATUM["NAD83",ELLIPSOID["GRS 1980",6378137,298.257,'
    'LENGTHUNIT["metre",1]]],PRIMEM["Greenwich",0,ANGLEUNIT["degree",0.0174532925199433]]],'
    'CONVERSION["x",METHOD["Transverse Mercator"],PARAMETER["False easting",3e5,LENGTHUNIT["metre",1]]],'
    'CS[Cartesian,2],AXIS["(E)",east,ORDER[1],LENGTHUNIT["US survey foot",0.304800609601219]],'
    'AXIS["(N)",north,ORDER[2],LENGTHUNIT["US survey foot",0.304800609601219]]]'
)
STATED = {
    projected("US survey foot", "0.3048006096012192"): USFT,
    projected("foot", "0.3048"): FT,
    projected("metre", "1"): 1.0,
    compound(0.304800609601219, 0.3048006096): USFT,
    WKT2: USFT,
}


@pytest.mark.parametrize("text", STATED)
def test_well_known_text_states_the_unit_of_positions(text):
    assert units_of_wkt(text)[0] == STATED[text]
    assert not units_of_wkt(text)[2]


@pytest.mark.parametrize(
    "text", ["", '"', "]]]", "PROJCS[", 'PROJCS[UNIT["m",1e999', 'UNIT["m",1]', "[" * 5000]
)
def test_damaged_text_states_nothing(text):
    assert units_of_wkt(text) == (None, None, False)


def written(path, points, unit, records):
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 1e-4)
    header.offsets = np.floor(points[0] / unit)
    header.vlrs.extend(records)
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points / unit).T
    las.write(path)
    return path


def keys(*rows, double=None):
    directory = GeoKeyDirectoryVlr()
    data = np.array([(1, 1, 0, len(rows)), *rows], "<u2").tobytes()
    directory.parse_record_data(data)
    if double is None:
        return [directory]
    doubles = GeoDoubleParamsVlr()
    doubles.parse_record_data(np.array([double], "<f8").tobytes())
    return [directory, doubles]


POINTS = np.array([300_000.0, 60_000.0, 12.0]) + np.random.default_rng(4).uniform(0.0, 5.0, (200, 3))
FILES = {
    "wkt": ([WktCoordinateSystemVlr(projected("US survey foot", "0.3048006096012192"))], USFT),
    "keys": (keys((1024, 0, 1, 1), (3076, 0, 1, 9003), (4099, 0, 1, 9003)), USFT),
    "feet": (keys((1024, 0, 1, 1), (3076, 0, 1, 9002)), FT),
    "size": (keys((1024, 0, 1, 1), (3076, 0, 1, 32767), (3077, 34736, 1, 0), double=0.3048), FT),
    "metre": ([WktCoordinateSystemVlr(projected("metre", "1"))], 1.0),
    "code alone": (keys((1024, 0, 1, 1), (3072, 0, 1, 2263)), 1.0),
}


@pytest.mark.parametrize("ending", ["las", "laz"])
@pytest.mark.parametrize("name", FILES)
def test_files_are_read_in_the_unit_that_they_state(tmp_path, name, ending):
    records, unit = FILES[name]
    path = written(tmp_path / f"scan.{ending}", POINTS, unit, records)
    scan = read_scan(path)
    # half a step of 0.1 mm or 0.1 milli-foot
    np.testing.assert_allclose(scan.points, POINTS, atol=6e-5)
    assert any("coordinate system is in" in note for note in scan.notes) == (unit != 1.0)
    assert any("EPSG:2263" in note and "--scan-unit" in note for note in scan.notes) == (name == "code alone")
    assert unit_taken(path) == unit
    box = np.array([[[300_000.0, 60_000.0, 12.0], [300_002.0, 60_002.0, 14.0]]])
    within = np.all((box[0, 0] <= POINTS) & (box[0, 1] >= POINTS), axis=1)
    found = np.concatenate([piece.points for piece in scan_chunks(path, ReadOptions(boxes=box))])
    found = found[np.all((found >= box[0, 0] - 1e-3) & (found <= box[0, 1] + 1e-3), axis=1)]
    np.testing.assert_allclose(found, POINTS[within], atol=6e-5)
    # what the user says goes before
    assert read_scan(path, unit=1.0).points[0, 0] == pytest.approx(POINTS[0, 0] / unit, abs=1e-4)


REFUSED = {
    "degrees": [WktCoordinateSystemVlr(GEOGRAPHIC)],
    "heights in metres": [WktCoordinateSystemVlr(compound(0.3048006096012192, 1))],
    "not known": keys((1024, 0, 1, 1), (3076, 0, 1, 9005)),
    "longitudes": keys((1024, 0, 1, 2), (2048, 0, 1, 4326)),
}
SAID = {"heights in metres": "heights in metres", "not known": "9005", "longitudes": "degrees"}


@pytest.mark.parametrize("name", REFUSED)
def test_units_that_cannot_be_used_are_refused_unless_the_user_says(tmp_path, name):
    path = written(tmp_path / "scan.las", POINTS, 1.0, REFUSED[name])
    with pytest.raises(ScanError, match=SAID.get(name, name)) as caught:
        read_scan(path)
    assert str(path) in str(caught.value)
    np.testing.assert_allclose(read_scan(path, unit=1.0).points, POINTS, atol=6e-5)
