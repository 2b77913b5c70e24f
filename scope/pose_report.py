"""A pose in words, in JSON that robots read, and on a page."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.geometry import Array, Pose
from scope.cloud import quaternion_from_rotation
from scope.page import Page
from scope.pose_model import Model

SHOWN = 20_000  # points of a cloud on the page


def what_differs(model: Model, best: Pose, rival: Pose) -> str:
    """Where on the model two poses differ most, and from where that is seen, in words.

    The model's samples are moved by the motion between the two poses; those far from the surface then are the features
    that tell them apart.
    """
    motion = rival.inverse @ best
    away = np.abs(model.fine.look_up(motion.apply(model.samples))[0])
    worst = away > 0.5 * float(away.max())
    if float(away.max()) < 1e-3 * model.diameter:
        return "the mesh itself looks the same in both poses"
    middle = np.median(model.samples[worst], axis=0)
    near = worst & (np.linalg.norm(model.samples - middle, axis=1) < 0.15 * model.diameter)
    out = model.normals[near if near.any() else worst].mean(axis=0)
    seen = best.rotation @ (out / max(float(np.linalg.norm(out)), 1e-9))
    return (
        f"the poses differ most about ({middle[0]:.0f}, {middle[1]:.0f}, {middle[2]:.0f}) mm of the model (by {away.max():.1f} mm); "
        f"scan it from the direction ({seen[0]:.2f}, {seen[1]:.2f}, {seen[2]:.2f}) of the cloud"
    )


def roll_pitch_yaw(rotation: Array) -> Array:
    """Angles (3,) rad about the fixed axes x, then y, then z: R = Rz(yaw) Ry(pitch) Rx(roll).

    At pitch = +-90 degrees only the sum or difference of the others is known: roll is then 0.
    """
    pitch = float(np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0])))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        return np.array([0.0, pitch, float(np.arctan2(-rotation[0, 1], rotation[1, 1]))])
    roll = float(np.arctan2(rotation[2, 1], rotation[2, 2]))
    return np.array([roll, pitch, float(np.arctan2(rotation[1, 0], rotation[0, 0]))])


def pose_json(pose: Pose) -> dict[str, Any]:
    """One transform in three notations: row-major 4x4 (mm), translation (mm) with quaternion w x y z, and with angles."""
    return {
        "matrix": pose.matrix.tolist(),
        "translation_mm": pose.translation.tolist(),
        "quaternion_wxyz": quaternion_from_rotation(pose.rotation).tolist(),
        "rpy_deg": np.degrees(roll_pitch_yaw(pose.rotation)).tolist(),
    }


CONVENTION = (
    "a_from_b maps points of b to a: x_a = R x_b + t, 4x4 row-major, mm. quaternion w x y z. rpy: degrees about the fixed "
    "axes x, y, z in this order, R = Rz Ry Rx. covariance: 6x6 of (x, y, z mm, turns about x, y, z of the cloud, rad), the "
    "turns about the model's origin."
)


def deviation_text(deviation: Array) -> str:
    """Percentiles of signed distances in one line; points further than 2 mm are other things."""
    near = deviation[np.isfinite(deviation) & (np.abs(deviation) < 2.0)]
    if len(near) == 0:
        return "no point near the model"
    low, middle, high = np.percentile(near, [2.5, 50, 97.5])
    return f"95 % of the points lie between {low:+.3f} and {high:+.3f} mm of the mesh, median {middle:+.3f} mm"


def pose_page(
    title: str, found: bool, words: str, tell: str, rows: list[dict[str, Any]], scans: list[tuple[str, Array, Array]]
) -> str:
    """One HTML page.

    Parameters
    ----------
    title, words, tell : str
        Heading, verdict, and what would settle an ambiguity ('' for nothing).
    found : bool
        Whether there is a pose to use.
    rows : list of dict
        Candidates, best first, with explained, blocked, covered and behind.
    scans : list of (caption, points (N, 3), values (N,))
        Clouds to be shown, coloured by value.
    """
    page = Page(title)
    page.verdict("good" if found else "bad", words)
    if tell:
        page.text(f"What would settle it: {tell}.")
    page.heading("Candidates")
    page.text(
        "Explained: share of the points that lie on the model. Blocked: share of the points that camera or laser would have "
        "seen through it. Covered: share of the surface that both should have seen and that has points. Behind: evidence, in "
        "nats, by which a pose is worse than the best."
    )
    page.table(
        ["candidate", "explained", "blocked", "covered", "behind"],
        [
            [
                f"{k + 1}",
                f"{100 * r['explained']:.1f} %",
                f"{100 * r['blocked']:.1f} %",
                "-" if not np.isfinite(r["covered"]) else f"{100 * r['covered']:.1f} %",
                f"{r['behind']:.0f}",
            ]
            for k, r in enumerate(rows)
        ],
    )
    for caption, points, values in scans:
        page.cloud(points, values, caption, limit=2 * SHOWN)
    page.text(CONVENTION)
    return page.html()
