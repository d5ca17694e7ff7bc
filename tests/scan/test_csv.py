import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bimfit.errors import ExportError, ScanError
from bimfit.geometry.line_scan import LineScan
from bimfit.scan.cloud import PointCloud
from bimfit.scan.formats import read_scan, text, write_scan

HEADER = "scan,ox,oy,oz,dx,dy,dz,range"
ROW = "0,1,2,3,0,0,-1,0.5"


def make(tmp_path, content, name="s.csv"):
    file = tmp_path / name
    file.write_text(content, encoding="utf-8", newline="")
    return file


def same(a: LineScan, b: LineScan) -> bool:
    return all(
        np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ("scan", "origins", "directions", "ranges")
    )


def test_writing_and_reading_gives_every_bit_back(tmp_path, line_scan):
    write_scan(line_scan, tmp_path / "s.csv")
    assert (tmp_path / "s.csv").read_text().splitlines()[0] == HEADER
    back = read_scan(tmp_path / "s.csv")
    assert same(line_scan, back)
    assert back.source.endswith("s.csv")


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.integers(-(2**40), 2**40),
            st.tuples(*[st.floats(-1e7, 1e7)] * 3),
            st.floats(0, 2 * np.pi),
            st.one_of(st.just(float("nan")), st.floats(1e-300, 1e6)),
        ),
        min_size=1,
        max_size=20,
    )
)
def test_any_numbers_survive_a_round_trip(tmp_path, rows):
    scan = LineScan.of(
        [r[0] for r in rows],
        [r[1] for r in rows],
        [(np.sin(r[2]), 0.0, -np.cos(r[2])) for r in rows],
        [r[3] for r in rows],
    )
    write_scan(scan, tmp_path / "h.csv")
    assert same(scan, read_scan(tmp_path / "h.csv"))


@pytest.mark.parametrize("missing", ["", "nan", "NaN", "inf", "Infinity", " ", "0"])
def test_every_way_to_say_that_nothing_came_back(tmp_path, missing):
    scan = read_scan(make(tmp_path, f"{HEADER}\n{ROW}\n1,1,2,3,0,0,-1,{missing}\n{ROW}\n"))
    assert np.array_equal(scan.returned, [True, False, True])
    assert np.allclose(scan.hits, (1, 2, 2.5))
    assert np.array_equal(scan.sweeps, [0, 1])


@pytest.mark.parametrize(
    "content",
    [
        f"{HEADER}\r\n{ROW}\r\n1,1,2,3,0,0,-1,\r\n",
        f"\ufeff{HEADER}\n{ROW}\n1,1,2,3,0,0,-1,",
        f"# made by hand\n\n{HEADER}\n\n{ROW}\n\n1,1,2,3,0,0,-1,nan\n\n",
        f"{HEADER}\n{ROW}\n1.0,1e0,+2,3.,0,-0.0,-1,\n".replace(",", ";"),
        f"{HEADER}\n{ROW}\n1,1,2,3,0,0,-1,\n".replace(",", "\t"),
        'range,Scan, oz ,"oy",ox,dx,dy,dz\n0.5,0,3,2,1,0,0,-1\n,1,3,2,1,0,0,-1\n',
        f'{HEADER}\n"0","1","2","3",0,0,-1,"0.5"\n1,1,2,3,0,0,-1,""\n',
        f"{HEADER},note\n{ROW},good\n1,1,2,3,0,0,-1,,\n",
        f'{HEADER},note\n{ROW},"a, b"\n1,1,2,3,0,0,-1,,ü\n',
        f"note,{HEADER}\n,{ROW}\nhm,1,1,2,3,0,0,-1,\n",
        f"{HEADER},time,note\n{ROW},0.25,x\n1,1,2,3,0,0,-1,,,\n",
    ],
)
def test_what_spreadsheets_and_people_make_of_it(tmp_path, content):
    scan = read_scan(make(tmp_path, content))
    assert np.array_equal(scan.scan, [0, 1])
    assert np.allclose(scan.origins, (1, 2, 3))
    assert np.allclose(scan.directions, (0, 0, -1))
    assert np.array_equal(scan.ranges, [0.5, np.nan], equal_nan=True)


def test_extra_columns_of_numbers_are_kept(tmp_path):
    scan = read_scan(make(tmp_path, f"{HEADER},time,note,intensity\n{ROW},0.25,x,7\n{ROW},,y,8\n"))
    assert set(scan.extra) == {"time", "intensity"}
    assert np.array_equal(scan.extra["time"], [0.25, np.nan], equal_nan=True)
    assert np.array_equal(scan.extra["intensity"], [7, 8])
    write_scan(scan, tmp_path / "again.csv")
    again = read_scan(tmp_path / "again.csv")
    assert np.array_equal(again.extra["time"], [0.25, np.nan], equal_nan=True)


