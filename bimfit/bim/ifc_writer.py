"""Add entities to an IFC file that is already there, in its schema and units."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping
from typing import Any

import numpy as np

from bimfit.geometry.mesh import Faces, TriangleMesh
from bimfit.geometry.pose import Array

_NAMESPACE = uuid.uuid5(uuid.NAMESPACE_URL, "https://example.org/bimfit/as-built")
_APPLICATION = "bimfit-as-built"


class IfcWriter:
    """An open IFC file, with helpers that take metres.

    Parameters
    ----------
    file : ifcopenshell.file
    author : str
        Named in the owner history where the schema asks for one.
    """

    def __init__(self, file: Any, author: str) -> None:
        import ifcopenshell.util.unit as units

        self.file = file
        self._metre = 1.0 / units.calculate_unit_scale(file)
        self._square = 1.0 / _scale(file, "AREAUNIT")
        self._cubic = 1.0 / _scale(file, "VOLUMEUNIT")
        self._radian = 1.0 / _scale(file, "PLANEANGLEUNIT")
        self._ids = {root.GlobalId for root in file.by_type("IfcRoot")}
        project = next(iter(file.by_type("IfcProject")), None)
        self._seed = project.GlobalId if project is not None else ""
        self._author = author
        # only IFC2X3 asks for one; made once
        self._history = self._owner_history() if file.schema == "IFC2X3" else None

    # -- units ---------------------------------------------------------------------------------

    def length(self, value: float | None) -> float | None:
        """Metres to the project's unit."""
        return None if value is None else float(value) * self._metre

    def area(self, value: float | None) -> float | None:
        """Square metres to the project's unit."""
        return None if value is None else float(value) * self._square

    def volume(self, value: float | None) -> float | None:
        """Cubic metres to the project's unit."""
        return None if value is None else float(value) * self._cubic

    def angle(self, value: float | None) -> float | None:
        """Radians to the project's unit."""
        return None if value is None else float(value) * self._radian

    # -- entities ------------------------------------------------------------------------------

    def root(self, kind: str, name: str, **named: Any) -> Any:
        """Make an IfcRoot; its GlobalId follows from the project, its class and its name."""
        import ifcopenshell.guid

        count = 0
        while True:
            key = f"{self._seed}/{kind}/{name}/{count}"
            guid = ifcopenshell.guid.compress(uuid.uuid5(_NAMESPACE, key).hex)
            if guid not in self._ids:  # taken where an as-built file is the input
                break
            count += 1
        self._ids.add(guid)
        return self.file.create_entity(kind, GlobalId=guid, OwnerHistory=self._history, Name=name, **named)

    def _owner_history(self) -> Any:
        make = self.file.create_entity
        # an application may be named but once in a file
        known = [a for a in self.file.by_type("IfcApplication") if a.ApplicationIdentifier == _APPLICATION]
        organization = known[0].ApplicationDeveloper if known else make("IfcOrganization", Name="bimfit")
        application = (
            known[0] if known else make("IfcApplication", organization, "1", self._author, _APPLICATION)
        )
        person = make("IfcPerson", Id="bimfit", FamilyName="bimfit")
        user = make("IfcPersonAndOrganization", person, organization)
        return make("IfcOwnerHistory", user, application, None, "ADDED", None, None, None, int(time.time()))

    # -- structure and placement ---------------------------------------------------------------

    def container(self, element: Any) -> Any:
        """The spatial element that an element, or the whole it is a part of, lies in; or None."""
        import ifcopenshell.util.element as elements

        return elements.get_container(element)

    def contain(self, element: Any, container: Any) -> None:
        """Put an element into a spatial element."""
        relation = next(iter(container.ContainsElements), None)
        if relation is not None:
            relation.RelatedElements = (*relation.RelatedElements, element)
            return
        self.root(
            "IfcRelContainedInSpatialStructure",
            f"in {container.Name or container.GlobalId}",
            RelatedElements=[element],
            RelatingStructure=container,
        )

    def has_local_placement(self, product: Any) -> bool:
        """Whether a product is placed by axes, which can be moved, and so is all that it is placed under."""
        return bool(_chain(product)) and all(place.is_a("IfcLocalPlacement") for place in _chain(product))

    def world_placement(self, product: Any) -> Array:
        """A product's placement as a matrix (4, 4), m."""
        import ifcopenshell.util.placement as placements

        matrix = np.array(placements.get_local_placement(product.ObjectPlacement), float)
        matrix[:3, 3] /= self._metre
        return matrix

    def move(self, motions: Mapping[Any, Array]) -> None:
        """Move products by world motions (4, 4), m, with all that belongs to them, and nothing else.

        Parts, openings and what fills openings go along, however their own placements are written; what is
        merely placed relative to a moved product stays where it is.
        """
        carried = dict(motions)
        for product, motion in motions.items():
            for other in _belongings(product):
                carried.setdefault(other, motion)
        places = {product.ObjectPlacement for product in carried if product.ObjectPlacement is not None}
        wanted: list[tuple[int, int, Any, Array]] = []
        for product in self.file.by_type("IfcProduct") if motions else ():
            chain = _chain(product)
            if not self.has_local_placement(product) or not (
                product in carried or any(place in places for place in chain)
            ):
                continue
            motion = carried.get(product, np.eye(4))
            wanted.append((len(chain), product.id(), product, motion @ self.world_placement(product)))
        # parents first: what they carry along is put right after them
        for _, _, product, matrix in sorted(wanted, key=lambda row: row[:2]):
            if not np.allclose(self.world_placement(product), matrix, rtol=0.0, atol=1e-9):
                self._set_world_placement(product, matrix)

    def _set_world_placement(self, product: Any, matrix: Array) -> None:
        """Place a product (4, 4), m; what is placed relative to it comes along, unless others share it."""
        placement = product.ObjectPlacement
        local = self._relative(placement.PlacementRelTo, matrix)
        if len(placement.PlacesObject) <= 1:
            placement.RelativePlacement = local
            return
        product.ObjectPlacement = self.file.create_entity(
            "IfcLocalPlacement", placement.PlacementRelTo, local
        )

    def _relative(self, parent: Any, matrix: Array) -> Any:
        """The axes that put a world matrix (4, 4), m, under a parent placement."""
        import ifcopenshell.util.placement as placements

        world = np.array(matrix, float)
        world[:3, 3] *= self._metre
        if parent is not None:
            world = np.linalg.solve(np.array(placements.get_local_placement(parent), float), world)
        make = self.file.create_entity
        return make(
            "IfcAxis2Placement3D",
            make("IfcCartesianPoint", world[:3, 3].tolist()),
            make("IfcDirection", world[:3, 2].tolist()),
            make("IfcDirection", world[:3, 0].tolist()),
        )

    # -- body ----------------------------------------------------------------------------------

    def give_mesh(self, element: Any, mesh: TriangleMesh, container: Any) -> None:
        """Give an element a mesh in world metres as its body, placed under its container."""
        origin = np.eye(4)
        # whole metres near the mesh: the coordinates stay short, and exact at map coordinates
        origin[:3, 3] = np.floor(mesh.bounds[0])
        parent = getattr(container, "ObjectPlacement", None)
        element.ObjectPlacement = self.file.create_entity(
            "IfcLocalPlacement", parent, self._relative(parent, origin)
        )
        items = [self._body(part, origin[:3, 3]) for part in _bodies(mesh)]
        kind = "Brep" if self.file.schema == "IFC2X3" else "Tessellation"
        shape = self.file.create_entity("IfcShapeRepresentation", self._body_context(), "Body", kind, items)
        element.Representation = self.file.create_entity("IfcProductDefinitionShape", None, None, [shape])

    def _body(self, mesh: TriangleMesh, origin: Array) -> Any:
        make = self.file.create_entity
        points = ((mesh.vertices - origin) * self._metre).tolist()
        if self.file.schema == "IFC2X3":
            corners = [make("IfcCartesianPoint", point) for point in points]
            faces = []
            for face in mesh.faces.tolist():
                bound = make("IfcFaceOuterBound", make("IfcPolyLoop", [corners[k] for k in face]), True)
                faces.append(make("IfcFace", [bound]))
            return make("IfcFacetedBrep", make("IfcClosedShell", faces))
        return make(
            "IfcTriangulatedFaceSet",
            Coordinates=make("IfcCartesianPointList3D", points),
            Closed=_closed(mesh.faces),
            CoordIndex=(mesh.faces + 1).tolist(),
        )

    def _body_context(self) -> Any:
        """The context of bodies; what comes nearest to it where the file has none."""
        models = [
            context
            for context in self.file.by_type("IfcGeometricRepresentationContext")
            if (context.ContextType or "Model") != "Plan"
        ]
        bodies = [context for context in models if context.ContextIdentifier == "Body"]
        views = [
            context for context in bodies if getattr(context, "TargetView", None) in (None, "MODEL_VIEW")
        ]
        whole = [context for context in models if not context.is_a("IfcGeometricRepresentationSubContext")]
        found = next(iter([*views, *bodies, *whole, *models]), None)
        if found is not None:
            return found
        make = self.file.create_entity
        axes = make("IfcAxis2Placement3D", make("IfcCartesianPoint", (0.0, 0.0, 0.0)))
        context = make("IfcGeometricRepresentationContext", None, "Model", 3, None, axes)
        for project in self.file.by_type("IfcProject"):
            project.RepresentationContexts = (*(project.RepresentationContexts or ()), context)
        return context

    # -- properties ----------------------------------------------------------------------------

    def add_properties(self, product: Any, name: str, values: Mapping[str, tuple[str, Any]]) -> None:
        """Add a property set of (type, value); what is None is left out."""
        make = self.file.create_entity
        properties = [
            make("IfcPropertySingleValue", Name=key, NominalValue=make(kind, value))
            for key, (kind, value) in values.items()
            if value is not None
        ]
        made = self.root("IfcPropertySet", f"{name}", Description=product.GlobalId, HasProperties=properties)
        self._define(product, made)

    def add_quantities(self, product: Any, name: str, values: Mapping[str, tuple[str, Any]]) -> None:
        """Add quantities of (Length, Area or Volume; value); what is None or negative is left out."""
        quantities = [
            self.file.create_entity(f"IfcQuantity{kind}", Name=key, **{f"{kind}Value": value})
            for key, (kind, value) in values.items()
            if value is not None and value >= 0.0  # the schema allows no negative quantity
        ]
        if quantities:
            made = self.root(
                "IfcElementQuantity", name, MethodOfMeasurement="laser scan, bimfit", Quantities=quantities
            )
            self._define(product, made)

    def _define(self, product: Any, definition: Any) -> None:
        self.root(
            "IfcRelDefinesByProperties",
            f"{definition.Name} of {product.GlobalId}",
            RelatedObjects=[product],
            RelatingPropertyDefinition=definition,
        )


