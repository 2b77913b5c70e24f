"""Where a known part is: a pose that is right, or says that it does not know."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from calibration.geometry import Ints, Pose
from scope.cloud import Region, ScanCloud, refuse_sheet
from scope.errors import MeasurementError
from scope.model import Model, Surface
from scope.pose import segmentation
from scope.pose.answer import Candidate, PoseOptions, PoseResult
from scope.pose.glance import glance
from scope.pose.piece import locate

LIKE, UNLIKE = 0.1, 0.4  # unexplained at a glance, beyond that of the part that was found

__all__ = ["Candidate", "PoseOptions", "PoseResult", "estimate_pose"]


def estimate_pose(
    cloud: ScanCloud,
    model: str | Path | Model,
    *,
    region: Region | None = None,
    initial: Pose | None = None,
    part_tolerance: float | None = None,
    options: PoseOptions | None = None,
) -> PoseResult:
    """Position and orientation of a known part in a scan.

    Parameters
    ----------
    cloud : ScanCloud
        mm; with its sensors the free space and the missing surface speak too, without them only the points do.
    model : path or Model
        Mesh file in mm, or a model prepared by `load_model`.
    region : Region, optional
        Where the part is; without it tables are taken away and what stands on them is tried.
    initial : Pose, optional
        A cloud_from_model that is tried too; the search is made all the same.
    part_tolerance : float, optional
        How far surfaces of the right part may lie from the mesh, mm; by default that of the options, 0.1. What
        differs by more is another part: no pose, and ``variant`` says in what. With infinity nothing is asked.
    options : PoseOptions, optional

    Returns
    -------
    PoseResult
        Refused and ambiguous answers carry no pose. Further equal parts are in ``others``.

    Raises
    ------
    MeasurementError
        A cloud in which nothing can be the part: empty, a table only, too small or too large, other units.
    ValueError
        A tolerance that is not positive.
    """
    from scope.model import load_model

    chosen = options or PoseOptions()
    if part_tolerance is not None:
        chosen = replace(chosen, part_tolerance=part_tolerance)
    if not chosen.part_tolerance > 0:
        raise ValueError(f"part_tolerance is {chosen.part_tolerance:g}; it must be a positive length, mm")
    prepared = model if isinstance(model, Model) else load_model(model)
    sides = np.sort(np.ptp(prepared.vertices, axis=0))
    refuse_sheet(cloud)
    if len(cloud):
        _require_units(cloud, prepared, region)
    surface = Surface(prepared.vertices, prepared.faces)

    def tried(tables: bool) -> list[PoseResult]:
        pieces = segmentation.clusters(
            cloud, prepared.diameter, float(sides[1] * sides[2]), width=float(sides[1]), region=region, tables=tables
        )
        pieces = pieces[:12] if chosen.several else pieces[:1]
        found = _in_order(cloud, pieces, prepared, surface, initial, chosen)
        return sorted(found, key=lambda r: (not r.found, -len(r.points)))

    results = tried(tables=region is None)
    if region is not None and not any(r.found or r.ambiguous for r in results):
        # the region may hold some of what the part stands on; where nothing stands out of that, the first answer holds
        with suppress(MeasurementError):
            results = [r for r in tried(tables=True) if r.found] or results
    best = results[0]
    if not best.found:
        best = max(results, key=lambda r: len(r.points))
    others: list[PoseResult] = []
    for result in results:
        if result is not best and result.found and not any(_overlap(r, result) for r in (best, *others)):
            others.append(result)
    return replace(best, others=tuple(others))


def _in_order(
    cloud: ScanCloud,
    pieces: Sequence[Ints],
    model: Model,
    surface: Surface,
    initial: Pose | None,
    options: PoseOptions,
) -> list[PoseResult]:
    """Answers for the pieces of a scan, the most promising first; once one is the part, the others must look like it too.

    What a glance leaves as unexplained decides: a piece that it explains much worse than the one that was found is not searched, and
    one in between without the second, harder search. Until a part is found, every piece is searched in earnest.
    """
    if len(pieces) == 1:
        return [locate(cloud, pieces[0], model, surface, initial, options)]
    looks = [glance(cloud, rows, model) for rows in pieces]
    found: list[PoseResult] = []
    held: list[tuple[float, int]] = []  # glance and size of the pieces that were found to be the part
    for k in np.argsort(looks, kind="stable"):
        # a fragment that fits anywhere says nothing about a piece that is much larger
        best = min((look for look, size in held if size >= 0.5 * len(pieces[k])), default=np.inf)
        if looks[k] > best + UNLIKE:
            continue
        search = options if looks[k] <= best + LIKE else replace(options, harder=False)
        found.append(locate(cloud, pieces[k], model, surface, initial, search))
        if found[-1].found:
            held.append((looks[k], len(pieces[k])))
    return found


def _overlap(a: PoseResult, b: PoseResult) -> bool:
    """Whether two found parts would stand in each other (3 % of the surface of one deeper than 1 % of the diameter)."""
    if a.cloud_from_model is None or b.cloud_from_model is None:
        return False
    motion = a.cloud_from_model.inverse @ b.cloud_from_model
    depth = a.model.fine.look_up(motion.apply(a.model.samples[::10]))[0]
    return bool((depth < -0.01 * a.model.diameter).mean() > 0.03)


_UNITS = (
    (1000.0, "metres"),
    (25.4, "inches"),
    (10.0, "centimetres"),
    (1 / 25.4, "mm, and the cloud in inches"),
    (1e-3, "micrometres (or a GLB that holds mm: its format is in metres)"),
)


def _require_units(cloud: ScanCloud, model: Model, region: Region | None) -> None:
    """Refuse a model and a cloud whose sizes differ by more than any one-sided scan explains."""
    points = cloud.points if region is None else cloud.points[region.contains(cloud.points)]
    if len(points) < segmentation.LEAST_POINTS:
        return
    size = segmentation.extent(points)
    ratio = size / model.diameter
    if 0.15 < ratio < 8:
        return
    near = [name for factor, name in _UNITS if 0.15 < ratio / factor < 4]
    guess = f"it looks as if the mesh were in {' or '.join(near)}" if near else "no usual unit explains that"
    raise MeasurementError(
        f"the mesh {model.name} is {model.diameter:.4g} across and the cloud {size:.4g} mm: a factor of {ratio:.3g}; {guess}; "
        "export the mesh in mm, or give the region of the part"
    )
