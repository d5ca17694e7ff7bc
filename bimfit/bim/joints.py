"""Finds the joints of a model: pairs of elements that face each other across a gap."""

from __future__ import annotations

import difflib
import hashlib
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bimfit.bim.drafts import Draft, Limits, find_drafts
from bimfit.bim.joint import Joint
from bimfit.bim.joint_store import load_joints, store_joints, store_key
from bimfit.bim.model import Element, Model
from bimfit.config import JointConfig
from bimfit.errors import JointError

# fmt: off
_NEVER = (
    "IfcDoor", "IfcWindow", "IfcFurni", "IfcSystemFurni", "IfcFlow", "IfcDistribution", "IfcReinforc",
    "IfcTendon", "IfcFastener", "IfcMechanicalFastener", "IfcTransport", "IfcSanitary", "IfcLamp",
    "IfcLight", "IfcOutlet", "IfcSwitch", "IfcAirTerminal", "IfcValve", "IfcSensor", "IfcActuator",
    "IfcAlarm", "IfcAnnotation", "IfcSpace", "IfcOpening", "IfcVirtual", "IfcGeographic", "IfcElectric",
    "IfcCable", "IfcSpatial", "IfcGrid", "IfcPort", "IfcSite", "IfcBuildingStorey",
)
# fmt: on
_NEVER_LOWER = tuple(name.lower() for name in _NEVER)
_STATES = ("open", "filled", "touch", "clash")
_RANK = {state: rank for rank, state in enumerate(_STATES)}
_HIDDEN = ("sheet", "patch")
_DIGITS = "23456789abcdefghjkmnpqrstvwxyz"
_ID_LENGTH, _MOST_DIGITS = 5, 12
_USUAL = JointConfig()
_LOOSE = (0.06, 0.12, 0.25, 0.5)


def find_joints(model: Model, config: JointConfig | None = None) -> tuple[Joint, ...]:
    """Find a model's joints.

    Two plane faces of different elements make a joint where they face each other within 10 degrees of
    parallel, at most ``config.max_gap`` apart, with nothing but perhaps a filler between them; strips of one
    pair of elements are joined along straight, polyline, curved and closed paths. Edges prepared as a groove
    count too.

    Parameters
    ----------
    model : Model
    config : JointConfig

    Returns
    -------
    tuple of Joint
        Open ones first, then filled, touching and overlapping ones; within these by GlobalIds. The same
        model gives the same ids in the same order.
    """
    config = config or JointConfig()
    eligible = np.array([_eligible(element, config) for element in model.elements], bool)
    limits = Limits(max_gap=config.max_gap, min_length=config.min_length)
    joints = _kept_joints(model, eligible, limits)
    return tuple(joint for joint in joints if _listed(joint, config))


def joint_between(model: Model, guid_a: str, guid_b: str, config: JointConfig | None = None) -> Joint:
    """The joint between two elements, even where :func:`find_joints` would not list it.

    Searches with the finder's own limits first, then for wider gaps (up to 0.5 m), wider angles and smaller
    faces. Of several, open ones come before filled, touching and overlapping ones, then the longest.

    Raises
    ------
    JointError
        When an element does not exist, or no two of their faces face each other; says why.
    """
    first, second = (model.element(guid) for guid in (guid_a, guid_b))
    if first.guid == second.guid:
        raise JointError(f"a joint takes two elements; {guid_a} is named twice", file=model.path)
    config = config or JointConfig()
    joints = _pair_joints(model, first, second, config)
    if not joints:
        raise JointError(_why_none(first, second), file=model.path)
    return min(joints, key=lambda joint: (_RANK[joint.state], -joint.length))