def _chain(product: Any) -> list[Any]:
    """A product's placement and those that it is relative to, its own first."""
    found: list[Any] = []
    place = product.ObjectPlacement
    while place is not None and place not in found:
        found.append(place)
        place = getattr(place, "PlacementRelTo", None)
    return found


def _belongings(product: Any) -> list[Any]:
    """Parts, openings and what fills them, all the way down."""
    found: list[Any] = []
    waiting = [product]
    while waiting:
        one = waiting.pop()
        parts = [p for r in getattr(one, "IsDecomposedBy", ()) for p in r.RelatedObjects]
        holes = [r.RelatedOpeningElement for r in getattr(one, "HasOpenings", ())]
        fills = [r.RelatedBuildingElement for r in getattr(one, "HasFillings", ())]
        fresh = [p for p in (*parts, *holes, *fills) if p not in found and p.is_a("IfcProduct")]
        found += fresh
        waiting += fresh
    return found


def _scale(file: Any, kind: str) -> float:
    """SI units a project unit; 1 where the project names none."""
    import ifcopenshell.util.unit as units

    # calculate_unit_scale falls back to 1 by itself only for files with an IfcUnitAssignment
    if not file.by_type("IfcUnitAssignment"):
        return 1.0
    return float(units.calculate_unit_scale(file, kind))


def _bodies(mesh: TriangleMesh) -> list[TriangleMesh]:
    """The mesh's connected parts."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(mesh.vertices)
    a, b = mesh.faces[:, :2].reshape(-1), mesh.faces[:, 1:].reshape(-1)
    links = coo_array((np.ones(len(a)), (a, b)), shape=(size, size))
    _, label = connected_components(links, directed=False)
    out = []
    for part in np.unique(label[mesh.faces[:, 0]]):
        faces = mesh.faces[label[mesh.faces[:, 0]] == part]
        used, inverse = np.unique(faces, return_inverse=True)
        out.append(TriangleMesh(mesh.vertices[used], inverse.reshape(-1, 3).astype(np.int64)))
    return out


def _closed(faces: Faces) -> bool:
    """Whether every edge is there once each way."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = set(map(tuple, edges.tolist()))
    return len(there) == len(edges) and all((b, a) in there for a, b in there)
