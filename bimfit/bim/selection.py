"""Which of a model's joints a user means: by name, class, storey, size, or an IfcOpenShell selector."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bimfit.bim.joint import Joint
from bimfit.bim.joints import find_joints, no_joint_reason, select_joints
from bimfit.bim.model import Element, Model
from bimfit.bim.opening import open_ifc
from bimfit.bim.source import nearest_schema
from bimfit.config import JointConfig
from bimfit.errors import ConfigError, JointError

_MOST_NAMED, _SLACK = 12, 1e-6
_EXAMPLE = "write it as IfcWall, Name=/W.*/"


@dataclass(frozen=True)
class Selection:
    """What is asked for; everything that is given must hold.

    Attributes
    ----------
    names : tuple of str
        Joint ids and pairs "GUID,GUID". Named joints need not be among those that the finder lists.
    pairs : Path or None
        A JSON file of more names, see :func:`read_pairs`.
    classes, storeys : tuple of str
        Both elements are of one of these IFC classes (their subclasses count) and in one of these storeys.
    width : tuple of two float or None
        Least and greatest mean designed gap, m; negative where elements overlap. ``inf`` leaves an end open.
    min_length : float or None
        Shortest joint, m.
    selector : str
        An IfcOpenShell selector that finds both elements, or the wholes that they are parts of.
    everything : bool
        Also what is seldom a joint that anyone works on (:attr:`JointConfig.everything`).
    """

    names: tuple[str, ...] = ()
    pairs: Path | None = None
    classes: tuple[str, ...] = ()
    storeys: tuple[str, ...] = ()
    width: tuple[float, float] | None = None
    min_length: float | None = None
    selector: str = ""
    everything: bool = False

    @property
    def named(self) -> bool:
        """Whether joints are asked for one by one."""
        return bool(self.names) or self.pairs is not None

    @property
    def given(self) -> bool:
        """Whether anything at all narrows the choice."""
        return self != Selection(everything=self.everything)


def choose_joints(
    model: Model, wanted: Selection | Sequence[str] = (), config: JointConfig | None = None
) -> tuple[Joint, ...]:
    """The joints that a user means.

    The finder runs with its own limits, widened where a wider gap or a shorter joint is asked for, and what
    it finds is narrowed afterwards: a joint keeps its id however it was chosen, unless a wider gap makes it
    part of a larger joint.

    Parameters
    ----------
    model : Model
    wanted : Selection, or sequence of str
        A sequence is taken as :attr:`Selection.names`.
    config : JointConfig

    Returns
    -------
    tuple of Joint
        In the finder's order; named ones in the order of their names.

    Raises
    ------
    JointError
        When a name, class or storey does not exist, or nothing is left; says what there is.
    ConfigError
        For a selector or a file of pairs that cannot be read.
    """
    choice = wanted if isinstance(wanted, Selection) else Selection(names=tuple(wanted))
    elements = _Elements.of(model, choice)
    rules = _finder_rules(choice, elements, config or JointConfig())
    if choice.named:
        named = [select_joints(model, [name], rules) for name in choice.names]
        if choice.pairs is not None:
            named += [_listed_pair(model, pair, rules, choice.pairs) for pair in read_pairs(choice.pairs)]
        found = tuple({joint.id: joint for joints in named for joint in joints}.values())
    else:
        found = find_joints(model, rules)
    if not found:
        remedy = "name the pair with --joint GUID,GUID or widen --width"
        remedy = "; ".join([*(note for note in model.notes if "cut off" in note), remedy])
        raise JointError(f"no joint found: {no_joint_reason(model, rules)}", file=model.path, remedy=remedy)
    kept = tuple(
        joint
        for joint in found
        if _fits(joint, choice) and all(elements.has(model.element(guid)) for guid in joint.elements)
    )
    if not kept:
        raise JointError(_why_nothing(found, choice), file=model.path, remedy="bimfit joints lists them")
    return kept


@dataclass(frozen=True)
class _Elements:
    """Which elements are asked for: their classes, their storeys, and GlobalIds; None: any."""

    classes: frozenset[str] | None
    storeys: frozenset[str] | None
    chosen: frozenset[str] | None

    @classmethod
    def of(cls, model: Model, choice: Selection) -> _Elements:
        classes = frozenset(kind for name in choice.classes for kind in _classes(model, name)) or None
        storeys = frozenset(_storey(model, name) for name in choice.storeys) or None
        if not choice.selector:
            return cls(classes, storeys, None)
        chosen = _selected(model, choice.selector)
        # those with geometry, their classes among those that are asked for
        kinds = frozenset(element.ifc_class for element in model.elements if _among(element, chosen))
        if not kinds:
            reason = f"none of its elements with geometry is found by the selector {choice.selector!r}"
            raise JointError(reason, file=model.path)
        return cls(kinds if classes is None else classes & kinds, storeys, chosen)

    def has(self, element: Element) -> bool:
        """Whether an element is among them."""
        return (
            (self.classes is None or element.ifc_class in self.classes)
            and (self.storeys is None or element.storey in self.storeys)
            and (self.chosen is None or _among(element, self.chosen))
        )


def _finder_rules(choice: Selection, elements: _Elements, config: JointConfig) -> JointConfig:
    """The finder's settings: no narrower than its own, but for the elements that it looks at."""
    low, high = choice.width or (-math.inf, math.inf)
    rules = dataclasses.replace(
        config,
        max_gap=max(config.max_gap, high) if math.isfinite(high) else config.max_gap,
        min_length=min(config.min_length, choice.min_length or math.inf),
        min_gap=None if math.isfinite(low) else config.min_gap,
        everything=config.everything or choice.everything,
    )
    if choice.named:
        return rules
    return dataclasses.replace(
        rules,
        classes=config.classes if elements.classes is None else tuple(sorted(elements.classes)),
        storeys=config.storeys if elements.storeys is None else tuple(sorted(elements.storeys)),
    )