def test_extra_columns_are_never_an_error(tmp_path):
    scan = read_scan(make(tmp_path, f"{HEADER},lot\n{ROW},12\n{ROW},12b\n"))
    assert len(scan) == 2
    assert not scan.extra


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("scan,ox,oy,oz,dx,dy,dz\n0,1,2,3,0,0,-1\n", ["line 1", "column range is missing"]),
        ("scan,ox,oy,dx,dy,dz\n0,1,2,0,0,-1\n", ["oz, range is missing"]),
        (f"{HEADER}\n{ROW}\n0,1,zwei,3,0,0,-1,0.5\n", ["line 3", "column oy", "'zwei' is not a number"]),
        (f"{HEADER}\n{ROW}\n\n{ROW}\n0,1,2,3,0,0,-1,0.5m\n", ["line 5", "column range", "'0.5m'"]),
        (f"{HEADER}\n{ROW}\n0,1,,3,0,0,-1,0.5\n", ["line 3", "column oy", "empty"]),
        (f"{HEADER}\n{ROW}\n0,1,nan,3,0,0,-1,0.5\n", ["line 3", "column oy", "finite"]),
        (f"{HEADER}\n{ROW}\n0,1,2,3,0,inf,-1,0.5\n", ["line 3", "column dy", "finite"]),
        (f"{HEADER}\n{ROW}\n{ROW}\n0,1,2,3,0,0.5,-1,0.5\n", ["line 4", "column dx,dy,dz", "length 1.11803"]),
        (f"{HEADER}\n0,1,2,3,0,0,0,0.5\n", ["line 2", "column dx,dy,dz", "length 0 "]),
        (f"{HEADER}\n{ROW}\n0,1,2,3,0,0,-1\n", ["line 3", "7 cells where 8"]),
        (f"{HEADER}\n{ROW}\n0,1,2,3,0,0,-1,0,5\n", ["line 3", "9 cells where 8"]),
        # seven and nine cells, which add up to what two rows should have
        (f"{HEADER}\n0,1,2,3,0,0,-1\n0,1,2,3,0,0,-1,0,5\n", ["line 2", "7 cells"]),
        (f"{HEADER}\n{ROW}\n0.5,1,2,3,0,0,-1,0.5\n", ["line 3", "column scan"]),
        (f"{HEADER}\n{ROW}\n0,1,2,3,0,0,-1,-0.5\n", ["line 3", "column range", "-0.5 is not a range"]),
        (f"{HEADER}\n{ROW}\n0,1_0,2,3,0,0,-1,0.5\n", ["line 3", "column ox"]),
        (f'{HEADER}\n{ROW}\n0,1,2,3,"0,0",-1,1,0.5\n', ["line 3", "column dx"]),
        (f"{HEADER}\n", ["no beam"]),
        (f"{ROW}\n{ROW}\n", ["no header"]),
        ("", ["empty"]),
        ("\n \n", ["empty"]),
        ("# nothing\n", ["no header"]),
        ("x,y,z\n", ["no point"]),
        ("x,y,z\n1,2,a\n", ["line 2", "column z"]),
    ],
)
def test_errors_name_file_line_and_column(tmp_path, content, words):
    file = make(tmp_path, content)
    with pytest.raises(ScanError) as error:
        read_scan(file)
    message = str(error.value)
    assert "\n" not in message
    for word in [str(file), *words]:
        assert word in message


def test_the_right_line_is_named_beyond_the_first_chunk(tmp_path, monkeypatch):
    monkeypatch.setattr(text, "CHUNK", 100)
    rows = [ROW] * 50
    rows[41] = rows[41].replace("-1", "-2")
    file = make(tmp_path, "\n".join([HEADER, *rows]))
    with pytest.raises(ScanError, match="line 43, column dx,dy,dz"):
        read_scan(file)
    rows[41] = ROW
    rows[30] = ROW.replace("2", "two")
    file = make(tmp_path, "\n".join([HEADER, *rows]))
    with pytest.raises(ScanError, match="line 32, column oy"):
        read_scan(file)
    rows[30] = ROW
    assert len(read_scan(make(tmp_path, "\n".join([HEADER, *rows])))) == 50


def test_binary_rubbish_is_not_csv(tmp_path):
    file = tmp_path / "s.csv"
    file.write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(ScanError, match="not a text file"):
        read_scan(file)


def test_rounded_directions_are_mended_and_full_ones_left_alone(tmp_path, line_scan):
    d = np.array([0.6123, 0.0, -0.7906])
    content = f"{HEADER}\n0,0,0,0,{d[0]},{d[1]},{d[2]},1\n"
    scan = read_scan(make(tmp_path, content))
    assert np.allclose(scan.directions[0], d / np.linalg.norm(d), atol=1e-15)
    assert abs(np.linalg.norm(d) - 1) > 1e-6


def test_points_with_a_header_are_a_cloud(tmp_path, cloud):
    write_scan(cloud, tmp_path / "c.csv")
    back = read_scan(tmp_path / "c.csv")
    assert isinstance(back, PointCloud)
    assert np.array_equal(back.points, cloud.points)
    assert np.array_equal(back.intensity, cloud.intensity)
    holes = read_scan(make(tmp_path, "id,z,y,x\na,3,2,1\nb,,,\nc,6,5,4\n"))
    assert np.array_equal(holes.points, [[1, 2, 3], [4, 5, 6]])
    assert "1 rows" in holes.notes[0]


def test_units_scale_lengths_alone(tmp_path):
    scan = read_scan(make(tmp_path, f"{HEADER}\n{ROW}\n"), unit=0.001)
    assert np.allclose(scan.origins, (0.001, 0.002, 0.003))
    assert np.allclose(scan.directions, (0, 0, -1))
    assert scan.ranges[0] == pytest.approx(0.0005)
    with pytest.raises(ScanError, match="unit"):
        read_scan(make(tmp_path, f"{HEADER}\n{ROW}\n"), unit=0.0)


def test_files_that_are_not_there_or_of_no_known_kind(tmp_path, line_scan):
    with pytest.raises(ScanError, match="cannot be read"):
        read_scan(tmp_path / "none.csv")
    with pytest.raises(ScanError, match="is a folder"):
        read_scan(tmp_path)
    with pytest.raises(ScanError, match="unknown kind"):
        read_scan(make(tmp_path, "hello", "s.doc"))
    with pytest.raises(ExportError, match=r"a line scan cannot be written as \.ply"):
        write_scan(line_scan, tmp_path / "s.ply")
    assert not list(tmp_path.glob("*.ply"))
