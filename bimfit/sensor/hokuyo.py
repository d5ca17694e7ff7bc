"""Driver of Hokuyo rangefinders that speak SCIP 2.0 over a serial port: URG-04LX-UG01 and relatives."""

from __future__ import annotations

import atexit
import contextlib
import time
from collections.abc import Callable, Iterator

from bimfit.errors import SensorError
from bimfit.sensor import scip
from bimfit.sensor.clock import SCAN_PHASE, HostClock, StampOrder, StampUnwrapper, host_clock
from bimfit.sensor.counters import Counters
from bimfit.sensor.exits import termination_raises
from bimfit.sensor.guard import Guard
from bimfit.sensor.line import Line, bound_clock, must_answer, start_up
from bimfit.sensor.replies import Reply, ScanReply, device_time, fields
from bimfit.sensor.scanning import begin_stream, next_scan
from bimfit.sensor.scip import Parameters, ScanRequest
from bimfit.sensor.serial_port import Unplugged, find_port
from bimfit.sensor.sweep import Sweep


class Hokuyo:
    """A rangefinder on a serial port; use it as a context manager, so that the laser is off afterwards.

    The laser is switched off when a stream ends, on every way out of the ``with`` block (Ctrl-C, SIGTERM and
    SIGHUP included), and when the interpreter exits; with ``guard`` also when the process is killed.

    Parameters
    ----------
    port : str, optional
        Such as ``/dev/ttyACM0`` or ``COM3``; None takes the one Hokuyo that is plugged in.
    baud : int
        Without meaning on USB.
    timeout : float
        How long the device may take to answer at the start, s.
    reconnect : float
        How long to wait for the device to come back after it was unplugged during a stream, s; 0 gives up.
    synchronise : bool
        Ask for the device's clock at the start (about half a second), which bounds the error of
        ``stamp_host``.
    clock : callable, optional
        Host's clock, s.
    guard : bool
        Let a second process watch over the port, which switches the laser off when this one is killed.
    told : callable
        Told, in a line, when the device goes away or falls silent during a stream, and when it is back.

    Attributes
    ----------
    parameters : Parameters
        What the device says of its geometry.
    version : dict
        Vendor, product, firmware, protocol, serial number.
    """

    def __init__(
        self,
        port: str | None = None,
        *,
        baud: int = 115200,
        timeout: float = 8.0,
        reconnect: float = 30.0,
        synchronise: bool = True,
        clock: Callable[[], float] | None = None,
        guard: bool = False,
        told: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._asked_port = port
        self._baud = baud
        self._timeout = timeout
        self._reconnect = reconnect
        self._synchronise = synchronise
        self._clock = clock or host_clock()
        self._guard = Guard() if guard else None
        self._told = told
        self._line: Line | None = None
        self._counts = dict.fromkeys(Counters.__dataclass_fields__, 0)
        self._exits = contextlib.ExitStack()
        self.parameters = Parameters()
        self.version: dict[str, str] = {}
        self._streaming = False

    def __enter__(self) -> Hokuyo:
        with contextlib.ExitStack() as exits:
            # Before the port opens: a signal that arrives while it does must find the way out too.
            exits.enter_context(termination_raises())
            exits.callback(self.close)
            self.open()
            self._exits = exits.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._exits.close()

    def open(self) -> None:
        """Open the port and bring the device to rest, whatever state it was left in.

        Raises
        ------
        SensorError
            When there is no such port, it may not be opened, another program has it, or no SCIP device
            answers.
        """
        if self._line is not None:
            return
        line = Line(self._asked_port or find_port(), self._baud, self._clock)
        self._line = line
        atexit.register(self.close)
        if self._guard is not None:
            self._guard.start(line.port, self._baud)
        try:
            start_up(line, self._timeout)
            self.version = fields(must_answer(line, b"VV"))
            self.parameters = Parameters.from_fields(fields(must_answer(line, b"PP")))
            self._unwrap, self._host = StampUnwrapper(), self._new_clock()
            if self._synchronise:
                bound_clock(line, self._clock, self._host, self._unwrap)
        except Unplugged as error:
            self.close()
            raise SensorError("the rangefinder was unplugged", file=line.port) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Switch the laser off and close the port; does nothing twice."""
        line, self._line = self._line, None
        if line is None:
            return
        atexit.unregister(self.close)
        try:
            with contextlib.suppress(Unplugged):
                line.ask(b"QT", 0.5)
        finally:
            line.close()
            self._take_counts(line)
            if self._guard is not None:
                self._guard.stop()

    @property
    def port(self) -> str:
        """The open port."""
        return self._open_line().port

    @property
    def waiting(self) -> int:
        """Scans of a stream that have come and are not yet taken."""
        return len(self._line.scans) if self._line is not None else 0

    @property
    def counters(self) -> Counters:
        """What has happened so far."""
        counts = dict(self._counts)
        if self._line is not None:
            counts["damaged"] += self._line.damaged
            counts["noise"] += self._line.noise
        return Counters(**counts)

    def query(self, name: str, parameter: str = "", string: str = "") -> Reply:
        """Send any request that is not for a scan, also in the middle of a stream, which goes on undisturbed.

        Raises
        ------
        SensorError
            When the answer does not come or is a refusal.
        """
        line = self._open_line()
        if name[:2] in ("MD", "MS", "GD", "GS"):
            raise SensorError(f"{name} asks for a scan", remedy="use scan() or scans()")
        try:
            return must_answer(line, scip.command(name, parameter, string).rstrip())
        except Unplugged as error:
            raise SensorError("the rangefinder was unplugged", file=line.port) from error

    def state(self) -> dict[str, str]:
        """The answer to II: laser, motor, mode, clock (``TIME``, hexadecimal ms), health."""
        return fields(self.query("II"))

    def laser_on(self) -> None:
        """Switch the laser on, as :meth:`scan` needs it (BM)."""
        self.query("BM")

    def laser_off(self) -> None:
        """Switch the laser off and end any stream (QT)."""
        self._streaming = False
        self.query("QT")

    def reset(self) -> None:
        """Laser off, any stream ended, clock, motor speed and baud rate as after switching on (RS)."""
        self._streaming = False
        self.query("RS")
        self._unwrap, self._host = StampUnwrapper(), self._new_clock()

    def set_motor_speed(self, step: int) -> None:
        """Slow the motor down by 1 to 10 steps, 0 for the default, 99 for a reset (CR)."""
        self.query("CR", f"{step:02d}")

    def set_high_sensitivity(self, on: bool) -> None:
        """High sensitivity on or off (HS)."""
        self.query("HS", f"{int(on)}")

    def set_baud(self, baud: int) -> None:
        """Baud rate (SS); on USB it has no effect."""
        self.query("SS", f"{baud:06d}")

    def scan(self, start: int | None = None, end: int | None = None, cluster: int = 1) -> Sweep:
        """Measure one turn (GD); the laser is switched on for it and left on.

        Raises
        ------
        SensorError
            When no whole scan comes.
        """
        line = self._open_line()
        self._insist_on_rest()
        request = self._request("GD", start, end, cluster, 0)
        self.laser_on()
        try:
            line.parser.expect = request
            for _ in range(3):
                line.scans.clear()
                line.replies.clear()
                line.write(request.encode() + b"\n")
                scan = next_scan(line, request, self.parameters.period)
                if scan is not None:
                    return self._sweep(*scan, index=self._counts["sweeps"])
        except Unplugged as error:
            raise SensorError("the rangefinder was unplugged", file=line.port) from error
        finally:
            line.parser.expect = None
        raise SensorError("no whole scan came", file=line.port)

    def scans(
        self,
        start: int | None = None,
        end: int | None = None,
        *,
        cluster: int = 1,
        skip: int = 0,
        count: int | None = None,
        short: bool = False,
    ) -> Iterator[Sweep]:
        """Measure turn after turn; the laser goes on now and off when the iteration ends, however it ends.

        A broken scan is counted and left out. After unplugging or a silence the stream is taken up again.

        Parameters
        ----------
        start, end : int, optional
            First and last step, the device's own by default; ``parameters.steps`` finds them for bearings.
        cluster : int
            Steps merged into one value, the least valid one.
        skip : int
            Turns left out between two, 0 to 9.
        count : int, optional
            Sweeps to deliver; endless by default.
        short : bool
            Two characters a value (MS): ranges end at 4.095 m.

        Raises
        ------
        SensorError
            When the device refuses, reports broken hardware, or does not come back.
        """
        self._insist_on_rest()
        request = self._request("MS" if short else "MD", start, end, cluster, skip)
        delivered = failures = 0
        last: float | None = None
        begun = False
        self._streaming = True
        try:
            while self._streaming and (count is None or delivered < count):
                try:
                    if not begun:
                        begun = begin_stream(self._open_line(), request)
                        order = StampOrder(self.parameters.period * (skip + 1))
                    scan = self._next(request) if begun else None
                except Unplugged as error:
                    self._counts["unplugged"] += 1
                    self._come_back(error)
                    begun, last = False, None
                    continue
                if scan is None and self._over():
                    break
                if scan is None:
                    failures += 1
                    self._counts["silent"] += 1
                    self._wake(failures)
                    begun = False
                    continue
                if not order.believes(scan[0].stamp):
                    self._counts["damaged"] += 1
                    continue
                sweep = self._sweep(*scan, index=delivered)
                self._count_missing(last, sweep.stamp_device, skip)
                last, failures = sweep.stamp_device, 0
                delivered += 1
                yield sweep
        finally:
            self._end()

    def _request(self, name: str, start: int | None, end: int | None, cluster: int, skip: int) -> ScanRequest:
        has = self.parameters
        first, last = has.amin if start is None else start, has.amax if end is None else end
        if last > has.amax:
            raise SensorError(f"step {last} is beyond the device's last, {has.amax}")
        return ScanRequest(name, first, last, cluster, skip)

    def _insist_on_rest(self) -> None:
        if self._streaming:
            raise SensorError("a stream is running", remedy="take its next sweep, or end it first")

    def _over(self) -> bool:
        return not self._streaming

    def _next(self, request: ScanRequest) -> tuple[ScanReply, float] | None:
        return next_scan(self._open_line(), request, self.parameters.period, self._over)

    def _new_clock(self) -> HostClock:
        return HostClock(SCAN_PHASE * self.parameters.period)

    def _sweep(self, scan: ScanReply, arrival: float, index: int) -> Sweep:
        stamp = self._unwrap(scan.stamp) / 1000.0
        self._host.observe(stamp, arrival)
        self._counts["sweeps"] += 1
        began = self._host.to_host(stamp)
        return Sweep.from_values(index, scan.values, scan.request, self.parameters, stamp, began, arrival)

    def _count_missing(self, last: float | None, stamp: float, skip: int) -> None:
        if last is not None:
            turns = round((stamp - last) / (self.parameters.period * (skip + 1)))
            self._counts["missing"] += max(turns - 1, 0)

    def _wake(self, failures: int) -> None:
        """Bring a device that fell silent to rest, to start the stream anew."""
        line = self._open_line()
        line.parser.expect = None
        silent = SensorError("the rangefinder fell silent", file=line.port, remedy="look after its cable")
        if failures > 3:
            raise silent
        self._told(f"{line.port}: the rangefinder fell silent; starting it anew")
        try:
            start_up(line, self._timeout)
        except Unplugged:
            pass  # the next request finds out, and counts it
        except SensorError as error:
            raise silent from error

    def _come_back(self, cause: Unplugged) -> None:
        """Wait until the device is there again and open it."""
        old = self._open_line()
        self._line = None
        atexit.unregister(self.close)
        old.close()
        self._take_counts(old)
        deadline = time.monotonic() + self._reconnect
        self._told(f"{old.port}: the rangefinder was unplugged; waiting {self._reconnect:g} s for it")
        while True:
            try:
                self.open()
                self._told(f"{self.port}: the rangefinder is back")
                return
            except SensorError as error:
                if time.monotonic() >= deadline:
                    raise SensorError(
                        f"unplugged, and not back within {self._reconnect:g} s",
                        file=old.port,
                        remedy=str(error),
                    ) from cause
            time.sleep(0.05)

    def _end(self) -> None:
        """End a stream: laser off, and nothing of it is taken for the next one's."""
        self._streaming = False
        line = self._line
        if line is None:
            return
        with contextlib.suppress(Unplugged):
            line.ask(b"QT", 0.5)
        line.parser.expect = None
        line.scans.clear()

    def _take_counts(self, line: Line) -> None:
        self._counts["damaged"] += line.damaged
        self._counts["noise"] += line.noise

    def _open_line(self) -> Line:
        if self._line is None:
            raise SensorError(
                "the rangefinder is not open", remedy="use it as a context manager, or call open()"
            )
        return self._line

    def device_seconds(self) -> float:
        """The device's clock now (II), s, on the scale of ``stamp_device``; NaN when it does not say."""
        ticks = device_time(self.state())
        return float("nan") if ticks is None else self._unwrap(ticks) / 1000.0
