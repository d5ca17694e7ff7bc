"""Write the as-built result back into the building model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bimfit.bim.ifc_writer import IfcWriter
from bimfit.bim.opening import open_ifc
from bimfit.errors import ExportError, JointError
from bimfit.files import protect_inputs, whole_file
from bimfit.geometry.mesh import TriangleMesh
from bimfit.geometry.pose import Array

GAP_CLASS, GAP_TYPE = "IfcVirtualElement", "AsBuiltGap"
GAP_SET = "BimfitPset_AsBuiltGap"
GAP_QUANTITIES = "BimfitQto_AsBuiltGap"
DEVIATION_SET = "BimfitPset_AsBuiltDeviation"


@dataclass(frozen=True)
class AsBuiltGap:
    """What is known of a joint's gap as built; None where it is not known.

    Attributes
    ----------
    id, kind : str
        The joint's id and kind.
    elements : tuple of two str
        GlobalIds of A and B.
    status, reason : str
        The verdict, and why where it is not ``ok``.
    designed_width : float
        m.
    contact : str
        How close the components come: ``clear``, ``touch``, ``possible clash``, ``clash``; empty where not
        known.
    width_min, width_mean, width_max, width_sigma : float or None
        Width of the mouth along the joint and the standard deviation of its estimate, m; negative where the
        components overlap.
    length : float or None
        m.
    area : float or None
        Mean area of the gap's cross-section, m^2.
    volume, volume_sigma : float or None
        m^3.
    stations, measured : int
        How many stations there are, and at how many the gap was measured.
    mesh : TriangleMesh or None
        The gap in world coordinates, m: closed bodies.
    """

    id: str
    kind: str
    elements: tuple[str, str]
    status: str
    designed_width: float
    reason: str = ""
    width_min: float | None = None
    width_mean: float | None = None
    width_max: float | None = None
    width_sigma: float | None = None
    length: float | None = None
    area: float | None = None
    volume: float | None = None
    volume_sigma: float | None = None
    stations: int = 0
    measured: int = 0
    contact: str = ""
    mesh: TriangleMesh | None = None


@dataclass(frozen=True)
class MovedElement:
    """How far an element is from its design.

    Attributes
    ----------
    motion : array_like, shape (4, 4)
        World motion, m: as built = motion * designed.
    stations : int or None
        How many stations it rests on.
    rms : float or None
        How far these are from a rigid motion, m.
    undetermined : int or None
        How many of the six directions of motion the scan says nothing about.
    """

    motion: ArrayLike
    stations: int | None = None
    rms: float | None = None
    undetermined: int | None = None


def write_as_built(
    model: str | Path,
    gaps: Sequence[AsBuiltGap],
    output: str | Path,
    *,
    moved: Mapping[str, MovedElement | ArrayLike] | None = None,
) -> Path:
    """Write the model with what was found: every gap an IfcVirtualElement, components moved if asked.

    All that is in the model stays as it is, GlobalIds included. A gap's element has the gap mesh as its body,
    lies in the storey of the joint's first component, carries a property set and quantities in the project's
    units, and is tied to both components by IfcRelConnectsElements. Its GlobalId follows from the project's
    and the joint's id.

    Parameters
    ----------
    model : path
        The IFC that the joints come from; never written to.
    gaps : sequence of AsBuiltGap
    output : path
        The ``.ifc`` to write, whole or not at all.
    moved : mapping of str to MovedElement or array_like (4, 4), optional
        GlobalId -> world motion (m) that carries the designed element to where it is: its placement is moved,
        parts, openings and what fills them with it, and the deviation is noted in a property set. Nothing
        else moves, whatever its placement is relative to.

    Returns
    -------
    Path
        ``output``.

    Raises
    ------
    ModelError, JointError
        When the model cannot be read, or an element is not in it.
    ExportError
        When the output cannot be written or is the input.
    """
    target = Path(output)
    protect_inputs([target], [Path(model)])
    writer = IfcWriter(open_ifc(model), "bimfit as-built")
    for gap in gaps:
        _add_gap(writer, gap, Path(model))
    _move_all(writer, moved or {}, Path(model))
    with whole_file(target) as part:
        try:
            writer.file.write(str(part))
        except RuntimeError as error:
            raise ExportError(f"cannot be written: {error}", file=target) from error
    return target


def _element(writer: IfcWriter, guid: str, path: Path) -> Any:
    try:
        found = writer.file.by_guid(guid)
    except RuntimeError:
        found = None
    if found is None or not found.is_a("IfcElement"):
        raise JointError(f"no element has the GlobalId {guid}", file=path)
    return found


def _add_gap(writer: IfcWriter, gap: AsBuiltGap, path: Path) -> None:
    components = [_element(writer, guid, path) for guid in gap.elements]
    container = writer.container(components[0]) or writer.container(components[1])
    element = writer.root(
        GAP_CLASS,
        f"as-built gap {gap.id}",
        Description=" / ".join(part.Name or part.GlobalId for part in components),
        ObjectType=GAP_TYPE,
    )
    if gap.mesh is not None and len(gap.mesh.faces):
        writer.give_mesh(element, gap.mesh, container)
    if container is not None:
        writer.contain(element, container)
    for component, letter in zip(components, "AB", strict=True):
        writer.root(
            "IfcRelConnectsElements",
            f"as-built gap {gap.id} to {letter}",
            RelatingElement=component,
            RelatedElement=element,
        )
    length = writer.length
    properties = {
        "JointId": ("IfcIdentifier", gap.id[:255]),
        "Kind": ("IfcLabel", gap.kind),
        "Status": ("IfcLabel", gap.status),
        "Reason": ("IfcText", gap.reason or None),
        "Contact": ("IfcLabel", gap.contact or None),
        "DesignedWidth": ("IfcLengthMeasure", length(gap.designed_width)),
        "WidthMin": ("IfcLengthMeasure", length(gap.width_min)),
        "WidthMean": ("IfcLengthMeasure", length(gap.width_mean)),
        "WidthMax": ("IfcLengthMeasure", length(gap.width_max)),
        "WidthSigma": ("IfcLengthMeasure", length(gap.width_sigma)),
        "Length": ("IfcLengthMeasure", length(gap.length)),
        "Area": ("IfcAreaMeasure", writer.area(gap.area)),
        "Volume": ("IfcVolumeMeasure", writer.volume(gap.volume)),
        "VolumeSigma": ("IfcVolumeMeasure", writer.volume(gap.volume_sigma)),
        "Stations": ("IfcInteger", int(gap.stations)),
        "MeasuredStations": ("IfcInteger", int(gap.measured)),
    }
    writer.add_properties(element, GAP_SET, properties)
    quantities = {
        "Length": ("Length", length(gap.length)),
        "WidthMin": ("Length", length(gap.width_min)),
        "Width": ("Length", length(gap.width_mean)),
        "WidthMax": ("Length", length(gap.width_max)),
        "CrossSectionArea": ("Area", writer.area(gap.area)),
        "Volume": ("Volume", writer.volume(gap.volume)),
    }
    writer.add_quantities(element, GAP_QUANTITIES, quantities)


def _move_all(writer: IfcWriter, moved: Mapping[str, MovedElement | ArrayLike], path: Path) -> None:
    """Move elements by their world motions and note the deviations."""
    motions: dict[Any, Array] = {}
    for guid, given in sorted(moved.items()):
        element = _element(writer, guid, path)
        about = given if isinstance(given, MovedElement) else MovedElement(given)
        motion = np.asarray(about.motion, float)
        if motion.shape != (4, 4) or not np.all(np.isfinite(motion)):
            raise ExportError(f"the motion of {guid} is not a finite 4 x 4 matrix")
        movable = writer.has_local_placement(element)
        if movable:
            motions[element] = motion
        _note_deviation(writer, element, about, motion, movable)
    writer.move(motions)


def _note_deviation(
    writer: IfcWriter, element: Any, about: MovedElement, motion: Array, movable: bool
) -> None:
    # The shift of the element's own origin says more than that of the world's, which may be far away.
    before = writer.world_placement(element) if movable else np.eye(4)
    shift = (motion @ before - before)[:3, 3]
    turn = math.atan2(
        float(np.linalg.norm(_axial(motion[:3, :3]))), 0.5 * (float(np.trace(motion[:3, :3])) - 1.0)
    )
    properties = {
        "Moved": ("IfcBoolean", movable),
        "Reason": ("IfcText", None if movable else "its placement is not a local one, and was left"),
        **{
            f"Shift{axis}": ("IfcLengthMeasure", writer.length(float(d)))
            for axis, d in zip("XYZ", shift, strict=True)
        },
        "Distance": ("IfcLengthMeasure", writer.length(float(np.linalg.norm(shift)))),
        "Rotation": ("IfcPlaneAngleMeasure", writer.angle(turn)),
        "Stations": ("IfcInteger", about.stations),
        "ResidualRms": ("IfcLengthMeasure", writer.length(about.rms)),
        "UndeterminedDirections": ("IfcInteger", about.undetermined),
    }
    writer.add_properties(element, DEVIATION_SET, properties)


def _axial(R: Array) -> Array:
    """Rotation axis times the sine of the angle, shape (3,)."""
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
