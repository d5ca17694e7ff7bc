"""Line scans. The noun itself lies in geometry: the virtual and the live sensor make it too."""

from __future__ import annotations

from bimfit.geometry.line_scan import LineScan, joined

__all__ = ["LineScan", "joined"]
