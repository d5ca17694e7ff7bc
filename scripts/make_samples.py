#!/usr/bin/env python3
"""Write the sample models of ``ifc_samples/``: the same bytes on every run.

    python scripts/make_samples.py [FOLDER]

Lengths in this file are millimetres; each model says in which unit it is written.
"""

from __future__ import annotations

import math
import sys
import uuid
from collections.abc import Callable, Sequence
from pathlib import Path

import ifcopenshell
import ifcopenshell.guid

ROOT = Path(__file__).resolve().parents[1]
STAMP = "2024-01-01T00:00:00"
EPOCH = 1704067200
NAMESPACE = uuid.uuid5(uuid.NAMESPACE_URL, "https://example.org/bimfit/ifc_samples")
Point = tuple[float, float]
Vector = tuple[float, float, float]
Entity = ifcopenshell.entity_instance

Z: Vector = (0.0, 0.0, 1.0)
X: Vector = (1.0, 0.0, 0.0)


class Model:
    """One IFC file in the making.

    Parameters
    ----------
    name : str
        File name without its ending; GlobalIds are derived from it.
    schema : {"IFC2X3", "IFC4", "IFC4X3_ADD2"}
    unit : {"mm", "m"}
        Length unit of the project.
    """

    def __init__(self, name: str, title: str, schema: str = "IFC4", unit: str = "mm") -> None:
        self.name = name
        self.file = ifcopenshell.file(schema=schema)
        self.schema = schema
        self.scale = {"mm": 1.0, "m": 1e-3}[unit]
        self.used: set[str] = set()
        self.parents: dict[int, list[Entity]] = {}
        self.history = self._owner_history() if schema == "IFC2X3" else None
        self._header(title)
        self.body: Entity
        self.project = self._project(title, unit)
        self.site = self.spatial("IfcSite", "Site", self.project, CompositionType="ELEMENT")
        self.building = self.spatial("IfcBuilding", "Building", self.site, CompositionType="ELEMENT")

    # -- plain entities ------------------------------------------------------------------------

    def make(self, kind: str, *values: object, **named: object) -> Entity:
        return self.file.create_entity(kind, *values, **named)

    def root(self, kind: str, name: str, **named: object) -> Entity:
        """Make an IfcRoot whose GlobalId follows from the file, its class and its name."""
        key = f"{self.name}/{kind}/{name}"
        if key in self.used:
            raise ValueError(f"two of {key}")
        self.used.add(key)
        guid = ifcopenshell.guid.compress(uuid.uuid5(NAMESPACE, key).hex)
        return self.make(kind, GlobalId=guid, OwnerHistory=self.history, Name=name, **named)

    def point(self, *xyz: float) -> Entity:
        # rounded to a nanometre, so that the last bit of a sine is no part of the file
        return self.make("IfcCartesianPoint", tuple(round(c * self.scale, 9) + 0.0 for c in xyz))

    def direction(self, *xyz: float) -> Entity:
        return self.make("IfcDirection", tuple(round(c, 12) + 0.0 for c in xyz))

    def axes(self, origin: Vector = (0.0, 0.0, 0.0), z: Vector = Z, x: Vector = X) -> Entity:
        return self.make("IfcAxis2Placement3D", self.point(*origin), self.direction(*z), self.direction(*x))

    def placement(self, parent: Entity | None, origin: Vector, x: Vector = X) -> Entity:
        return self.make("IfcLocalPlacement", parent, self.axes(origin, Z, x))

    # -- header, project, spatial structure ----------------------------------------------------

    def _header(self, title: str) -> None:
        header = self.file.header
        header.file_description.description = ("ViewDefinition [ReferenceView]", title)
        header.file_name.name = f"{self.name}.ifc"
        header.file_name.time_stamp = STAMP
        header.file_name.author = ("bimfit",)
        header.file_name.organization = ("bimfit",)
        header.file_name.preprocessor_version = "IfcOpenShell"
        header.file_name.originating_system = "bimfit scripts/make_samples.py"
        header.file_name.authorization = "none"

    def _owner_history(self) -> Entity:
        person = self.make("IfcPerson", Id="bimfit", FamilyName="bimfit")
        organization = self.make("IfcOrganization", Name="bimfit")
        user = self.make("IfcPersonAndOrganization", person, organization)
        application = self.make("IfcApplication", organization, "1", "bimfit samples", "bimfit")
        return self.make("IfcOwnerHistory", user, application, None, "ADDED", None, None, None, EPOCH)

    def _project(self, title: str, unit: str) -> Entity:
        units = [
            self.make("IfcSIUnit", None, "LENGTHUNIT", "MILLI" if unit == "mm" else None, "METRE"),
            self.make("IfcSIUnit", None, "AREAUNIT", None, "SQUARE_METRE"),
            self.make("IfcSIUnit", None, "VOLUMEUNIT", None, "CUBIC_METRE"),
            self.make("IfcSIUnit", None, "PLANEANGLEUNIT", None, "RADIAN"),
        ]
        context = self.make(
            "IfcGeometricRepresentationContext",
            ContextType="Model",
            CoordinateSpaceDimension=3,
            Precision=1e-3 * self.scale,
            WorldCoordinateSystem=self.axes(),
        )
        self.context = context
        self.body = self.make(
            "IfcGeometricRepresentationSubContext",
            ContextIdentifier="Body",
            ContextType="Model",
            ParentContext=context,
            TargetView="MODEL_VIEW",
        )
        return self.root(
            "IfcProject",
            title,
            RepresentationContexts=[context],
            UnitsInContext=self.make("IfcUnitAssignment", units),
        )

    def spatial(self, kind: str, name: str, parent: Entity, **named: object) -> Entity:
        base = getattr(parent, "ObjectPlacement", None)
        height = named.get("Elevation", 0.0)
        assert isinstance(height, float)
        if "Elevation" in named:
            named["Elevation"] = height * self.scale
        place = self.placement(base, (0.0, 0.0, height))
        made = self.root(kind, name, ObjectPlacement=place, **named)
        self.root("IfcRelAggregates", f"{parent.Name} / {name}", RelatingObject=parent, RelatedObjects=[made])
        return made

    def storey(self, name: str, elevation: float = 0.0) -> Entity:
        return self.spatial(
            "IfcBuildingStorey", name, self.building, CompositionType="ELEMENT", Elevation=elevation
        )

    # -- elements ------------------------------------------------------------------------------

    def polygon(self, points: Sequence[Point]) -> Entity:
        """Make an arbitrary closed profile from its corners, in either winding."""
        corners = [self.point(*p) for p in points]
        curve = self.make("IfcPolyline", [*corners, corners[0]])
        return self.make("IfcArbitraryClosedProfileDef", "AREA", None, curve)

    def rectangle(self, low: Point, high: Point) -> Entity:
        centre = self.make(
            "IfcAxis2Placement2D", self.point((low[0] + high[0]) / 2, (low[1] + high[1]) / 2), None
        )
        sizes = ((high[0] - low[0]) * self.scale, (high[1] - low[1]) * self.scale)
        return self.make("IfcRectangleProfileDef", "AREA", None, centre, *sizes)

    def along_y(self, profile: Entity, length: float) -> Entity:
        """Extrude a profile of the x-z plane from y = 0 to y = ``length``."""
        # local x = x and local y = z, so the solid's own axis is -y: it starts at the far end
        place = self.axes((0.0, length, 0.0), (0.0, -1.0, 0.0), X)
        return self.make("IfcExtrudedAreaSolid", profile, place, self.direction(*Z), length * self.scale)

    def upwards(self, profile: Entity, height: float) -> Entity:
        return self.make(
            "IfcExtrudedAreaSolid", profile, self.axes(), self.direction(*Z), height * self.scale
        )

    def shape(self, solid: Entity) -> Entity:
        body = self.make("IfcShapeRepresentation", self.body, "Body", "SweptSolid", [solid])
        return self.make("IfcProductDefinitionShape", None, None, [body])

    def element(
        self,
        kind: str,
        name: str,
        solid: Entity,
        storey: Entity,
        origin: Vector = (0.0, 0.0, 0.0),
        x: Vector = X,
        predefined: str | None = None,
    ) -> Entity:
        """Add an element with one solid to a storey."""
        named: dict[str, object] = {"Tag": name.replace(" ", "-").lower()}
        if predefined and self.schema != "IFC2X3":
            named["PredefinedType"] = predefined
        if self.schema == "IFC2X3" and kind == "IfcSlab":
            named["PredefinedType"] = predefined
        made = self.root(
            kind,
            name,
            ObjectPlacement=self.placement(storey.ObjectPlacement, origin, x),
            Representation=self.shape(solid),
            **named,
        )
        self.parents.setdefault(storey.id(), []).append(made)
        return made

    def opening(self, name: str, host: Entity, solid: Entity, origin: Vector) -> None:
        named = {} if self.schema == "IFC2X3" else {"PredefinedType": "OPENING"}
        made = self.root(
            "IfcOpeningElement",
            name,
            ObjectPlacement=self.placement(host.ObjectPlacement, origin),
            Representation=self.shape(solid),
            **named,
        )
        self.root(
            "IfcRelVoidsElement",
            f"{name} in {host.Name}",
            RelatingBuildingElement=host,
            RelatedOpeningElement=made,
        )

    def map_conversion(self, east: float, north: float, height: float, turn: float) -> None:
        """Place the model on the map (metres; ``turn`` counter-clockwise, rad) in ETRS89 / UTM 32N."""
        metre = self.make("IfcSIUnit", None, "LENGTHUNIT", None, "METRE")
        crs = self.make(
            "IfcProjectedCRS",
            Name="EPSG:25832",
            Description="ETRS89 / UTM zone 32N",
            GeodeticDatum="ETRS89",
            VerticalDatum="DHHN2016",
            MapProjection="UTM",
            MapZone="32N",
            MapUnit=metre,
        )
        self.make(
            "IfcMapConversion",
            SourceCRS=self.context,
            TargetCRS=crs,
            Eastings=east,
            Northings=north,
            OrthogonalHeight=height,
            XAxisAbscissa=round(math.cos(turn), 12),
            XAxisOrdinate=round(math.sin(turn), 12),
            # map units a project unit: IfcMapConversion says so, and many readers forget it
            Scale=1e-3 / self.scale,
        )

    def material(self, name: str) -> None:
        """Give every element the same material."""
        products = [product for inside in self.parents.values() for product in inside]
        self.root(
            "IfcRelAssociatesMaterial",
            name,
            RelatedObjects=products,
            RelatingMaterial=self.make("IfcMaterial", name),
        )

    def write(self, folder: Path) -> Path:
        for number, inside in self.parents.items():
            storey = self.file.by_id(number)
            self.root(
                "IfcRelContainedInSpatialStructure",
                f"in {storey.Name}",
                RelatedElements=inside,
                RelatingStructure=storey,
            )
        path = folder / f"{self.name}.ifc"
        self.file.write(str(path))
        return path


