"""What two documents ask for, as far as it is known without their texts (docs/method.md says which statement has which source)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Name = Literal["vdi-2634-2", "iso-10360-13"]
Key = Literal["probing_form", "probing_size", "spacing", "flatness"]
KEYS: tuple[Key, ...] = ("probing_form", "probing_size", "spacing", "flatness")


@dataclass(frozen=True, slots=True)
class Standard:
    """How a document names and evaluates its tests."""

    title: str
    symbols: Mapping[Key, str]
    positions: Mapping[Key, int | None]  # that are asked for; None where that could not be found out
    left_out: float  # part of the points of a form that may be left out as outliers; 0.05: the spread of 95 %
    patches: bool  # whether 25 representative points are evaluated, too
    proportions: bool  # whether sizes of artefacts are told by the diagonal of the measuring volume


STANDARDS: Mapping[Name, Standard] = {
    "vdi-2634-2": Standard(
        "VDI/VDE 2634 part 2",
        {"probing_form": "PF", "probing_size": "PS", "spacing": "SD", "flatness": "F"},
        {"probing_form": 10, "probing_size": 10, "spacing": 7, "flatness": 6},
        0.003,
        patches=False,
        proportions=True,
    ),
    "iso-10360-13": Standard(
        "ISO 10360-13",
        {"probing_form": "P_Form.Sph.D95%", "probing_size": "P_Size.Sph.All", "spacing": "D_CC", "flatness": "D_Form.Pla.D95%"},
        {"probing_form": None, "probing_size": None, "spacing": None, "flatness": None},
        0.05,
        patches=True,
        proportions=False,
    ),
}  # fmt: skip

NAMES: Mapping[Key, str] = {
    "probing_form": "probing error, form",
    "probing_size": "probing error, size",
    "spacing": "sphere-spacing error",
    "flatness": "flatness error",
}
FORMULAS: Mapping[Key, str] = {
    "probing_form": "spread of the radial distances of the points from the least squares sphere, radius free",
    "probing_size": "diameter of the least squares sphere less the calibrated one",
    "spacing": "distance of the centres of two least squares spheres, radii free, less the calibrated one",
    "flatness": "spread of the signed distances of the points from the least squares plane",
}