def _fits(joint: Joint, choice: Selection) -> bool:
    low, high = choice.width or (-math.inf, math.inf)
    # a designed 30 mm may be computed as 30.0000001
    return low - _SLACK <= joint.width <= high + _SLACK and (
        choice.min_length is None or joint.length >= choice.min_length - _SLACK
    )


def _why_nothing(found: Sequence[Joint], choice: Selection) -> str:
    widths, lengths = (
        [round(1e3 * joint.width, 1) + 0.0 for joint in found],
        [joint.length for joint in found],
    )
    asked = {
        "--class": choice.classes,
        "--storey": choice.storeys,
        "--width": choice.width,
        "--length": choice.min_length,
        "--select": choice.selector,
    }
    rules = " and ".join(name for name, given in asked.items() if given)
    if len(found) == 1:
        size = f"{widths[0]:.1f} mm wide and {lengths[0]:.3g} m long"
        return f"joint {found[0].id} does not fit {rules}: it is {size}"
    return (
        f"none of {len(found)} joints fits {rules}: they are {min(widths):.1f} to {max(widths):.1f} mm wide "
        f"and {min(lengths):.3g} to {max(lengths):.3g} m long"
    )


# -- classes and storeys ---------------------------------------------------------------------------


def _classes(model: Model, name: str) -> tuple[str, ...]:
    """Classes of the model's elements that are of the class asked for.

    Raises
    ------
    JointError
        When there is none; names those that there are.
    """
    there = sorted({element.ifc_class for element in model.elements if element.ifc_class})
    family = _family(model.schema, name)
    found = tuple(kind for kind in there if kind.lower() in family)
    if found:
        return found
    if family:
        raise JointError(f"no element is of class {name}", file=model.path, remedy=_there_is(there))
    known = {kind.lower(): kind for kind in there}
    near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.7)
    remedy = f"did you mean {known[near[0]]}?" if near else _there_is(there)
    raise JointError(f"there is no IFC class {name}", file=model.path, remedy=remedy)


def _family(schema: str, name: str) -> set[str]:
    """A class and all of its subclasses, lower case; empty where the schema has no such class."""
    import ifcopenshell

    try:
        definition = ifcopenshell.schema_by_name(nearest_schema(schema) or schema)
        waiting = [definition.declaration_by_name(name).as_entity()]
    except RuntimeError:
        return set()
    family: set[str] = set()
    while waiting:
        entity = waiting.pop()
        if entity is not None:
            family.add(entity.name().lower())
            waiting.extend(entity.subtypes())
    return family


def _storey(model: Model, name: str) -> str:
    """A storey's name as the model writes it; case and surrounding space do not matter."""
    there = sorted({element.storey for element in model.elements if element.storey})
    same = [storey for storey in there if storey == name] or [
        storey for storey in there if storey.strip().casefold() == name.strip().casefold()
    ]
    if same:
        return same[0]
    raise JointError(f"no element lies in a storey called {name!r}", file=model.path, remedy=_there_is(there))