LENGTH = 820.0


def _boards(
    model: Model,
    shapes: Sequence[tuple[str, str, Sequence[Point], str]],
    material: str,
    length: float = LENGTH,
) -> Model:
    """Two elements extruded along y from their x-z sections: (class, name, corners, predefined type)."""
    storey = model.storey("Ground floor")
    for kind, name, corners, predefined in shapes:
        solid = model.along_y(model.polygon(corners), length)
        model.element(kind, name, solid, storey, predefined=predefined)
    model.material(material)
    return model


def square_butt(schema: str, unit: str, ending: str) -> Model:
    """The paper's joint: boards 200 x 25, gap 25, 820 long, top corners at z = 50."""
    model = Model(f"square-butt-{ending}", "Square butt joint", schema, unit)
    storey = model.storey("Ground floor")
    for name, low in (("Board A", -212.5), ("Board B", 12.5)):
        solid = model.along_y(model.rectangle((low, 25.0), (low + 200.0, 50.0)), LENGTH)
        model.element("IfcPlate", name, solid, storey, predefined="SHEET")
    model.material("Spruce")
    return model


def v_groove() -> Model:
    """Steel plates 25 thick, prepared with 30 degrees each, root face 3, root gap 5."""
    open_ = 2.5 + 22.0 * math.tan(math.radians(30.0))
    a = [(-212.5, 25.0), (-2.5, 25.0), (-2.5, 28.0), (-open_, 50.0), (-212.5, 50.0)]
    b = [(-x, z) for x, z in a]
    plates = [("IfcPlate", "Plate A", a, "SHEET"), ("IfcPlate", "Plate B", b, "SHEET")]
    return _boards(Model("v-groove", "V-groove joint"), plates, "Steel S355")


