"""calibration.toml of a designed rig as a user would write it, and the lists of a stepped plate's marks."""

from __future__ import annotations

import json

import numpy as np

from calibration.geometry import Array, Bools
from scope.simulation.optics import project
from scope.simulation.virtual_rig import VirtualRig


def toml(value: object) -> str:
    """A number, text, list or boolean as TOML (whose syntax for these is JSON's)."""
    return json.dumps(value)


def calibration_toml(rig: VirtualRig, dark: bool) -> str:
    """calibration.toml; with laser-off images where ``dark``."""
    lines = ["# A simulated rig; truth/ holds what it really is.", "format = 1", 'units = "mm"', "", "[target]"]
    lines += [f"{key} = {toml(value)}" for key, value in _target(rig).items()]
    lines += ["", "[laser]", f"origin = {toml(rig.laser.origin.tolist())}"]
    jig = rig.design.jig
    for name, pose in zip(jig.names, rig.stated, strict=True):
        for k in range(max(len(jig.levels), 1)):
            own = f"{name}-level{k}" if jig.levels else name
            lines += ["", "[[plane]]", f"name = {toml(own)}", f"images = {toml(f'{name}/*.png')}"]
            lines += [f"points = {toml(_list_of(name, k))}"] * bool(jig.levels)
            lines += [f"origin = {toml([round(x, 9) for x in pose.translation.tolist()])}"]
            lines += [f"rotation = {toml(list(jig.rotation))}", f"laser = {toml(f'{name}-laser/*.png')}"]
            lines += [f"background = {toml(f'{name}-dark/*.png')}"] * dark
    return "\n".join(lines) + "\n"


def _target(rig: VirtualRig) -> dict[str, object]:
    jig = rig.design.jig
    if jig.levels:  # the laser's light on one level says nothing of another
        return {"kind": "listed", "polarity": jig.polarity, "plate": "marks"}
    pitch = jig.pitches[0] if jig.pitches[0] == jig.pitches[1] else list(jig.pitches)
    target: dict[str, object] = {
        "kind": jig.kind,
        "polarity": jig.polarity,
        "rows": jig.rows,
        "columns": jig.columns,
        "pitch": pitch,
        "diameter": jig.diameter,
    }
    if jig.fiducials:
        target |= {"fiducials": [list(cell) for cell in jig.fiducials], "fiducial_diameter": jig.fiducial_diameter}
    return target


def _list_of(plane: str, level: int) -> str:
    return f"{plane}-level{level}.csv"


def listed_marks(rig: VirtualRig) -> dict[str, str]:
    """Name and content of the lists of a stepped plate's marks, a level each: places in the target, mm, and pixels as one reads them.

    Pixels are those of the plate as stated, to a whole pixel; marks that are not wholly in view are not listed. Empty without levels.
    """
    jig = rig.design.jig
    if not jig.levels:
        return {}
    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(jig.columns), np.arange(jig.rows)))
    height = np.array(jig.heights())[column]
    marks = np.stack([column * jig.pitches[0], row * jig.pitches[1], -height], axis=-1)
    found = {}
    for name, pose in zip(jig.names, rig.stated, strict=True):
        pixels = project(rig.camera, pose.apply(marks))
        beside = np.array([[jig.diameter, jig.diameter, 0.0]])
        room = np.abs(project(rig.camera, pose.apply(marks + beside)) - pixels)
        seen = _inside(pixels - room, rig) & _inside(pixels + room, rig)
        for k, level in enumerate(jig.levels):
            rows = np.flatnonzero(seen & (height == level))
            text = "".join(
                f"{x:.9g},{y:.9g},{z:.9g},{u:.0f},{v:.0f}\n"
                for (x, y, z), (u, v) in zip(marks[rows], pixels[rows], strict=True)
            )
            found[_list_of(name, k)] = "x,y,z,u,v\n" + text
    return found


def _inside(pixels: Array, rig: VirtualRig) -> Bools:
    return np.asarray((pixels > 0.0).all(axis=1) & (pixels < np.array(rig.camera.size) - 1.0).all(axis=1))
