"""The tables of a rig-design.toml that say what the rig is made of: camera, window, laser, jig, faults and tolerances."""

from __future__ import annotations

from dataclasses import KW_ONLY
from itertools import product
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, populate_by_name=True)

Positive: TypeAlias = Annotated[float, Field(gt=0, le=1e5)]
Level: TypeAlias = Annotated[float, Field(ge=0, le=65535)]
Length: TypeAlias = Annotated[float, Field(ge=-1e5, le=1e5)]
Angle: TypeAlias = Annotated[float, Field(ge=-360, le=360)]
Tilt: TypeAlias = Annotated[float, Field(ge=-60, le=60)]
Point: TypeAlias = tuple[Length, Length, Length]
Row: TypeAlias = tuple[float, float, float, float]
Cell: TypeAlias = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]
NOWHERE: Point = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, config=STRICT)
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


def focal_px(camera: dict[str, Any]) -> float | None:
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


@dataclass(frozen=True, slots=True, config=STRICT)
class WindowDesign:
    """Flat glass before camera and laser."""

    thickness: Annotated[float, Field(gt=0, le=2000)]  # mm
    index: Annotated[float, Field(gt=1, le=3)]
    tilt: tuple[Tilt, Tilt] = (0.0, 0.0)  # degrees about x, then about y
    distance: Annotated[float, Field(ge=0, le=1e5)] = 0.0  # mm along z to the near face


@dataclass(frozen=True, slots=True, config=STRICT)
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


@dataclass(frozen=True, slots=True, config=STRICT)
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


@dataclass(frozen=True, slots=True, config=STRICT)
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


@dataclass(frozen=True, slots=True, config=STRICT, kw_only=True)
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
