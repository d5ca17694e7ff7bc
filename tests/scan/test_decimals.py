"""Against float(), which rounds correctly."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bimfit.scan.formats.decimals import parse_columns

SIGNED = st.sampled_from(["", "-", "+"])
DIGITS = st.text("0123456789", max_size=22)
PLAIN = st.tuples(SIGNED, DIGITS, st.sampled_from([".", ""]), DIGITS).map("".join)
FLOATS = st.floats(allow_nan=False, width=64).map(repr)
PRINTED = st.tuples(st.floats(-1e9, 1e9), st.sampled_from(["%.3f", "%.9f", "%.15f", "%.17g", "%.12e"])).map(
    lambda pair: pair[1] % pair[0]
)


def is_number(cell):
    try:
        float(cell)
    except ValueError:
        return False
    return True


@settings(max_examples=150, deadline=None)
@given(st.lists(st.one_of(PLAIN.filter(is_number), FLOATS, PRINTED), min_size=1, max_size=12))
def test_every_bit_is_that_of_float(cells):
    block = (",".join(cells) + "\n").encode() * 2
    out = parse_columns(block, ord(","), len(cells), range(len(cells)))
    expected = np.array([float(cell) for cell in cells])
    assert np.array_equal(out, [expected, expected])
    assert np.array_equal(np.signbit(out[0]), np.signbit(expected))


def test_numbers_just_beside_a_rounding_boundary():
    """Decimals of 17 to 19 digits, made to lie next to the middle between two float64."""
    rng = np.random.default_rng(0)
    cells = []
    for value in rng.uniform(0.001, 1000.0, 2000):
        middle = (np.longdouble(value) + np.longdouble(np.nextafter(value, np.inf))) / 2
        cells += [np.format_float_positional(middle, unique=False, precision=p) for p in (14, 15, 16)]
    cells = [cell for cell in cells if len(cell) <= 20]
    out = parse_columns(("\n".join(cells) + "\n").encode(), ord(","), 1, [0])
    assert len(cells) > 2000
    assert np.array_equal(out[:, 0], [float(cell) for cell in cells])


def test_full_precision_survives_repr():
    rng = np.random.default_rng(1)
    values = rng.normal(size=50_000) * 10.0 ** rng.integers(-20, 20, 50_000)
    block = ("\n".join(map(repr, values.tolist())) + "\n").encode()
    assert np.array_equal(parse_columns(block, ord(","), 1, [0])[:, 0], values)


def test_any_columns_in_any_order():
    rows = [f"{k},{k / 7!r},text {k},{-k}" for k in range(300)]
    block = ("\n".join(rows) + "\n").encode()
    out = parse_columns(block, ord(","), 4, [3, 1, 3])
    assert np.array_equal(out[:, 0], -np.arange(300.0)) and np.array_equal(out[:, 2], out[:, 0])
    assert np.array_equal(out[:, 1], np.arange(300.0) / 7)
    assert parse_columns(block, ord(","), 4, [2]) is None


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(FLOATS, st.sampled_from([" ", "\t", "   ", " \t "])), min_size=3, max_size=9))
def test_runs_of_blanks_are_one_delimiter(cells):
    line = "".join(gap + cell for cell, gap in cells)
    out = parse_columns(f"{line}\n{line} \n".encode(), ord(" "), len(cells), range(len(cells)))
    assert np.array_equal(out, [[float(cell) for cell, _ in cells]] * 2)
    assert parse_columns(f"{line}\n{line} 1\n".encode(), ord(" "), len(cells), [0]) is None


@settings(max_examples=300, deadline=None)
@given(st.integers(1, 10**19 - 1), st.integers(0, 19), SIGNED)
def test_nineteen_digits_with_the_point_anywhere(digits, places, sign):
    text = f"{digits:020d}"
    cell = f"{sign}{text[: 20 - places]}.{text[20 - places :]}"
    out = parse_columns(f"{cell}\n".encode(), ord(","), 1, [0])
    assert out[0, 0] == float(cell)


def test_empty_cells_are_nan():
    out = parse_columns(b"1,,3\n,2,\n", ord(","), 3, range(3))
    assert np.array_equal(out, [[1, np.nan, 3], [np.nan, 2, np.nan]], equal_nan=True)


@pytest.mark.parametrize(
    "cell", [".", "-", "+.", "1.2.3", "1-2", "--1", "0x10", "1,5", "1;5", "a", "1e", "1:2", "1/2"]
)
def test_what_is_no_number_is_left_to_others(cell):
    assert parse_columns(f"1,{cell}\n2,3\n".encode(), ord(","), 2, [0, 1]) is None


@pytest.mark.parametrize(
    "block", [b"1,2\n1\n1,2,3\n", b"1\n1,2,3\n", b"1,2\n3,4\n5\n", b"1,2,3\n4\n", b"1,2"]
)
def test_uneven_rows_are_left_to_others(block):
    assert parse_columns(block, ord(","), 2, [0, 1]) is None
