"""The tables of a rig-design.toml that say what is scanned, and how it moves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import Discriminator, Field, Tag, model_validator
from pydantic.dataclasses import dataclass

from calibration.geometry import Pose
from scope.simulation.hardware_design import NOWHERE, STRICT, Angle, Length, Point, Positive, Row


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class Placement:
    """Where an object stands at position 0 of the motion: ``pose``, or ``origin`` and ``rotation``."""

    pose: tuple[Row, Row, Row, Row] | None = None  # C from model, mm
    origin: Point = NOWHERE  # mm: x_C = origin + R x_model
    rotation: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)  # degrees, rotation vector
    albedo: Annotated[float, Field(ge=0, le=10)] = 1.0

    @model_validator(mode="after")
    def _rigid(self) -> Placement:
        if self.pose is not None:
            if self.origin != NOWHERE or self.rotation != NOWHERE:
                raise ValueError("pose and origin or rotation are both given; give one of them")
            Pose.from_matrix(self.pose)  # its ValueError is this key's
        return self


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class PlaneDesign(Placement):
    """The plane z = 0, or a rectangle of it about the origin."""

    solid: Literal["plane"] = "plane"
    size: tuple[Positive, Positive] | None = None  # mm


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class SphereDesign(Placement):
    """A sphere about the origin."""

    radius: Positive  # mm
    solid: Literal["sphere"] = "sphere"


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class CylinderDesign(Placement):
    """A cylinder about z, centred on the origin."""

    radius: Positive  # mm
    length: Positive  # mm
    solid: Literal["cylinder"] = "cylinder"


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class BoxDesign(Placement):
    """A box centred on the origin."""

    size: tuple[Positive, Positive, Positive]  # mm
    solid: Literal["box"] = "box"


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class StepsDesign(Placement):
    """Blocks in a row along x from x = 0, each from z = -base to its height; y from 0."""

    heights: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=100)]  # mm
    tread: tuple[Positive, Positive]  # mm along x and y
    gap: Annotated[float, Field(ge=0, le=1e5)] = 0.0  # mm between blocks
    base: Positive = 1.0  # mm
    solid: Literal["steps"] = "steps"


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class RoughDesign(Placement):
    """A coupon from (0, 0) whose top has Gaussian heights about z = 0."""

    size: tuple[Positive, Positive]  # mm
    Sq: Positive  # mm, of the realised heights, exactly
    correlation: Positive  # mm: autocorrelation exp(-(r / correlation)^2)
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    thickness: Positive = 1.0  # mm of solid below the lowest valley
    solid: Literal["rough"] = "rough"

    @model_validator(mode="after")
    def _bounded(self) -> RoughDesign:
        cells = self.size[0] * self.size[1] * (10.0 / self.correlation) ** 2
        if cells > 2e7:
            raise ValueError(
                f"{cells:.3g} height samples; at most 2e7: make the coupon smaller or the correlation longer"
            )
        return self


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
class MeshDesign(Placement):
    """A mesh file, mm."""

    mesh: str


def _kind(value: object) -> str:
    """Which of the objects a table is meant to be."""
    if isinstance(value, Mapping):
        return "mesh" if "mesh" in value else str(value.get("solid"))
    return "mesh" if isinstance(value, MeshDesign) else str(getattr(value, "solid", None))


OBJECTS: dict[str, type[Any]] = {
    "plane": PlaneDesign,
    "sphere": SphereDesign,
    "cylinder": CylinderDesign,
    "box": BoxDesign,
    "steps": StepsDesign,
    "rough": RoughDesign,
    "mesh": MeshDesign,
}
ObjectDesign: TypeAlias = Annotated[
    Annotated[PlaneDesign, Tag("plane")]
    | Annotated[SphereDesign, Tag("sphere")]
    | Annotated[CylinderDesign, Tag("cylinder")]
    | Annotated[BoxDesign, Tag("box")]
    | Annotated[StepsDesign, Tag("steps")]
    | Annotated[RoughDesign, Tag("rough")]
    | Annotated[MeshDesign, Tag("mesh")],
    Discriminator(_kind),
]


@dataclass(frozen=True, slots=True, config=STRICT)
class MotionDesign:
    """How the object, or the sensor, moves from frame to frame; keys as in capture.toml."""

    kind: Literal["fixed", "linear", "turntable"] = "fixed"
    _: KW_ONLY
    frames: Annotated[int, Field(ge=1, le=20000)] = 1
    moves: Literal["object", "sensor"] = "object"
    direction: Point | None = None  # linear, in C
    axis_point: Point | None = None  # turntable, mm in C
    axis_direction: Point | None = None
    step: Length | None = None  # mm or degrees a frame
    start: Length = 0.0  # mm or degrees
    off_images: Annotated[int, Field(ge=0, le=1000)] = 0  # images without laser, for capture's `background`

    @model_validator(mode="after")
    def _complete(self) -> MotionDesign:
        needed = {"fixed": (), "linear": ("direction", "step"), "turntable": ("axis_point", "axis_direction", "step")}
        given = {k for k in ("direction", "axis_point", "axis_direction", "step") if getattr(self, k) is not None}
        if given != set(needed[self.kind]):
            raise ValueError(f"a {self.kind} motion takes {list(needed[self.kind])}, not {sorted(given)}")
        for key in ("direction", "axis_direction"):
            if getattr(self, key) == NOWHERE:
                raise ValueError(f"{key} is zero; give a vector with a length")
        return self
