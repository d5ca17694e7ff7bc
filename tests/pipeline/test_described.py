"""What the terminal is told of a joint: only stations that may be believed speak of contact."""

from types import SimpleNamespace

import pytest

from bimfit.geometry.status import Status
from bimfit.pipeline.output import describe


def station(name, width):
    gap = SimpleNamespace(width_mouth=width, sigma=SimpleNamespace(width=1e-4))
    contact = "overlap" if width < 0.0 else "clearance"
    return SimpleNamespace(
        status=Status(name, "" if name == "ok" else "for a reason"), gap=gap, nearness=(contact, width, 1e-4)
    )


@pytest.mark.parametrize(
    ("doubtful", "said"), [("ambiguous", False), ("rejected", False), ("weak", True), ("ok", True)]
)
def test_only_stations_that_may_be_believed_tell_of_a_clash(doubtful, said):
    joint = SimpleNamespace(id="j", kind="square-butt", width=0.025)
    stations = [*(station("ok", 0.03) for _ in range(5)), station(doubtful, -0.005)]
    line = describe(SimpleNamespace(joint=joint, stations=stations, volumes=None, reason=""))
    assert ("clash" in line) == said
    assert "designed 25.0 mm" in line