def _there_is(names: Sequence[str]) -> str:
    if not names:
        return "the model names none"
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f"the model has {', '.join(names[:_MOST_NAMED])}{more}"


# -- selectors -------------------------------------------------------------------------------------


def _selected(model: Model, selector: str) -> frozenset[str]:
    """GlobalIds of what an IfcOpenShell selector finds in the model's file.

    Raises
    ------
    ConfigError
        When it is not a selector; says where.
    JointError
        When it finds nothing.
    """
    import ifcopenshell.util.selector as selectors

    file = open_ifc(model.path)
    try:
        found = selectors.filter_elements(file, selector)
    except Exception as error:  # lark's errors and ifcopenshell's share no base
        raise ConfigError(f"--select {selector!r}: {_parse_fault(error, selector)}") from error
    guids = frozenset(entity.GlobalId for entity in found if getattr(entity, "GlobalId", None))
    if not guids:
        raise JointError(f"nothing is found by the selector {selector!r}", file=model.path)
    return guids


def _parse_fault(error: Exception, selector: str) -> str:
    column = getattr(error, "column", None)
    if isinstance(column, int) and column > 0:
        return f"not an IfcOpenShell selector: column {column} is not understood; {_EXAMPLE}"
    if hasattr(error, "token") or "end-of-input" in str(error):
        return f"not an IfcOpenShell selector: it ends too early; {_EXAMPLE}"
    return (
        f"not an IfcOpenShell selector: {str(error).splitlines()[0] if str(error) else type(error).__name__}"
    )


def _among(element: Element, chosen: frozenset[str]) -> bool:
    return element.guid in chosen or (bool(element.parent_guid) and element.parent_guid in chosen)


# -- files of pairs --------------------------------------------------------------------------------


def read_pairs(path: str | Path) -> tuple[str | tuple[str, str], ...]:
    """Joints that a JSON file names.

    An array, each item of it a pair ``["GUID", "GUID"]``, a string (an id or ``"GUID,GUID"``), or an object
    with ``elements`` and perhaps ``id``, as ``bimfit joints --json`` and the ``joints`` of results.json have
    them; such an object may also be the whole file, with the array as its ``joints``.

    Returns
    -------
    tuple
        An id or "GUID,GUID" for each, or (id, "GUID,GUID") where both are given.

    Raises
    ------
    ConfigError
        Naming the file and the item that cannot be used.
    """
    file = Path(path)
    try:
        value = json.loads(file.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"cannot be read: {error.strerror}", file=file) from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"is not JSON: {error}", file=file) from error
    items = value.get("joints") if isinstance(value, dict) else value
    if not isinstance(items, list):
        raise ConfigError("holds no array of pairs", file=file, remedy='write [["GUID", "GUID"], ...]')
    if not items:
        raise ConfigError("names no pair", file=file, remedy='write [["GUID", "GUID"], ...]')
    return tuple(_pair_name(item, k, file) for k, item in enumerate(items))


def _pair_name(item: Any, index: int, file: Path) -> str | tuple[str, str]:
    guids = item.get("elements") if isinstance(item, dict) else item
    name = item.get("id") if isinstance(item, dict) else None
    if isinstance(guids, str) and guids.strip() and not isinstance(item, dict):
        return guids.strip()
    if isinstance(guids, list) and len(guids) == 2 and all(isinstance(g, str) and g for g in guids):
        pair = ",".join(guids)
        return (name, pair) if isinstance(name, str) and name else pair
    if guids is None and isinstance(name, str) and name:
        return name
    raise ConfigError(
        f"is not a pair: {json.dumps(item, ensure_ascii=False)[:60]}",
        file=file,
        place=f"item {index + 1}",
        remedy='write ["GUID", "GUID"]',
    )


def _listed_pair(
    model: Model, pair: str | tuple[str, str], rules: JointConfig, file: Path
) -> tuple[Joint, ...]:
    """The joints of a pair; just that one of them whose id is given with it, where there still is one."""
    name, guids = ("", pair) if isinstance(pair, str) else pair
    try:
        joints = select_joints(model, [guids], rules)
    except JointError as error:
        raise JointError(
            error.message, file=error.file, place=f"pair of {file}", remedy=error.remedy
        ) from error
    return tuple(joint for joint in joints if joint.id == name) or joints
