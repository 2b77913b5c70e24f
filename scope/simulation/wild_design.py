"""[wild] of a rig-design.toml: a session that nobody prepared, of which what is not given is drawn."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

from scope.simulation.wild import WildScene, draw_wild

_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
_COLOURS = {"blue": 0, "green": 1, "red": 2}


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class WildTableDesign:
    """A turntable with markers, a block and a ball, that makes a full turn."""

    frames: Annotated[int, Field(ge=8, le=720)] = 80


@dataclass(frozen=True, slots=True, config=_STRICT, kw_only=True)
class WildDesign:
    """Camera, laser, room and hands of a wild session; None: drawn over what cheap hardware gives."""

    focal: Annotated[float, Field(ge=300, le=2000)] | None = None  # px
    radial: Annotated[float, Field(ge=-0.4, le=0.4)] | None = None  # k1
    colour: Literal["blue", "green", "red"] | None = None  # of the laser
    width: Annotated[float, Field(ge=0.05, le=20)] | None = None  # mm, one sigma across the sheet
    power: Annotated[float, Field(gt=0, le=5000)] | None = None  # grey levels at the peak
    speckle: Annotated[float, Field(ge=0, le=1)] | None = None
    paper: Annotated[float, Field(gt=0, le=2000)] | None = None  # grey levels of white paper; above 255 it clips
    gradient: tuple[Annotated[float, Field(ge=-1, le=1)], Annotated[float, Field(ge=-1, le=1)]] | None = None
    margin: Annotated[float, Field(ge=0, le=100)] | None = None  # mm
    blur: Annotated[float, Field(ge=0.3, le=10)] | None = None  # px, one sigma
    noise: Annotated[float, Field(ge=0, le=50)] | None = None  # grey levels
    quality: Annotated[int, Field(ge=10, le=100)] | None = None  # of the JPEG
    bayer: bool | None = None
    dust: Annotated[int, Field(ge=0, le=200)] | None = None
    hands: Annotated[int, Field(ge=0, le=20)] | None = None
    boards: Annotated[int, Field(ge=0, le=200)] | None = None
    lasers: Annotated[int, Field(ge=0, le=200)] | None = None
    blurred: Annotated[int, Field(ge=0, le=200)] | None = None
    missing: Annotated[int, Field(ge=0, le=200)] | None = None
    turntable: WildTableDesign | None = None

    def scene(self, rng: np.random.Generator) -> WildScene:
        """Draw the scene with what is given put in its place."""
        given = {f.name: getattr(self, f.name) for f in fields(self) if getattr(self, f.name) is not None}
        table = given.pop("turntable", None)
        if "colour" in given:
            given["colour"] = _COLOURS[given["colour"]]
        if "gradient" in given:
            given["gradient"] = np.array(given["gradient"])
        return replace(draw_wild(rng), frames=0 if table is None else table.frames, **given)