def lap() -> Model:
    """Boards 25 thick that lie 50 over one another with 6 between them."""
    lower = [(-175.0, 0.0), (25.0, 0.0), (25.0, 25.0), (-175.0, 25.0)]
    upper = [(-25.0, 31.0), (175.0, 31.0), (175.0, 56.0), (-25.0, 56.0)]
    boards = [("IfcPlate", "Lower board", lower, "SHEET"), ("IfcPlate", "Upper board", upper, "SHEET")]
    return _boards(Model("lap", "Lap joint"), boards, "Spruce")


def t_joint() -> Model:
    """A stem 40 thick standing 12 above the middle of a base plate."""
    base = [(-200.0, 0.0), (200.0, 0.0), (200.0, 25.0), (-200.0, 25.0)]
    stem = [(-20.0, 37.0), (20.0, 37.0), (20.0, 287.0), (-20.0, 287.0)]
    parts = [("IfcPlate", "Base", base, "SHEET"), ("IfcMember", "Stem", stem, "STUD")]
    return _boards(Model("t-joint", "T-joint"), parts, "Spruce")


def mitre() -> Model:
    """Two walls 120 thick and 1000 high that meet at a corner, mitred, 20 apart."""
    model = Model("mitre", "Mitred corner")
    storey = model.storey("Ground floor")
    half = 10.0 * math.sqrt(2.0)
    south = [(half, 0.0), (800.0, 0.0), (800.0, 120.0), (120.0 + half, 120.0)]
    west = [(y, x) for x, y in south]
    for name, corners in (("South wall", south), ("West wall", west)):
        solid = model.upwards(model.polygon(corners), 1000.0)
        model.element("IfcWall", name, solid, storey, predefined="SOLIDWALL")
    model.material("Concrete C30/37")
    return model


