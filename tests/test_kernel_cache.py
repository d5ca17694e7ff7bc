"""Compiled code is never out of date: a kernel that calls one of another file follows its changes."""

from __future__ import annotations

import subprocess
import sys

CALLER = (
    "from bimfit._kernels import jit\nfrom _kernels_callee import f\n\n@jit\ndef g(x):\n    return f(x)\n"
)
CALLEE = "from bimfit._kernels import jit\n\n@jit\ndef f(x):\n    return x + {}\n"
CALL = "from _kernels_caller import g; print(g(1), sum(g.stats.cache_hits.values()))"


def test_an_edited_callee_in_another_file_is_compiled_again(tmp_path, monkeypatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    (tmp_path / "_kernels_caller.py").write_text(CALLER)

    def called():
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {CALL}"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        return done.stdout.split()

    (tmp_path / "_kernels_callee.py").write_text(CALLEE.format(1))
    assert called() == ["2", "0"]
    assert called() == ["2", "1"]  # from the cache
    (tmp_path / "_kernels_callee.py").write_text(CALLEE.format(20))
    assert called() == ["21", "0"]
