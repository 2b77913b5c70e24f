"""What mounting and making leave open: a design drawn anew with its tolerances, and what that does to every figure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from calibration.errors import ScopeError
from calibration.geometry import Array, Pose
from scope.design.prediction import Surface
from scope.design.run import DesignResult, design_rig
from scope.simulation import FaultDesign, RigDesign

Answer: TypeAlias = tuple[dict[str, float], list[str]] | None  # figures and troubles of a draw
Each: TypeAlias = Callable[[Callable[[int], Answer], Iterable[int]], list[Answer]]
_PARTS = (5.0, 50.0, 95.0)  # percentiles that are told


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """Figures of many draws of one design."""

    count: int
    failed: int  # draws that cannot be calibrated, or miss the volume
    troubled: int  # draws with a sentence about what will not work
    figures: dict[str, Array]  # by name, (draws that did not fail,)

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives: 5, 50 and 95 % of the draws."""
        told = {
            name: dict(zip(("p5", "p50", "p95"), np.percentile(values, _PARTS).tolist(), strict=True))
            for name, values in self.figures.items()
            if len(values)
        }
        return {"draws": self.count, "failed": self.failed, "troubled": self.troubled, "figures": told}


def draw_figures(
    design: RigDesign, count: int, *, seed: int = 0, surface: Surface | None = None, each: Each | None = None
) -> Drawn:  # fmt: skip
    """Predict ``count`` rigs that differ by the design's tolerances; each draw depends on seed and number alone.

    ``each`` does the draws and gives their answers in order, such as `scope.batch.each` with workers; by default one after another.

    Raises
    ------
    ValueError
        A design without tolerances, or no draw.
    """
    if design.tolerance is None or count < 1:
        raise ValueError("draws need a design with tolerances, and at least one draw")
    found = (each or _in_turn)(partial(one_draw, design, seed=seed, surface=surface), range(count))
    sound = [draw for draw in found if draw is not None]
    names = list(sound[0][0]) if sound else []
    figures = {name: np.array([draw[0][name] for draw in sound]) for name in names}
    return Drawn(count, count - len(sound), sum(bool(draw[1]) for draw in sound), figures)


def _in_turn(function: Callable[[int], Answer], numbers: Iterable[int]) -> list[Answer]:
    return [function(number) for number in numbers]


def one_draw(design: RigDesign, number: int, *, seed: int = 0, surface: Surface | None = None) -> Answer:
    """Figures and troubles of one draw, work of its own; None where it cannot be calibrated."""
    try:
        found = design_rig(drawn(design, np.random.default_rng([seed, number])), surface=surface, seed=number)
    except ScopeError:
        return None
    return _figures(found), found.troubles


def drawn(design: RigDesign, rng: np.random.Generator) -> RigDesign:
    """The design as it may come out: each tolerance is one standard deviation of a Gaussian.

    Planes move without the calibration knowing of it, as `[[fault]]` tables say; everything else is as it then is.
    """
    t = design.tolerance
    if t is None:
        return design
    laser, camera = design.laser, design.camera
    origin = np.array(laser.origin) + t.laser_position * rng.standard_normal(3)
    aim = np.array(laser.through) - np.array(laser.origin)
    turn = Pose.from_rotation_vector(np.radians(t.laser_angle) * rng.standard_normal(3), np.zeros(3))
    through = origin + turn.rotation @ aim
    factor = np.exp(rng.standard_normal(4) * [t.laser_width, t.light, t.blur, t.noise])
    laser = replace(
        laser, origin=_three(origin), through=_three(through), roll=laser.roll + t.laser_roll * float(rng.standard_normal()),
        width=laser.width * float(factor[0]), waist=None if laser.waist is None else laser.waist * float(factor[0]),
        peak=None if laser.peak is None else laser.peak * float(factor[1]),
        power_mw=None if laser.power_mw is None else laser.power_mw * float(factor[1]),
    )  # fmt: skip
    focus = None if camera.focus is None else camera.focus + t.focus * float(rng.standard_normal())
    blur = float(np.clip(camera.blur_px * factor[2], 0.2, 20.0))
    camera = replace(
        camera, blur_px=blur, focus=focus, read_noise_e=None, read_noise=camera.read_noise * float(factor[3])
    )
    faults = list(design.faults)
    for name in design.jig.names:
        off, x, y, angle = (float(v) for v in rng.standard_normal(4))
        tilt = (t.plane_tilt * float(rng.standard_normal()), t.plane_tilt * float(rng.standard_normal()))
        faults.append(
            FaultDesign(name, rotation=t.plane_rotation * angle, slip=(t.slip * x, t.slip * y), stand_off=t.stand_off * off, tilt=tilt)
        )  # fmt: skip
    return replace(design, laser=laser, camera=camera, faults=tuple(faults))


def _three(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _figures(found: DesignResult) -> dict[str, float]:
    result = found.result
    figures = {
        f"{key}.{part}": float(result[key][part])
        for key in ("sigma_mm", "sigma_cal_mm", "stripe_px", "blur_px", "signal", "triangulation_deg")
        for part in ("median", "max")
    }
    expected = result["expected"]
    for name in ("sphere", "step", "Sq", "pose"):
        figures[f"expected.{name}.sigma_mm"] = float(expected[name]["sigma_mm"])
    return figures
