"""`scope roughness`, from files to patches."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from calibration.errors import FileError
from calibration.geometry import Pose
from scope.cloud import Region, ScanCloud
from scope.errors import MeasurementError
from scope.heightmap import ENDINGS, HeightMap, NoLatticeError, read_heights, within
from scope.roughness.measure import Roughness, RoughnessOptions, measure_heights, measure_roughness


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

    An .xyz whose points stand on no lattice is a cloud without scan order.     ``pitch`` is that of a height map which tells none, mm (down, along). An error in one region names it.
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
    found = []
    for name, region in regions or [(source.name, None)]:
        try:
            if heights is not None:
                patch = heights if region is None else within(heights, region)
                found.append(measure_heights(patch, options=options, name=name))
            else:
                found.append(measure_roughness(cloud, region=region, options=options, noise=repeat, name=name))
        except MeasurementError as error:
            raise MeasurementError(f"{name}: {error}") from error
    return found
