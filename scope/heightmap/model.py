"""Patches chosen by a mesh, and the mesh itself as the form: a CAD surface in the cloud frame."""

from __future__ import annotations

import numpy as np

from scope.cloud import NEAR, Mesh
from scope.errors import MeasurementError
from scope.heightmap.heights import HeightMap


def remove_model(heights: HeightMap, mesh: Mesh) -> HeightMap:
    """Take a CAD surface off a height map: what is left is the signed distance to it, about its mean.

    The mesh must stand in the cloud frame to within what a plane can mend: offset and tilt that are left are removed.

    Raises
    ------
    MeasurementError
        The mesh is nowhere near the patch.
    ValueError
        A map without points.
    """
    if heights.points is None:
        raise ValueError("a model needs the points of the heights")
    known = heights.known
    distance = mesh.signed_distance(heights.points[known])
    middle = float(np.median(np.abs(distance)))
    if middle > 5.0 * NEAR:
        raise MeasurementError(
            f"the model is {middle:.3g} mm away from the patch; bring it into the cloud's frame (scope pose gives the "
            "pose) or choose the region it belongs to"
        )
    down, along = heights.places()
    design = np.stack([np.ones(int(known.sum())), down[known], along[known]], axis=1)
    z = np.full(heights.z.shape, np.nan)
    z[known] = distance - design @ np.linalg.lstsq(design, distance, rcond=None)[0]
    return heights.with_heights(z, form="model")
