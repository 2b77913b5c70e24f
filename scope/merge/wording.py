"""A merge in words and in JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.notation import rotation_vector
from scope.merge.run import Merged


def merge_result(found: Merged) -> dict[str, Any]:
    """What --json gives."""
    return {
        "clouds": list(found.names),
        "poses": None if found.poses is None else [p.matrix.tolist() for p in found.poses],
        "known": found.known,
        "disagreement_mm": found.disagreement_mm,
        "pairs": [
            {"first": p.first, "second": p.second, "share": p.share, "points": p.points, "offset_mm": p.offset_mm,
             "rms_mm": p.rms_mm, "expected_mm": p.expected_mm, "shared_mm": p.shared_mm}
            for p in found.pairs
        ],
        "points": 0 if found.cloud is None else len(found.cloud),
        "convention": "poses are whole_from_cloud, 4x4 in rows, mm; offset_mm is positive where the first scan lies outside the second",
        "passed": found.passed,
        "why": found.why,
    }  # fmt: skip


def merge_text(found: Merged) -> str:
    """What the terminal shows."""
    lines = [f"{'passed' if found.passed else 'NOT PASSED'}: {found.why}"]
    if found.poses is not None and found.cloud is not None:
        lines.append(
            f"{len(found.cloud):,} points of {len(found.names)} scans, disagreement {found.disagreement_mm:.4f} mm rms"
        )
        for name, pose in zip(found.names, found.poses, strict=True):
            x, y, z = pose.translation
            turn = float(np.rad2deg(np.linalg.norm(rotation_vector(pose.rotation))))
            lines.append(f"  {name}: x {x:.3f} y {y:.3f} z {z:.3f} mm, turned by {turn:.3f} degrees")
        lines += [
            f"  {p.first} / {p.second}: {100 * p.share:.0f} % overlap, apart {p.offset_mm:+.4f} mm (median), rms {p.rms_mm:.4f} mm, "
            f"explained {p.expected_mm:.4f} mm"
            for p in found.pairs
        ]  # fmt: skip
    return "\n".join(lines)
