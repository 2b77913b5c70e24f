"""Is it this part? What a scan differs in from the mesh at its best pose: a size, a dimension, a hole, a boss, the hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibration.geometry import Pose
from scope.model import Scanned, Weighting, refine
from scope.variants.hypotheses import Hypothesis, hypotheses_of
from scope.variants.misfits import Misfits, clusters, edges_off, misfits_of
from scope.variants.system import CAP, SURE, Evidence, Fitted, System, along, cost_of, solved, system_of
from scope.variants.variant import Undecided, Variant, named, unknown_of

LEAST_SHARE = 0.005  # of the points that must be misfits before anything is asked
LEAST_EDGES = 0.04  # of the edges that must end elsewhere, the same
LEAST_GAIN = 30.0  # nats by which a variant must explain the scan better
TIE = 0.08  # of that gain: what explains nearly as much is an alternative
NUMBER = 2.0  # nats a number of a variant costs
PLACE = 0.5  # of a point's cost that a place with more or less material takes away: it explains anything
PLAIN = ("scale", "mirrored", "dimension", "missing", "hole", "boss", "diameter", "extra")  # plainest first


def judge(
    evidence: Evidence, mirror: Callable[[], Pose | None] | None = None
) -> tuple[Variant | None, tuple[Undecided, ...]]:
    """What the residuals of a pose say about the part.

    Parameters
    ----------
    evidence : Evidence
    mirror : callable, optional
        Searches the pose of the mirrored scan and gives the pose, model from mirrored cloud; asked only where something
        does not fit. The mirror is x -> -x of the cloud.

    Returns
    -------
    (Variant or None, tuple of Undecided)
        None where sigma, the calibration and the tolerance explain the scan.

    Notes
    -----
    Every variant adds one or two columns to the system of the pose (Chen & Medioni 1991): the derivative of the residuals by
    its size. It is found by iterated least squares with Tukey's weights, from wide to narrow; its standard error is that
    of least squares with errors of one patch alike in any way and those of the calibration shared by all. It is
    believed where it moves surfaces apart by more than the tolerance and three standard errors, where half a per cent of the points lie
    further off than three sigma and the tolerance without it (or edges or whole places say so), and where it explains the scan
    better by 30 nats and a twentieth.
    Weak: what is linear in none of the columns is only named by its place.
    """
    system, sight, local = system_of(evidence)
    hypotheses = hypotheses_of(evidence.surface, evidence.surface.features, evidence.model.vertices)
    tolerance = evidence.tolerance
    nominal = solved(system, np.zeros((len(system.residual), 0)), tolerance)
    each = [(h, solved(system, h.columns(system.rows, evidence.model.centre), tolerance)) for h in hypotheses]
    off = misfits_of(evidence, sight, local, nominal, system)
    undecided = unknown_of(evidence, each)
    edges = edges_off(system, nominal.residual, tolerance)
    places = clusters(evidence, sight, local, off)
    if off.share < LEAST_SHARE and edges < LEAST_EDGES and not places:
        return None, undecided + _mirror_undecided(evidence)
    stray = CAP * off.scale * float(off.away.sum())
    cost = cost_of(system, nominal.residual, tolerance) + stray
    choices = _sizes(system, each, off, max(edges, LEAST_EDGES), tolerance)
    choices += [(cost - PLACE * CAP * off.scale * count, variant) for variant, count in places]
    doubt = off.share >= LEAST_SHARE or bool(places)  # edges alone do not tell the hand
    if doubt and mirror is not None and (pose := mirror()) is not None:
        told, share = _image(evidence, pose)
        if share < max(LEAST_SHARE, 0.2 * off.share):
            hand = Variant("mirrored", np.nan, np.nan, "", "the scan fits the mirror image of the mesh", None)
            choices.append((told, hand))
    least = min((c for c, _ in choices), default=cost)
    if cost - least < max(LEAST_GAIN, 0.05 * cost):
        return None, undecided
    tied = [v for c, v in sorted(choices, key=lambda c: c[0]) if c < least + max(TIE * (cost - least), 6.0)]
    best = min(tied, key=lambda v: PLAIN.index(v.kind))
    return replace(best, alternatives=tuple(v.text for v in tied if v is not best)[:3]), undecided


def _sizes(
    system: System, each: list[tuple[Hypothesis, Fitted]], off: Misfits, edges: float, tolerance: float
) -> list[tuple[float, Variant]]:
    """Variants that move surfaces apart by more than the tolerance explains, each with what it leaves, in nats."""
    found = []
    for h, f in each:
        error, size = float(np.sqrt(max(along(f), 0.0))), float(np.linalg.norm(f.size))
        if f.effect * (1 - SURE * error / max(size, 1e-12)) > tolerance:
            left = min(edges_off(system, f.residual, tolerance) / edges, 1.0)
            # what hung over the edges hangs over no more
            stray = CAP * off.scale * float(off.away.sum() - off.hanging.sum() * (1 - left))
            found.append((cost_of(system, f.residual, tolerance) + stray + NUMBER * len(f.size), named(h, f, error)))
    return found


# --- the other hand ---------------------------------------------------------------------------------------------------

MIRROR = np.diag([-1.0, 1.0, 1.0])


def _image(evidence: Evidence, pose: Pose) -> tuple[float, float]:
    """Nats of the scan's mirror image on the mesh, at a pose model from mirrored cloud, and the share of its misfits."""
    scan = evidence.scan
    camera, laser = (None if e is None else e @ MIRROR for e in (scan.camera, evidence.laser))
    image = replace(
        evidence, pose=pose.inverse, scan=Scanned(scan.points @ MIRROR, scan.sigma, camera), laser=laser,
        all_points=evidence.all_points @ MIRROR,
    )  # fmt: skip
    system, sight, local = system_of(image)
    fit = solved(system, np.zeros((len(system.residual), 0)), image.tolerance)
    off = misfits_of(image, sight, local, fit, system)
    return cost_of(system, fit.residual, image.tolerance) + CAP * float(off.away.sum()) * off.scale, off.share


def _mirror_undecided(evidence: Evidence) -> tuple[Undecided, ...]:
    """The other hand, where the scan lies on the mesh when it is reflected in a principal plane, and the mesh does not."""
    model, surface, scan = evidence.model, evidence.surface, evidence.scan
    centre = model.centre
    axes = np.linalg.eigh(np.cov((model.samples - centre).T))[1].T
    local = evidence.pose.inverse.apply(scan.points)
    few = np.linspace(0, len(local) - 1, min(len(local), 1500)).astype(np.int64)
    sighted = Scanned(local[few], scan.sigma[few], None)
    weighting = Weighting(0.5 * evidence.tolerance, borders=True)
    limit = SURE * scan.sigma[few] + evidence.tolerance
    for axis in axes:
        turn = np.eye(3) - 2 * np.outer(axis, axis)
        itself = (model.samples[::9] - centre) @ turn + centre
        away = np.linalg.norm(surface.nearest(itself)[0] - itself, axis=1)
        image = Scanned((local[few] - centre) @ turn + centre, sighted.sigma, None)
        pose = refine(surface, Pose.identity(), image, reach=(2.0, 1.0, 0.5, 0.5), weighting=weighting).pose
        there = pose.inverse.apply(image.points)
        gap = np.linalg.norm(surface.nearest(there)[0] - there, axis=1)
        if (gap < limit).mean() > 1 - LEAST_SHARE and (away > 3 * evidence.tolerance).mean() > LEAST_SHARE:
            worst = np.argmax(away)
            out = evidence.pose.rotation @ model.normals[::9][worst]
            return (Undecided("mirrored", "the mirror image of the part", out),)
    return ()
