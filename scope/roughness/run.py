"""`scope roughness`, from files to patches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.errors import FileError
from calibration.geometry import Pose
from scope.cloud import Region, ScanCloud
from scope.errors import MeasurementError
from scope.export import write_scalars
from scope.heightmap import (
    ENDINGS,
    FlatPatch,
    HeightMap,
    NoLatticeError,
    flat_patches,
    local_roughness,
    read_heights,
    within,
)
from scope.roughness.measure import Roughness, RoughnessOptions, measure_heights, measure_roughness

_SHOWN = 3  # flat patches


def options_from_text(
    form: str,
    *,
    s_filter: float | None = None,
    l_filter: float | None = None,
    stripe_width: float | None = None,
    cloud_from_model: Pose | None = None,
) -> RoughnessOptions:
    """Options as the command line gives them; ``form`` may be ``model:file``, a mesh in the cloud or its own frame.

    ``ValueError`` for a form that is not known, ``FileError`` for a mesh that cannot be read.
    """
    from scope.heightmap import require_form

    width = math.nan if stripe_width is None else stripe_width
    options = RoughnessOptions(s_filter=s_filter, l_filter=l_filter, stripe_width=width)
    if form.startswith("model:"):
        from scope.cloud import read_mesh

        return replace(options, model=read_mesh(Path(form[6:]), cloud_from_model=cloud_from_model))
    require_form(form)
    return replace(options, form=form)


def _map_of(source: Path, pitch: tuple[float, float] | None) -> HeightMap | None:
    """Height map of a file; None where it holds a cloud."""
    if source.suffix.lower() not in ENDINGS:
        return None
    try:
        return read_heights(source, pitch=pitch)
    except NoLatticeError:
        return None


def run_roughness(
    source: Path,
    regions: Sequence[tuple[str, Region | None]],
    options: RoughnessOptions,
    *,
    noise: Path | None = None,
    pitch: tuple[float, float] | None = None,
) -> list[Roughness]:
    """Measure every region of a cloud (.ply, .pcd, .las, .laz, .e57) or of a height map (.npy, .asc, .txt, .xyz, .sdf, .x3p).

    An .xyz whose points stand on no lattice is a cloud without scan order. ``pitch`` is that of a height map which tells none, mm (down, along). An error in one region names it.
    """
    heights = _map_of(source, pitch)
    is_map = heights is not None
    if is_map and (noise is not None or options.model is not None):
        raise FileError(f"{source}: --noise and --form model: need a cloud; a height map has no places in space")
    if not is_map:
        if pitch is not None:
            raise FileError(f"{source}: is a cloud, which has a pitch of its own; leave --pitch away")
        cloud = ScanCloud.load(source)
        repeat = None if noise is None else ScanCloud.load(noise)
    found, seen = [], () if is_map or regions else flat_patches(cloud.points, most=_SHOWN)
    for name, region in regions or [(source.name, None)]:
        try:
            if heights is not None:
                patch = heights if region is None else within(heights, region)
                found.append(measure_heights(patch, options=options, name=name))
            else:
                measured = measure_roughness(cloud, region=region, options=options, noise=repeat, name=name)
                found.append(measured if regions else replace(measured, notes=(_whole(seen), *measured.notes)))
        except MeasurementError as error:
            told = f". Flat patches for --region: {', '.join(p.region for p in seen[:2])}" if seen else ""
            raise MeasurementError(f"{name}: {error}{told}") from error
    return found


def _whole(patches: Sequence[FlatPatch]) -> str:
    """What is said where no region was given: that the whole was measured, and the flat patches that are in it."""
    told = "no --region was given: the whole cloud is taken for one surface"
    shown = ", ".join(f"{patch.region} ({patch.size[0]:.3g} x {patch.size[1]:.3g} mm)" for patch in patches)
    return f"{told}; flat patches in it: {shown}" if shown else told


def write_heights(path: Path, patch: Roughness) -> None:
    """Write the heights that were measured as points in the cloud's frame, mm (see `scope.export.write_scalars`).

    ``height`` is what form and filters have left, ``local_Sq`` the rms height about each point, in windows of 15 % of the shorter side. A
    height map of a file, which has no places, lies in its own frame: x along the rows, y down, z the height.
    """
    heights = patch.heights
    known = heights.known
    rows, columns = np.nonzero(known)
    if heights.points is not None:
        points = heights.points[known]
    else:
        points = np.stack([columns * heights.pitch[1], rows * heights.pitch[0], heights.z[known]], axis=1)
    local = local_roughness(heights.z, heights.pitch, 0.15 * min(heights.size))[known]
    scalars = {"height": heights.z[known], "local_Sq": local}
    if heights.sigma is not None:
        scalars["sigma"] = heights.sigma[known]
    told = (f"heights of {patch.name}, mm; form {heights.form}", *heights.filters)
    write_scalars(path, points, scalars, tuple(line.encode("ascii", "replace").decode("ascii") for line in told))