def select_joints(
    model: Model, wanted: Sequence[str], config: JointConfig | None = None
) -> tuple[Joint, ...]:
    """The joints that a user asks for.

    Parameters
    ----------
    model : Model
    wanted : sequence of str
        Joint ids and pairs "GUID,GUID"; a pair stands for all of its joints. Empty: all joints.
    config : JointConfig

    Raises
    ------
    JointError
        For an id that does not exist (the nearest are named) or a pair without a joint.
    """
    config = config or JointConfig()
    known: dict[str, Joint] | None = None
    chosen: dict[str, Joint] = {}
    if not wanted:
        return find_joints(model, config)
    for item in wanted:
        if "," in item:
            guids = [guid.strip() for guid in item.split(",")]
            if len(guids) != 2 or not all(guids):
                raise JointError(f"{item} is not a pair", file=model.path, remedy="write GUID,GUID")
            found = _pair(model, guids[0], guids[1], config)
        else:
            if known is None:
                everything = replace(config, everything=True)
                known = {joint.id: joint for joint in find_joints(model, everything)}
            found = (_by_id(model, known, item.strip()),)
        chosen.update((joint.id, joint) for joint in found)
    return tuple(chosen.values())


def no_joint_reason(model: Model, config: JointConfig | None = None) -> str:
    """Why a model has no joints, for a message to its user."""
    config = config or JointConfig()
    count = len(model.elements)
    eligible = sum(_eligible(element, config) for element in model.elements)
    if count < 2:
        return "it has one element only"
    if eligible < 2:
        where = (
            "of the classes and storeys asked for"
            if config.classes or config.storeys
            else "that can form joints"
        )
        return f"{eligible} of its {count} elements are {where}"
    gap, length = config.max_gap * 1e3, config.min_length * 1e3
    return (
        f"no two of its {eligible} elements face each other within {gap:.0f} mm over {length:.0f} mm or more"
    )


def _by_id(model: Model, known: dict[str, Joint], name: str) -> Joint:
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    if near:
        remedy = f"the nearest are {', '.join(near)}"
    else:
        remedy = f"bimfit joints lists its {len(known)}" if known else no_joint_reason(model)
    raise JointError(f"no joint has the id {name}", file=model.path, remedy=remedy)


def _pair(model: Model, guid_a: str, guid_b: str, config: JointConfig) -> tuple[Joint, ...]:
    best = joint_between(model, guid_a, guid_b, config)
    listed = _pair_joints(model, model.element(guid_a), model.element(guid_b), config)
    same = [
        joint
        for joint in listed
        if joint.state == best.state and joint.kind not in _HIDDEN and joint.accessible
    ]
    return tuple(same) if any(joint.id == best.id for joint in same) else (best,)


def _pair_joints(model: Model, first: Element, second: Element, config: JointConfig) -> tuple[Joint, ...]:
    """The joints of one pair, with limits that widen until there is one."""
    elements = _surroundings(model, first, second, _LOOSE[-1])
    eligible = np.array([element.guid in (first.guid, second.guid) for element in elements])
    joints = _joints(elements, eligible, Limits(max_gap=config.max_gap, min_length=config.min_length))
    if joints:
        return joints
    for gap in _LOOSE:
        limits = Limits(
            max_gap=max(gap, config.max_gap),
            max_angle=np.radians(60.0),
            min_area=1e-5,
            min_diagonal=0.005,
            min_length=0.01,
            min_depth=0.001,
        )
        joints = _joints(elements, eligible, limits)
        if joints:
            break
    return joints


def _surroundings(model: Model, first: Element, second: Element, reach: float) -> list[Element]:
    """The two elements and all that may lie between them."""
    a, b = first.mesh.bounds, second.mesh.bounds
    low = np.maximum(a[0], b[0]) - reach
    high = np.minimum(a[1], b[1]) + reach
    out = []
    for element in model.elements:
        box = element.mesh.bounds
        if element.guid in (first.guid, second.guid) or (np.all(box[0] <= high) and np.all(box[1] >= low)):
            out.append(element)
    return out


def _why_none(first: Element, second: Element) -> str:
    a, b = first.mesh.bounds, second.mesh.bounds
    apart = np.maximum(0.0, np.maximum(a[0] - b[1], b[0] - a[1]))
    distance = float(np.linalg.norm(apart))
    pair = f"there is no joint between {first.guid} and {second.guid}"
    if distance > _LOOSE[-1]:
        return f"{pair}: they are {distance:.2f} m apart"
    return f"{pair}: none of their faces face each other within {_LOOSE[-1]:g} m with the way between free"


