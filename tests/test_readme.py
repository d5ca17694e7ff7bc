"""The README's code runs, and its pictures and commands exist."""

from __future__ import annotations

import re
from pathlib import Path

from bimfit.cli.main import app

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_python_of_the_readme_runs(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    fits_a_model, fits_meshes = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    exec(compile(fits_a_model, "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5  # every twentieth of 83 stations
    widths = [float(line.split()[-1]) for line in lines if not line.endswith("None")]
    assert len(widths) >= 4
    assert all(0.010 < width < 0.045 for width in widths)
    exec(compile(fits_meshes, "README.md", "exec"), {})
    width, sd = (float(x) for x in re.findall(r"[\d.]+", capsys.readouterr().out))
    # two corners of the mouth 24 mm apart across and 2 mm out
    assert abs(width - (24.0**2 + 2.0**2) ** 0.5) < 3.0 * sd + 0.1


def test_pictures_of_the_readme_are_there():
    names = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README)
    assert len(names) >= 3
    for name in names:
        assert (ROOT / name).stat().st_size > 20_000


def test_commands_of_the_readme_exist():
    named = set(re.findall(r"^    bimfit (\w+)", README, flags=re.MULTILINE))
    known = {command.name for command in app.registered_commands}
    assert named <= known
    # what users' scripts may rely on; there may be more
    promised = "demo joints fit compare simulate capture emulate view report bench"
    assert known >= set(promised.split())
