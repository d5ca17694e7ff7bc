"""bimfit: what a building joint really looks like.

The public names; each is imported when it is first used, so that ``import bimfit`` costs next to nothing.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "BimfitError": "bimfit.errors",
    "Config": "bimfit.config",
    "load_config": "bimfit.config",
    "Pose2D": "bimfit.geometry.pose",
    "Profile": "bimfit.geometry.profile",
    "SectionFrame": "bimfit.geometry.frame",
    "Slice": "bimfit.geometry.slice",
    "TriangleMesh": "bimfit.geometry.mesh",
    "LineScan": "bimfit.geometry.line_scan",
    "PointCloud": "bimfit.scan.cloud",
    "read_scan": "bimfit.scan.formats",
    "write_scan": "bimfit.scan.formats",
    "scan_chunks": "bimfit.scan.formats",
    "ReadOptions": "bimfit.scan.formats.options",
    "convert": "bimfit.pipeline.convert",
    "load_model": "bimfit.bim.model",
    "model_from_elements": "bimfit.bim.model",
    "element_from_mesh": "bimfit.bim.model",
    "find_joints": "bimfit.bim.joints",
    "joint_between": "bimfit.bim.joints",
    "MATCHERS": "bimfit.registration.matchers",
    "MatchResult": "bimfit.registration.result",
    "Target": "bimfit.registration.table",
    "place_cloud": "bimfit.registration.placement",
    "cut_joint": "bimfit.pipeline.survey",
    "fit_joint": "bimfit.pipeline.fit",
    "survey": "bimfit.pipeline.survey",
    "compare": "bimfit.pipeline.compare",
    "simulate": "bimfit.pipeline.simulate",
    "Scenario": "bimfit.simulation.scenario",
    "write_survey": "bimfit.pipeline.output",
    "write_pictures": "bimfit.pipeline.pictures",
    "Selection": "bimfit.bim.selection",
    "choose_joints": "bimfit.bim.selection",
    "Limits": "bimfit.pipeline.limits",
    "judge": "bimfit.pipeline.limits",
    "read_results": "bimfit.pipeline.document",
    "write_schedule": "bimfit.pipeline.schedule",
    "write_issues": "bimfit.pipeline.issues",
    "write_report": "bimfit.pipeline.report",
}

__all__ = [
    "MATCHERS",
    "BimfitError",
    "Config",
    "Limits",
    "LineScan",
    "MatchResult",
    "PointCloud",
    "Pose2D",
    "Profile",
    "ReadOptions",
    "Scenario",
    "SectionFrame",
    "Selection",
    "Slice",
    "Target",
    "TriangleMesh",
    "__version__",
    "choose_joints",
    "compare",
    "convert",
    "cut_joint",
    "element_from_mesh",
    "find_joints",
    "fit_joint",
    "joint_between",
    "judge",
    "load_config",
    "load_model",
    "model_from_elements",
    "place_cloud",
    "read_results",
    "read_scan",
    "scan_chunks",
    "simulate",
    "survey",
    "write_issues",
    "write_pictures",
    "write_report",
    "write_scan",
    "write_schedule",
    "write_survey",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'bimfit' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


if TYPE_CHECKING:
    from bimfit.bim.joints import find_joints, joint_between
    from bimfit.bim.model import element_from_mesh, load_model, model_from_elements
    from bimfit.bim.selection import Selection, choose_joints
    from bimfit.config import Config, load_config
    from bimfit.errors import BimfitError
    from bimfit.geometry.frame import SectionFrame
    from bimfit.geometry.line_scan import LineScan
    from bimfit.geometry.mesh import TriangleMesh
    from bimfit.geometry.pose import Pose2D
    from bimfit.geometry.profile import Profile
    from bimfit.geometry.slice import Slice
    from bimfit.pipeline.compare import compare
    from bimfit.pipeline.convert import convert
    from bimfit.pipeline.document import read_results
    from bimfit.pipeline.fit import fit_joint
    from bimfit.pipeline.issues import write_issues
    from bimfit.pipeline.limits import Limits, judge
    from bimfit.pipeline.output import write_survey
    from bimfit.pipeline.pictures import write_pictures
    from bimfit.pipeline.report import write_report
    from bimfit.pipeline.schedule import write_schedule
    from bimfit.pipeline.simulate import simulate
    from bimfit.pipeline.survey import cut_joint, survey
    from bimfit.registration.matchers import MATCHERS
    from bimfit.registration.placement import place_cloud
    from bimfit.registration.result import MatchResult
    from bimfit.registration.table import Target
    from bimfit.scan.cloud import PointCloud
    from bimfit.scan.formats import read_scan, scan_chunks, write_scan
    from bimfit.scan.formats.options import ReadOptions
    from bimfit.simulation.scenario import Scenario
