"""A virtual SCIP 2.0 rangefinder on a pseudo-terminal, for programs that know nothing of it."""

from __future__ import annotations

import contextlib
import math
import os
import select
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bimfit.errors import ConfigError, SensorError
from bimfit.sensor.device import Device, Packet
from bimfit.sensor.faults import Fault, damage
from bimfit.sensor.models import UG01, Identity
from bimfit.sensor.noise import Noise
from bimfit.sensor.scene import Scene, measurer
from bimfit.sensor.scip import Parameters

USB_RATE = 0.93e6  # recorded: 2134 bytes in 2.3 ms
PIECE = 512
KEPT = 100_000


@dataclass(frozen=True)
class Sent:
    """A scan that the emulator sent, or would have sent.

    Attributes
    ----------
    stamp : int
        The device's clock, ms.
    boot : int
        How often the device had been switched on before: its clock starts again then.
    fault : str
        What happened to it; empty when it left whole.
    """

    stamp: int
    boot: int
    fault: str = ""


class Emulator:
    """A rangefinder that other programs open as a serial port.

    Use it as a context manager, or call :meth:`start` and :meth:`stop`. Linux and macOS only.

    Parameters
    ----------
    scene : callable, MovingScene, or sequence
        What it sees: a function of bearings (n,) rad that gives ranges (n,) m, NaN where there is nothing;
        a :class:`~bimfit.sensor.scene.MovingScene`; or recorded sweeps, sent as they are over and over.
    speed : float
        Emulated seconds a second; infinity sends as fast as the other side reads.
    noise : Noise, optional
        Defaults to noise as recorded.
    faults : iterable of Fault
        What goes wrong, and when. An iterator has them in the order of their times and may be endless; what
        was due while nobody asked for scans is left out.
    parameters, identity : Parameters, Identity
        What the device is.
    scip1, laser, late_scan, clock
        See :class:`~bimfit.sensor.device.Device`.
    wait : float
        Seconds of emulated time before it answers at all, as after switching on.
    told : bytes
        Requests that it was sent before anyone opens the port: how another program left it.
    seed : int
        Of the noise and the faults.
    link : path, optional
        Name of the port; it must not exist. The default lies in a new temporary directory. It stays the
        same after unplugging.

    Attributes
    ----------
    port : str
        What to open.
    log : deque of Sent
        The last scans, in order; about three hours of them.
    departures : deque of (int, int, float)
        Boot and stamp of scans that left whole, and when their last byte was handed to the system, s of
        ``time.monotonic()``.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        speed: float = 1.0,
        noise: Noise | None = None,
        faults: Iterable[Fault] = (),
        parameters: Parameters | None = None,
        identity: Identity = UG01,
        scip1: bool = False,
        laser: bool = False,
        late_scan: bool = False,
        clock: int = 0,
        wait: float = 0.0,
        told: bytes = b"",
        seed: int = 0,
        link: str | Path | None = None,
    ) -> None:
        if not speed > 0.0:
            raise ConfigError(f"speed must be positive, got {speed}")
        self._rng = np.random.default_rng(seed)
        self._parameters = parameters or Parameters()
        self._measure = measurer(scene, self._parameters, noise or Noise(), self._rng)
        self._speed = speed
        listed = isinstance(faults, Sequence)
        self._overdue = math.inf if listed else 1.0
        self._faults = iter(sorted(faults, key=lambda fault: fault.at) if listed else faults)
        self._fault = next(self._faults, None)
        self._options: dict[str, Any] = {"identity": identity, "scip1": scip1, "late_scan": late_scan}
        self._wait, self._told = wait, told
        self._first: dict[str, Any] = {"laser": laser, "clock": clock}
        self._link = Path(link) if link is not None else None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self.port = ""
        self.log: deque[Sent] = deque(maxlen=KEPT)
        self.departures: deque[tuple[int, int, float]] = deque(maxlen=KEPT)

    def __enter__(self) -> Emulator:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def laser(self) -> bool:
        """Whether the emulated laser is on."""
        return self._device.laser

    @property
    def running(self) -> bool:
        """Whether it serves: from the start until it is stopped or the scene fails."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def seconds(self) -> float:
        """Emulated seconds since the start."""
        return self._now()

    def start(self) -> None:
        """Open the port and serve it from a thread.

        Raises
        ------
        SensorError
            Where there are no pseudo-terminals, or when ``link`` cannot be made.
        """
        if os.name != "posix":
            raise SensorError(
                "the emulator needs pseudo-terminals, which Windows does not have",
                remedy="run it on Linux, macOS or in WSL",
            )
        if self._link is None:
            self._folder = tempfile.TemporaryDirectory(prefix="bimfit-")
            self._link = Path(self._folder.name) / "ttyUG01"
        self._boot, self._boot_at, self._shift = 0, 0.0, 0.0
        self._out: deque[tuple[float, bytes, int | None]] = deque()
        self._silent_until = -math.inf
        self._begun = math.nan
        self._zero = time.monotonic()
        self._device = self._switched_on(**self._first)
        self._device.receive(self._told, 0.0)
        self._device.hush()  # the answers went to whoever asked
        self._plug()
        self.port = str(self._link)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="rangefinder", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Close the port.

        Raises
        ------
        SensorError
            When the emulated scene failed meanwhile.
        """
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder, self._link = None, None
        if self._error is not None:
            error, self._error = self._error, None
            raise SensorError(f"the emulated scene failed: {error}") from error

    def _switched_on(self, **state: Any) -> Device:
        """A device whose own time is 0 now; what it looks at does not start again."""
        before = self._boot_at
        return Device(lambda start: self._measure(before + start), self._parameters, **self._options, **state)

    def _plug(self) -> None:
        import pty
        import tty

        assert self._link is not None
        self._master, self._slave = pty.openpty()
        # Raw before anyone opens it, or the device's words would be echoed back to it; the slave stays open,
        # or the master would fail whenever a client leaves.
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        try:
            self._link.symlink_to(os.ttyname(self._slave))
        except OSError as error:
            self._close()
            remedy = "remove it, or choose another name" if self._link.is_symlink() else "choose another name"
            raise SensorError(f"cannot be made: {error.strerror}", file=self._link, remedy=remedy) from error
        self._plugged = True

    def _close(self) -> None:
        os.close(self._master)
        os.close(self._slave)

    def _unplug(self) -> None:
        assert self._link is not None
        self._plugged = False
        self._out.clear()
        self._link.unlink(missing_ok=True)
        self._close()

    def _now(self) -> float:
        if math.isinf(self._speed):
            return self._shift
        return (time.monotonic() - self._zero) * self._speed

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                self._turn()
        except BaseException as error:
            self._error = error
        finally:
            if self._plugged:
                self._unplug()

    def _turn(self) -> None:
        """Send what is due, then wait for a request, for room, or for the next packet."""
        if math.isinf(self._speed) and not self._out:
            due = self._device.next_time()
            if due is not None:
                # A little past it: the sum is rounded.
                self._shift = max(self._shift, due + self._boot_at + 1e-6)
        now = self._now()
        for packet in self._device.take(now - self._boot_at):
            self._emit(packet, now)
            if not self._plugged:
                return
        self._write(now)
        waiting = bool(self._out) and self._out[0][0] <= now
        readable, _, _ = select.select(
            [self._master], [self._master] if waiting else [], [], self._pause(now, waiting)
        )
        self._share()
        if readable:
            data = os.read(self._master, 4096)
            if self._now() >= self._wait:
                self._device.receive(data, self._now() - self._boot_at)

    def _share(self) -> None:
        """Let others open the port after a program that had it for itself, as if that closed it for good."""
        import fcntl
        import termios

        with contextlib.suppress(OSError):
            fcntl.ioctl(self._slave, termios.TIOCNXCL)

    def _pause(self, now: float, waiting: bool) -> float:
        """How long to sleep at most, in real seconds."""
        if math.isinf(self._speed):
            return 0.02 if waiting or self._device.next_time() is None else 0.0
        times = [] if waiting else [piece[0] for piece in list(self._out)[:1]]
        due = self._device.next_time()
        if due is not None:
            times.append(due + self._boot_at)
        return min(max((min(times) - now) / self._speed, 0.0), 0.02) if times else 0.02

    def _emit(self, packet: Packet, now: float) -> None:
        stamp = packet.stamp
        if now < self._silent_until:
            self._note(stamp, "silence")
            return
        late = now - self._out[0][0] if self._out else 0.0
        if stamp is not None and late > self._parameters.period / 2 and not math.isinf(self._speed):
            # The host does not take what was sent; the device has no room for another scan.
            self._note(stamp, "overrun")
            return
        if stamp is not None and math.isnan(self._begun):
            self._begun = now
        since = now - self._begun
        while self._fault is not None and self._fault.at < since - self._overdue:
            self._fault = next(self._faults, None)
        fault = self._fault
        if fault is None or stamp is None or fault.at > since:
            self._queue(packet.data, now, stamp)
            self._note(stamp, "")
            return
        self._fault = next(self._faults, None)
        if fault.kind == "silence":
            self._silent_until = now + fault.length
            self._note(stamp, "silence")
        elif fault.kind == "unplug":
            self._note(stamp, "unplug")
            self._pull_out(packet.data[: len(packet.data) // 2], fault.length)
        else:
            self._queue(damage(packet.data, fault.kind, self._rng), now)
            self._note(stamp, "" if fault.kind == "garbage" else fault.kind)

    def _note(self, stamp: int | None, fault: str) -> None:
        if stamp is not None:
            self.log.append(Sent(stamp, self._boot, fault))

    def _queue(self, data: bytes, now: float, stamp: int | None = None) -> None:
        """Let bytes leave at the pace of USB; ``stamp`` notes when the last of them does."""
        if self._speed > 4.0:
            self._out.append((now, data, stamp))
            return
        for k in range(0, len(data), PIECE):
            last = stamp if k + PIECE >= len(data) else None
            self._out.append((now + (k + PIECE) / USB_RATE, data[k : k + PIECE], last))

    def _write(self, now: float) -> None:
        while self._out and self._out[0][0] <= now:
            due, data, stamp = self._out[0]
            try:
                done = os.write(self._master, data)
            except BlockingIOError:
                return
            self._out.popleft()
            if done < len(data):
                self._out.appendleft((due, data[done:], stamp))
            elif stamp is not None:
                self.departures.append((self._boot, stamp, time.monotonic()))

    def _pull_out(self, half: bytes, length: float) -> None:
        """Let the host read what was sent so far, and the cable is out; later the device starts anew."""
        self._out.append((-math.inf, half, None))
        start = seen = time.monotonic()
        # Bytes pass through a buffer of the kernel that cannot be asked, hence some quiet time at the end.
        while time.monotonic() < min(seen + 0.05, start + 5.0) and not self._stop.is_set():
            self._write(math.inf)
            if self._out or self._unread():
                seen = time.monotonic()
            time.sleep(0.0005)
        self._unplug()
        self._stop.wait(0.05 if math.isinf(self._speed) else length / self._speed)
        self._shift += length
        self._boot += 1
        self._boot_at = self._now()
        self._silent_until = -math.inf
        self._device = self._switched_on()
        if not self._stop.is_set():
            self._plug()

    def _unread(self) -> int:
        import fcntl
        import struct
        import termios

        answer = fcntl.ioctl(self._slave, termios.FIONREAD, b"\0" * 4)
        return int(struct.unpack("i", answer)[0])
