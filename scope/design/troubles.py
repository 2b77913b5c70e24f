"""What is wrong with a design, each in a sentence that says what to do."""

from __future__ import annotations

import numpy as np

from scope.design.prediction import WorkingMap
from scope.design.spots import PlannedPlane
from scope.simulation import VirtualRig

LEAST_ANGLE = 5.0  # degrees between sighting rays and sheet
LEAST_SPOT = 5.0  # px
WIDEST = 32.0  # px, one sigma, of a stripe: what ranging takes for one
_BLURRED = 4.0  # px, one sigma: a stripe or an edge that wide is out of focus
THINNEST = 0.7  # px, one sigma
_DIM = 12.0  # grey levels of 8 bits


def troubles(rig: VirtualRig, planes: list[PlannedPlane], area: WorkingMap) -> list[str]:
    """Sentences about what will not work, or not well; none for a sound design."""
    said = []
    inside = area.prediction.inside
    angle = float(np.degrees(np.median(area.prediction.angle[inside])))
    if angle < LEAST_ANGLE:
        said.append(
            f"the triangulation angle is {angle:.1f} degrees; {LEAST_ANGLE:g} at least are needed: move the laser away from the "
            "camera, or turn it towards the volume"
        )
    said += _about_spots(rig, planes)
    seen = area.prediction.look
    share = float(np.mean(inside.reshape(len(area.depth), -1).any(axis=1)))
    if share < 0.999:
        said.append(
            f"the sheet of light leaves the working volume over {1 - share:.0%} of its depth; aim [laser] `through` the middle of "
            "the jig, or turn the camera towards it"
        )
    worst = float(np.max(seen.blur_px[inside]))
    if worst > _BLURRED:
        place = area.prediction.points[inside][int(np.argmax(seen.blur_px[inside]))]
        said.append(
            f"the lens is out of focus by {worst:.1f} px (one sigma) at z = {place[2]:.0f} mm; focus on the middle of the volume, "
            "or close the aperture"
        )
    thin = float(np.median(seen.stripe_px[inside]))
    if thin < THINNEST:
        said.append(
            f"the stripe is {thin:.2f} px wide (one sigma); {THINNEST:g} at least are wanted, since where in a pixel it lies would "
            "shift it: a wider laser line, or a longer lens"
        )
    wide = float(np.max(seen.stripe_px[inside]))
    if wide > WIDEST:
        said.append(
            f"the stripe is up to {wide:.1f} px wide (one sigma), and ranging takes none above {WIDEST:g}: a thinner laser line, a "
            "shorter lens, or a larger stand-off"
        )
    clipped = float(np.mean(seen.clipped[inside]))
    if clipped > 0.01:
        said.append(
            f"the stripe clips on {clipped:.0%} of the volume (peak {float(np.max(seen.signal[inside])):.0f} of {rig.sensor.white} "
            "grey levels); give less light or a shorter exposure"
        )
    dim = _DIM * (rig.sensor.white + 1) / 256
    if float(np.median(seen.signal[inside])) < dim:
        said.append(
            f"the stripe's peak is {float(np.median(seen.signal[inside])):.1f} grey levels; {dim:g} at least are needed: more laser "
            "power or a longer exposure"
        )
    return said


def _about_spots(rig: VirtualRig, planes: list[PlannedPlane]) -> list[str]:
    said = []
    sizes = [(float(np.min(plane.diameter)), plane.name) for plane in planes if len(plane.diameter)]
    if sizes and min(sizes)[0] < LEAST_SPOT:
        size, name = min(sizes)
        said.append(
            f"spots are {size:.1f} px wide on plane {name}; {LEAST_SPOT:g} px at least are needed: larger spots, a longer lens or a "
            "nearer jig"
        )
    total = rig.design.jig.rows * rig.design.jig.columns
    few = [plane for plane in planes if len(plane.pixels) < 0.5 * total]
    if few:
        worst = min(few, key=lambda plane: len(plane.pixels))
        said.append(
            f"{len(worst.pixels)} of {total} spots are in view on plane {worst.name}; half at least are wanted: a smaller grid, or "
            "a farther jig"
        )
    soft = [plane.name for plane in planes if plane.blurred.any()]
    if soft:
        said.append(
            f"spots are blurred by more than 0.3 of their size on {', '.join(soft)}; focus nearer to there, close the aperture, or "
            "take larger spots"
        )
    if len(planes) < 3:
        said.append(f"{len(planes)} stand-offs cannot prove each other; plan three or more")
    return said