def _eligible(element: Element, config: JointConfig) -> bool:
    kind = element.ifc_class.lower()
    if config.storeys and element.storey not in config.storeys:
        return False
    if config.classes:
        return any(kind.startswith(name.lower()) for name in config.classes)
    return not kind.startswith(_NEVER_LOWER)


def _listed(joint: Joint, config: JointConfig) -> bool:
    if config.min_gap is not None and joint.width < config.min_gap:
        return False
    return config.everything or (joint.accessible and joint.kind not in _HIDDEN)


def _kept_joints(model: Model, eligible: NDArray[np.bool_], limits: Limits) -> tuple[Joint, ...]:
    """The model's joints, out of the cache where the same search was made before."""
    if not model.cached:
        return _joints(model.elements, eligible, limits)
    key = store_key(model.elements, eligible, limits)
    joints = load_joints(key, model.elements)
    if joints is None:
        joints = _joints(model.elements, eligible, limits)
        store_joints(key, joints, model.elements)
    return joints


def _joints(elements: Sequence[Element], eligible: NDArray[np.bool_], limits: Limits) -> tuple[Joint, ...]:
    """Run the finder and number its joints; ``elements`` come sorted by GlobalId."""
    drafts = [
        draft
        for draft in find_drafts([element.mesh for element in elements], eligible, limits)
        if not _related(elements[draft.a], elements[draft.b])
    ]
    by_pair: dict[tuple[int, int], list[Draft]] = defaultdict(list)
    for draft in drafts:
        by_pair[draft.a, draft.b].append(draft)
    numbered: list[tuple[str, Draft]] = []
    for pair in sorted(by_pair):
        name = f"{elements[pair[0]].guid} {elements[pair[1]].guid}"
        group = by_pair[pair]
        ordered = sorted(group, key=_place) if len(group) > 1 else group
        numbered.extend((f"{name} {k}", draft) for k, draft in enumerate(ordered))
    ids = _ids([name for name, _ in numbered])
    joints = [_joint(i, draft, elements) for i, (_, draft) in zip(ids, numbered, strict=True)]
    return tuple(sorted(joints, key=lambda joint: _RANK[joint.state]))


def _related(a: Element, b: Element) -> bool:
    return a.guid == b.parent_guid or b.guid == a.parent_guid


def _place(draft: Draft) -> tuple[float, ...]:
    """What orders the joints of one pair: state, length, then the place to a millimetre.

    Those that only other limits than the usual ones find come last: so the others keep their numbers.
    """
    middle = np.round(draft.path.points.mean(axis=0), 3)
    unusual = draft.leg.gap > _USUAL.max_gap or draft.leg.length < _USUAL.min_length
    return (
        float(unusual),
        float(_RANK[draft.state]),
        -round(draft.leg.length, 3),
        *(float(x) for x in middle),
    )


def _ids(names: Sequence[str]) -> list[str]:
    """Short ids that follow from the names alone; two names that would share one get longer ones."""
    length = _ID_LENGTH
    out = [_code(name, length) for name in names]
    while len(set(out)) < len(out) and length < _MOST_DIGITS:
        length += 1
        counts = Counter(out)
        out = [
            _code(name, length) if counts[short] > 1 else short
            for name, short in zip(names, out, strict=True)
        ]
    return out


def _code(name: str, length: int) -> str:
    number = int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big")
    digits = []
    for _ in range(length):
        number, digit = divmod(number, len(_DIGITS))
        digits.append(_DIGITS[digit])
    return "".join(digits)


def _joint(name: str, draft: Draft, elements: Sequence[Element]) -> Joint:
    leg = draft.leg
    return Joint(
        id=name,
        elements=(elements[draft.a].guid, elements[draft.b].guid),
        kind=draft.kind,  # type: ignore[arg-type]
        width=leg.gap,
        length=leg.length,
        depth=leg.depth,
        path=draft.path,
        two_sided=all(draft.free),
        state=draft.state,  # type: ignore[arg-type]
        filler=elements[draft.filler].guid if draft.filler >= 0 else None,
        widths=(leg.low, leg.high),
        accessible=any(draft.free),
        legs=leg.legs,
    )
