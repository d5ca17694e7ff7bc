"""A second process that switches the laser off when this one is killed, which no handler can see coming."""

from __future__ import annotations

import contextlib
import subprocess
import sys

# Its input ends without a word only when the process that holds the other end is dead.
_PROGRAM = """
import sys
words = sys.stdin.buffer.read().split(b"\\n")
if b"done" not in words:
    import time
    import serial
    for attempt in range(20):
        try:
            with serial.Serial(sys.argv[1], int(sys.argv[2]), timeout=0.1, write_timeout=1.0) as line:
                line.write(b"\\nQT\\n")
                for k in range(20):
                    if b"QT\\n00P" in line.read(4096):
                        break
            break
        except OSError:
            time.sleep(0.1)
"""


class Guard:
    """Watches over a port from :meth:`start` to :meth:`stop`; in between, death of this process sends QT.

    It runs in a session of its own, so that what a terminal sends to a whole group does not reach it.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def start(self, port: str, baud: int) -> None:
        """Watch over a port; without a guard where no process can be started."""
        self.stop()
        flags = getattr(subprocess, "CREATE_NO_WINDOW", 0)
        with contextlib.suppress(OSError):
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, port, str(baud)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                creationflags=flags,
            )

    def stop(self) -> None:
        """Send the guard home; does nothing twice."""
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(OSError, subprocess.TimeoutExpired):
            process.communicate(b"done\n", timeout=5.0)
        if process.poll() is None:
            process.kill()
            process.wait()
