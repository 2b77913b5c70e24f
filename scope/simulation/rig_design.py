"""rig-design.toml: a rig to be simulated, read and validated."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import KW_ONLY, fields
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Discriminator, Field, Tag, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from calibration.errors import FileError
from calibration.geometry import Pose
from scope.simulation.wild_design import WildDesign, WildTableDesign

_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)

Positive: TypeAlias = Annotated[float, Field(gt=0, le=1e5)]
Level: TypeAlias = Annotated[float, Field(ge=0, le=65535)]
Length: TypeAlias = Annotated[float, Field(ge=-1e5, le=1e5)]
Angle: TypeAlias = Annotated[float, Field(ge=-360, le=360)]
Tilt: TypeAlias = Annotated[float, Field(ge=-60, le=60)]
Point: TypeAlias = tuple[Length, Length, Length]
Row: TypeAlias = tuple[float, float, float, float]
Cell: TypeAlias = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]
_NOWHERE: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, config=_STRICT)
class CameraDesign:
    """A pinhole with distortion and a sensor."""

    size: tuple[Annotated[int, Field(ge=16, le=8192)], Annotated[int, Field(ge=16, le=8192)]]  # px, columns and rows
    focal_px: Positive
    centre_px: tuple[float, float]
    _: KW_ONLY
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)  # OpenCV order
    gain_e: Positive = 35.0  # electrons a grey level
    read_noise: Annotated[float, Field(ge=0, le=1000)] = 1.2  # grey levels
    blur_px: Annotated[float, Field(ge=0.2, le=20)] = 0.6
    black: Level = 4.0  # grey levels
    ambient: Level = 0.0  # grey levels above black in every image that shows the laser
    bits: Literal[8, 10, 12, 16] = 8
    colour: bool = False  # three channels: a red laser, white back-light
    # in place of the above, as data sheets give them; blur_px is then that of the lens itself
    pixel_um: Annotated[float, Field(gt=0, le=100)] | None = None
    focal_mm: Annotated[float, Field(gt=0, le=5000)] | None = None
    f_number: Annotated[float, Field(ge=0.5, le=128)] | None = None
    focus: Positive | None = None  # mm along z to what is sharp on the axis
    tilt: tuple[Tilt, Tilt] = (0.0, 0.0)  # degrees of the sensor about x, then y
    full_well_e: Positive | None = None  # electrons at white: gives gain_e
    read_noise_e: Annotated[float, Field(ge=0, le=1e4)] | None = None  # electrons: gives read_noise
    exposure_us: Positive | None = None
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] | None = None

    @model_validator(mode="after")
    def _optics(self) -> CameraDesign:
        needed = ("pixel_um", "focal_mm", "focus")
        optical = self.f_number is not None or self.tilt != (0.0, 0.0)
        missing = [key for key in (*needed, "f_number") if getattr(self, key) is None]
        if optical and missing:
            raise ValueError(f"{missing[0]} is missing; f_number and tilt need pixel_um, focal_mm, focus and f_number")
        if self.focus is not None and self.focal_mm is not None and self.focus <= 1.001 * self.focal_mm:
            raise ValueError(
                f"a lens of {self.focal_mm:g} mm cannot focus at {self.focus:g} mm; set focus beyond its focal length"
            )
        # the electrons of a data sheet take the place of grey levels
        if self.full_well_e is not None:
            object.__setattr__(self, "gain_e", self.full_well_e / (2**self.bits - 1))
        if self.read_noise_e is not None:
            object.__setattr__(self, "read_noise", self.read_noise_e / self.gain_e)
        return self


def _focal_px(camera: dict[str, Any]) -> float | None:
    """Focal length in px from ``focal_mm`` and ``pixel_um``; None where they are no numbers.

    A lens that is focused nearer than infinity stands farther from the sensor than its focal length.
    """

    def number(key: str) -> float | None:
        value = camera.get(key)
        return float(value) if isinstance(value, int | float) and not isinstance(value, bool) and value > 0 else None

    focal, pixel, focus = number("focal_mm"), number("pixel_um"), number("focus")
    if focal is None or pixel is None:
        return None
    away = focal if focus is None or focus <= focal else focal * focus / (focus - focal)
    return away / pixel * 1000.0


@dataclass(frozen=True, slots=True, config=_STRICT)
class WindowDesign:
    """Flat glass before camera and laser."""

    thickness: Annotated[float, Field(gt=0, le=2000)]  # mm
    index: Annotated[float, Field(gt=1, le=3)]
    tilt: tuple[Tilt, Tilt] = (0.0, 0.0)  # degrees about x, then about y
    distance: Annotated[float, Field(ge=0, le=1e5)] = 0.0  # mm along z to the near face


@dataclass(frozen=True, slots=True, config=_STRICT)
class LaserDesign:
    """A line laser."""

    origin: Point  # mm, in C
    through: Point  # mm, in C
    _: KW_ONLY
    roll: Angle = 0.0  # degrees about its axis; 0 is square to the baseline
    width: Annotated[float, Field(gt=0, le=20)] = 0.3  # mm, one sigma
    peak: Annotated[float, Field(gt=0, le=1e6)] | None = (
        None  # grey levels on white that faces it, before blur; 3/4 of white
    )
    fan: Annotated[float, Field(gt=0, le=150)] = 60.0  # degrees, full
    # contrast after a pixel's integration, and px of its grain; "aperture": both from wavelength, aperture and pixel
    speckle: Annotated[float, Field(ge=0, le=1)] | Literal["aperture"] = 0.0
    grain: Annotated[float, Field(ge=0, le=50)] = 1.0
    # a Gaussian beam in place of `width`, and its light in place of `peak`
    wavelength_nm: Annotated[float, Field(ge=200, le=2000)] | None = None
    waist: Annotated[float, Field(gt=0, le=20)] | None = None  # mm, one sigma where the sheet is thinnest
    waist_at: Positive | None = None  # mm from the laser to there
    divergence: Annotated[float, Field(ge=0, le=200)] | None = None  # mrad, one sigma; by diffraction where not given
    power_mw: Annotated[float, Field(gt=0, le=1e5)] | None = None

    @model_validator(mode="after")
    def _aimed(self) -> LaserDesign:
        if self.origin == self.through:
            raise ValueError("origin and through are one point; a laser is aimed at another point")
        if (self.waist is None) != (self.waist_at is None):
            raise ValueError("waist and waist_at come together: how thin the sheet is, and how far from the laser")
        if self.divergence is not None and self.waist is None:
            raise ValueError("divergence needs waist and waist_at")
        if self.waist is not None and self.divergence is None and self.wavelength_nm is None:
            raise ValueError("wavelength_nm or divergence is missing; a waist widens by one of them")
        if self.power_mw is not None and self.peak is not None:
            raise ValueError("power_mw and peak both say how bright the stripe is; give one")
        return self


LARGER = 1.1  # times a spot that a fiducial must be to be told from it


def unlike_itself(cells: tuple[Cell, ...]) -> bool:
    """Whether a pattern of cells differs, up to a shift, from each of its seven turns and reflections on a square lattice."""
    places = sorted(set(cells))
    own = [(a - places[0][0], b - places[0][1]) for a, b in places]
    for flip, down, across in product((False, True), (1, -1), (1, -1)):
        turned = sorted((down * (b if flip else a), across * (a if flip else b)) for a, b in places)
        if [(a - turned[0][0], b - turned[0][1]) for a, b in turned] == own and (flip, down, across) != (False, 1, 1):
            return False
    return True


@dataclass(frozen=True, slots=True, config=_STRICT)
class JigDesign:
    """Spot targets at known stand-offs, centred on the view, and the laser on a blank plate at each."""

    stand_offs: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=64)]  # mm along z to the grid's centre
    rows: Annotated[int, Field(ge=2, le=200)]
    columns: Annotated[int, Field(ge=2, le=200)]
    pitch: Positive | tuple[Positive, Positive]  # mm
    diameter: Positive  # mm
    _: KW_ONLY
    kind: Literal["spots"] = "spots"
    polarity: Literal["light", "dark"] = "light"
    fiducials: tuple[Cell, ...] = ()
    fiducial_diameter: Positive | None = None  # mm
    # a stepped plate: mm towards the camera of equal strips of columns, whose marks are listed level by level
    levels: Annotated[tuple[Annotated[float, Field(ge=0, le=1e4)], ...], Field(max_length=8)] = ()
    rotation: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)  # degrees, rotation vector of every plane
    bright: Annotated[float, Field(gt=0, le=65535)] | None = None  # grey levels above black; 7/10 of white
    dark: Level | None = None  # grey levels above black; 1/20 of white
    uneven: Annotated[float, Field(ge=0, le=1)] = 0.0  # light lost at the corners, as a part of one
    images: Annotated[int, Field(ge=1, le=100)] = 3  # repeats of each target
    laser_images: Annotated[int, Field(ge=1, le=100)] = 2

    @property
    def pitches(self) -> tuple[float, float]:
        """Pitch along x and y, mm."""
        return self.pitch if isinstance(self.pitch, tuple) else (self.pitch, self.pitch)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the planes: w and the stand-off."""
        return tuple(f"w{z:g}" for z in self.stand_offs)

    def heights(self) -> list[float]:
        """Mm towards the camera of each column: 0 without levels."""
        return [self.levels[c * len(self.levels) // self.columns] if self.levels else 0.0 for c in range(self.columns)]

    @model_validator(mode="after")
    def _stepped(self) -> JigDesign:
        if self.levels and (len(self.levels) < 2 or len(set(self.levels)) < len(self.levels)):
            raise ValueError(f"levels {list(self.levels)}: two or more, all different; a flat plate has none")
        if self.levels and self.columns < 3 * len(self.levels):
            raise ValueError(f"{self.columns} columns on {len(self.levels)} levels; three columns a level or more")
        if self.levels and self.fiducials:
            raise ValueError("levels take no fiducials: the marks of a stepped plate are listed; leave fiducials out")
        return self

    @model_validator(mode="after")
    def _possible(self) -> JigDesign:
        largest = max(self.diameter, self.fiducial_diameter or 0.0)
        if largest >= min(self.pitches):
            raise ValueError(
                f"spots of {largest:g} mm overlap at a pitch of {min(self.pitches):g} mm; make them smaller"
            )
        if bool(self.fiducials) != (self.fiducial_diameter is not None):
            raise ValueError("fiducials and fiducial_diameter come together; give both or neither")
        if any(row >= self.rows or column >= self.columns for row, column in self.fiducials):
            raise ValueError(f"a fiducial lies outside {self.rows} rows and {self.columns} columns counted from 0")
        if self.fiducial_diameter is not None and self.fiducial_diameter <= LARGER * self.diameter:
            raise ValueError(
                f"fiducial_diameter {self.fiducial_diameter:g} must exceed diameter {self.diameter:g} by more than 10 %"
            )
        if self.fiducials and not unlike_itself(self.fiducials):
            raise ValueError(
                f"fiducials {[list(cell) for cell in self.fiducials]} look the same after a turn or a reflection; the grid could not be "
                "told from its own image: choose three or more that form an L with unequal arms"
            )
        if len(set(self.names)) < len(self.stand_offs):
            raise ValueError("two stand_offs are the same; give each once")
        return self


@dataclass(frozen=True, slots=True, config=_STRICT)
class FaultDesign:
    """What is wrong with one plane, of which calibration.toml knows nothing."""

    plane: str
    _: KW_ONLY
    rotation: Angle = 0.0  # degrees about the grid's normal
    about: tuple[Length, Length] | None = None  # mm in the target's frame; the grid's centre
    slip: tuple[Length, Length] = (0.0, 0.0)  # mm along the target's x and y
    stand_off: Length = 0.0  # mm further away than stated
    tilt: tuple[Tilt, Tilt] = (0.0, 0.0)  # degrees about the target's x, then y, at the grid's centre
    pitch: Annotated[float, Field(gt=0.5, lt=2)] = 1.0  # factor, about the grid's centre
    missing: tuple[Cell, ...] = ()
    dirt: Annotated[int, Field(ge=0, le=10000)] = 0  # specks, half a spot to a spot wide, anywhere on the grid


Spread: TypeAlias = Annotated[float, Field(ge=0, le=100)]


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class ToleranceDesign:
    """What mounting and making leave open, one standard deviation each; `scope design --draws` varies it."""

    laser_position: Spread = 0.0  # mm, each axis
    laser_angle: Spread = 0.0  # degrees, about each axis
    laser_roll: Spread = 0.0  # degrees
    laser_width: Annotated[float, Field(ge=0, le=1)] = 0.0  # of the width, a part of one
    light: Annotated[float, Field(ge=0, le=1)] = 0.0  # of peak or power, a part of one
    focus: Spread = 0.0  # mm
    blur: Annotated[float, Field(ge=0, le=1)] = 0.0  # of the lens' own blur, a part of one
    noise: Annotated[float, Field(ge=0, le=1)] = 0.0  # of the read noise, a part of one
    stand_off: Spread = 0.0  # mm, of each plane, of which the calibration does not know
    slip: Spread = 0.0  # mm, likewise, along x and y
    plane_rotation: Spread = 0.0  # degrees, likewise, about the plane's normal
    plane_tilt: Spread = 0.0  # degrees, likewise, about x and y


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class Placement:
    """Where an object stands at position 0 of the motion: ``pose``, or ``origin`` and ``rotation``."""

    pose: tuple[Row, Row, Row, Row] | None = None  # C from model, mm
    origin: Point = _NOWHERE  # mm: x_C = origin + R x_model
    rotation: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)  # degrees, rotation vector
    albedo: Annotated[float, Field(ge=0, le=10)] = 1.0

    @model_validator(mode="after")
    def _rigid(self) -> Placement:
        if self.pose is not None:
            if self.origin != _NOWHERE or self.rotation != _NOWHERE:
                raise ValueError("pose and origin or rotation are both given; give one of them")
            Pose.from_matrix(self.pose)  # its ValueError is this key's
        return self


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class PlaneDesign(Placement):
    """The plane z = 0, or a rectangle of it about the origin."""

    solid: Literal["plane"] = "plane"
    size: tuple[Positive, Positive] | None = None  # mm


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class SphereDesign(Placement):
    """A sphere about the origin."""

    radius: Positive  # mm
    solid: Literal["sphere"] = "sphere"


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class CylinderDesign(Placement):
    """A cylinder about z, centred on the origin."""

    radius: Positive  # mm
    length: Positive  # mm
    solid: Literal["cylinder"] = "cylinder"


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class BoxDesign(Placement):
    """A box centred on the origin."""

    size: tuple[Positive, Positive, Positive]  # mm
    solid: Literal["box"] = "box"


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class StepsDesign(Placement):
    """Blocks in a row along x from x = 0, each from z = -base to its height; y from 0."""

    heights: Annotated[tuple[Positive, ...], Field(min_length=1, max_length=100)]  # mm
    tread: tuple[Positive, Positive]  # mm along x and y
    gap: Annotated[float, Field(ge=0, le=1e5)] = 0.0  # mm between blocks
    base: Positive = 1.0  # mm
    solid: Literal["steps"] = "steps"


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
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


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class MeshDesign(Placement):
    """A mesh file, mm."""

    mesh: str


def _kind(value: object) -> str:
    """Which of the objects a table is meant to be."""
    if isinstance(value, Mapping):
        return "mesh" if "mesh" in value else str(value.get("solid"))
    return "mesh" if isinstance(value, MeshDesign) else str(getattr(value, "solid", None))


_OBJECTS: dict[str, type[Any]] = {
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


@dataclass(frozen=True, slots=True, config=_STRICT)
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
            if getattr(self, key) == _NOWHERE:
                raise ValueError(f"{key} is zero; give a vector with a length")
        return self


@dataclass(frozen=True, slots=True, config=_STRICT)
class RigDesign:
    """A whole rig and one scan by it."""

    camera: CameraDesign
    laser: LaserDesign
    jig: JigDesign
    _: KW_ONLY
    format: Literal[1] = 1
    units: Literal["mm"] = "mm"
    window: WindowDesign | None = None
    objects: Annotated[tuple[ObjectDesign, ...], Field(max_length=200, validation_alias="object")] = ()
    faults: Annotated[tuple[FaultDesign, ...], Field(max_length=200, validation_alias="fault")] = ()
    motion: MotionDesign | None = None
    tolerance: ToleranceDesign | None = None

    @model_validator(mode="after")
    def _joined(self) -> RigDesign:
        for fault in self.faults:
            if fault.plane not in self.jig.names:
                raise ValueError(f"a fault names plane {fault.plane!r}; the planes are {list(self.jig.names)}")
            if any(row >= self.jig.rows or column >= self.jig.columns for row, column in fault.missing):
                raise ValueError(f"a missing spot of plane {fault.plane!r} lies outside the grid")
        self._check_light()
        if bool(self.objects) != (self.motion is not None):
            raise ValueError("[object] and [motion] come together: a scan needs both, a mere calibration neither")
        return self

    def _check_light(self) -> None:
        """What power and speckle need of the other table."""
        c, beam = self.camera, self.laser
        if beam.power_mw is not None:
            missing = [k for k in ("f_number", "exposure_us", "quantum_efficiency") if getattr(c, k) is None]
            if missing or beam.wavelength_nm is None:
                key = f"camera.{missing[0]}" if missing else "laser.wavelength_nm"
                raise ValueError(f"{key} is missing; laser.power_mw needs it to become grey levels")
        if beam.speckle == "aperture" and (c.f_number is None or beam.wavelength_nm is None):
            key = "camera.f_number" if c.f_number is None else "laser.wavelength_nm"
            raise ValueError(f"{key} is missing; laser.speckle = 'aperture' follows from it")


_TABLES: dict[str, type[Any]] = {
    "camera": CameraDesign,
    "window": WindowDesign,
    "laser": LaserDesign,
    "jig": JigDesign,
    "fault": FaultDesign,
    "motion": MotionDesign,
    "wild": WildDesign,
    "tolerance": ToleranceDesign,
}


def read_design(path: str | Path) -> RigDesign:
    """Read and validate a rig-design.toml; a mesh it names is looked for beside it.

    Raises
    ------
    FileError
        A file that is missing, no TOML, or has an unknown key, a wrong type or an impossible value: file, key, what
        was found, what is allowed.
    """
    path = Path(path)
    data = _tables(path)
    for key in ("object", "fault"):  # one table, or an array of them
        if isinstance(data.get(key), dict):
            data[key] = [data[key]]
    camera = data.get("camera")
    if isinstance(camera, dict) and "focal_px" not in camera and (focal := _focal_px(camera)) is not None:
        camera["focal_px"] = focal
    for item in data.get("object", []) if isinstance(data.get("object"), list) else []:
        if isinstance(item, dict) and isinstance(item.get("mesh"), str):
            item["mesh"] = str(path.parent / item["mesh"])
    design: RigDesign = _validated(path, data, RigDesign)
    return design


def read_any_design(path: str | Path) -> RigDesign | WildDesign:
    """Read a rig-design.toml of a rig, or of a session that nobody prepared (one with ``[wild]``).

    Raises
    ------
    FileError
        As `read_design`; and a file that holds tables of both.
    """
    path = Path(path)
    data = _tables(path)
    if "wild" not in data:
        return read_design(path)
    others = sorted(set(data) - {"format", "units", "wild"})
    if others:
        raise FileError(f"{path}: holds [wild] and {', '.join(others)}; [wild] stands alone, beside format and units")
    if data.get("format", 1) != 1 or data.get("units", "mm") != "mm" or not isinstance(data["wild"], dict):
        raise FileError(f'{path}: needed are format = 1, units = "mm" and a table [wild]')
    design: WildDesign = _validated(path, data["wild"], WildDesign, "wild")
    return design


def _tables(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise FileError(f"{path}: no such file; name a rig-design.toml") from error
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: could not be read ({error}); needed is a text file in UTF-8") from error
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"{path}: no valid TOML ({error}); correct it there") from error


def _validated(path: Path, data: dict[str, Any], kind: type[Any], table: str = "") -> Any:
    try:
        # by way of JSON, whose arrays may become tuples although types are strict
        return TypeAdapter(kind).validate_json(json.dumps(data, default=str))
    except ValidationError as error:
        raise FileError(f"{path}: {_first_fault(error, table)}") from error


def _first_fault(error: ValidationError, table: str = "") -> str:
    """One line about the first thing that is wrong: key, what was found, what is allowed."""
    first = error.errors(include_url=False)[0]
    if table:
        first["loc"] = (table, *first["loc"])
    place = [part for k, part in enumerate(first["loc"]) if not (k == 2 and first["loc"][0] == "object")]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".") or "the file"
    found = json.dumps(first["input"], default=str)
    found = found if len(found) <= 60 else found[:57] + "..."
    if first["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        return f"{key}: unknown key (found {found}); allowed here: {', '.join(_allowed(first['loc']))}"
    if first["type"] == "missing":
        return f"{key}: missing; it must be given"
    if first["type"].startswith("union_tag"):
        return f"{key}: neither a mesh nor a known solid; allowed: mesh, or solid = X"
    message = first["msg"].removeprefix("Value error, ")
    return f"{key}: {message}" if first["type"] == "value_error" else f"{key}: found {found}; {message}"


def _allowed(place: tuple[int | str, ...]) -> list[str]:
    """Keys of the table in which ``place`` stands."""
    if "wild" in place[:1] and len(place) == 3:
        return [f.name for f in fields(WildTableDesign)]
    if len(place) == 1:
        return ["format", "units", *_TABLES, "object"]
    table = _OBJECTS.get(str(place[2])) if place[0] == "object" and len(place) > 2 else _TABLES.get(str(place[0]))
    return [] if table is None else [f.name for f in fields(table) if f.name != "_"]