COLUMNS, ROWS = 4, 3
PANEL = (3000.0, 2980.0, 140.0)
JOINT = 20.0


def facade() -> Model:
    """Precast facade: 4 columns by 3 storeys of panels, 20 joints, a window in each panel of one column."""
    model = Model("facade", "Precast facade")
    model.map_conversion(east=458657.21, north=5438232.57, height=112.4, turn=math.radians(27.0))
    wide, high, thick = PANEL
    for row in range(ROWS):
        storey = model.storey(f"Storey {row + 1}", row * (high + JOINT))
        for column in range(COLUMNS):
            name = f"Panel {row + 1}.{column + 1}"
            solid = model.upwards(model.rectangle((0.0, 0.0), (wide, thick)), high)
            origin = (column * (wide + JOINT), 0.0, 0.0)
            panel = model.element("IfcWall", name, solid, storey, origin, predefined="SOLIDWALL")
            if column == 1:
                hole = model.upwards(model.rectangle((0.0, -10.0), (1200.0, thick + 10.0)), 1400.0)
                model.opening(f"Window {row + 1}.{column + 1}", panel, hole, (900.0, 0.0, 900.0))
    model.material("Concrete C40/50")
    return model


RADIUS, SPAN = 3000.0, math.radians(60.0)


def curved() -> Model:
    """Two curved panels, one above the other: their joint is an arc of 60 degrees, 3 m outside radius."""
    model = Model("curved", "Curved panels")
    storey = model.storey("Ground floor")
    panels = (("Lower panel", 0.0, 600.0), ("Upper panel", 620.0, 1220.0))
    for name, low, high in panels:
        # in the solid's own x-y plane, which stands upright; revolved about its y axis, the building's z
        profile = model.rectangle((RADIUS - 100.0, low), (RADIUS, high))
        place = model.axes(z=(0.0, -1.0, 0.0), x=X)
        axis = model.make("IfcAxis1Placement", model.point(0.0, 0.0, 0.0), model.direction(0.0, 1.0, 0.0))
        solid = model.make("IfcRevolvedAreaSolid", profile, place, axis, round(SPAN, 12))
        model.element("IfcWall", name, solid, storey, predefined="SOLIDWALL")
    model.material("Concrete C40/50")
    return model


SAMPLES: tuple[Callable[[], Model], ...] = (
    lambda: square_butt("IFC2X3", "mm", "ifc2x3"),
    lambda: square_butt("IFC4", "m", "ifc4"),
    lambda: square_butt("IFC4X3_ADD2", "mm", "ifc4x3"),
    v_groove,
    lap,
    t_joint,
    mitre,
    facade,
    curved,
)


def main(folder: Path = ROOT / "ifc_samples") -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    return [sample().write(folder) for sample in SAMPLES]


if __name__ == "__main__":
    for written in main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "ifc_samples"):
        print(written.name)
