"""The section [camera] of capture.toml and calibration.toml: which camera gives the images, and how it is set."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, get_args

from pydantic import BeforeValidator, Field, model_validator

from scope.session.toml_file import Number, Positive, Section

Driver = Literal["replay", "simulated", "v4l2", "aravis", "basler", "genicam"]
DRIVERS: tuple[Driver, ...] = get_args(Driver)
ON_FILES = ("replay", "simulated")  # drivers whose id is a file or folder
TIMEOUT_S = 5.0
Text = Annotated[str, Field(max_length=500)]


def _text(value: object) -> object:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


class CameraSection(Section):
    """[camera]."""

    driver: Driver
    id: Annotated[Text, BeforeValidator(_text)] = ""
    exposure_us: Positive | None = None
    gain: Number | None = None
    rate: Annotated[Positive, Field(le=100_000)] | None = None
    pixel_format: Text | None = None
    trigger: Text | None = None
    laser: Text | None = None
    producer: Text | None = None
    timeout_s: Annotated[Positive, Field(le=3600)] = TIMEOUT_S

    @model_validator(mode="after")
    def _complete(self) -> CameraSection:
        if self.driver in ON_FILES and not self.id:
            what = "a folder of images, a glob or a video" if self.driver == "replay" else "a rig-design.toml"
            raise ValueError(f'id is missing; for driver = "{self.driver}" it names {what}')
        if (self.producer is not None) != (self.driver == "genicam"):
            raise ValueError(
                'producer, the .cti file of a GenTL producer, is needed for driver = "genicam" and only there'
            )
        if self.driver in ON_FILES:
            for key in ("exposure_us", "gain", "pixel_format", "trigger", "laser"):
                if getattr(self, key) is not None:
                    raise ValueError(f'{key} has no meaning for driver = "{self.driver}"; remove it')
        return self


@dataclass(frozen=True, slots=True, eq=False)
class CameraSettings:
    """Which camera, and how it is to be set; None leaves what the camera has."""

    driver: Driver
    id: str = ""  # as `scope cameras` lists it; empty: the first; a path for those on files
    exposure_us: float | None = None
    gain: float | None = None  # in the camera's own unit, mostly dB
    rate: float | None = None  # frames a second
    pixel_format: str | None = None  # by its GenICam name
    trigger: str | None = None  # the line that triggers; None: free running
    laser: str | None = None  # the output line that switches the laser
    producer: str | None = None  # .cti file of a GenTL producer
    timeout_s: float = TIMEOUT_S  # s without a frame after which the camera counts as gone

    @property
    def name(self) -> str:
        """What messages call it."""
        return f"camera {self.driver}:{self.id}" if self.id else f"camera {self.driver}"


def camera_settings(section: CameraSection, folder: Path) -> CameraSettings:
    """Settings with paths relative to the folder of the file."""
    place = str(folder / section.id) if section.driver in ON_FILES else section.id
    producer = None if section.producer is None else str(folder / section.producer)
    return CameraSettings(
        section.driver, place, section.exposure_us, section.gain, section.rate, section.pixel_format, section.trigger,
        section.laser, producer, section.timeout_s,
    )  # fmt: skip
