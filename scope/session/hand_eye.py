"""hand-eye.json: where the camera is on a robot, as `scope hand-eye` writes it and a scan reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from calibration import checked
from calibration.atomic import write_text
from calibration.errors import FileError
from calibration.geometry import Array, Pose
from calibration.seal import altered, sealed
from calibration.stages import Mount, Repeatability

KIND = "scope hand-eye"
FORMAT = 1
_LARGEST = 16 << 20  # bytes
SENSOR: Mapping[Mount, str] = {"hand": "flange_from_camera", "fixed": "base_from_camera"}
TARGET: Mapping[Mount, str] = {"hand": "base_from_target", "fixed": "flange_from_target"}


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """Where the camera frame C of a rig is on a robot."""

    mount: Mount
    sensor: Pose  # flange_from_camera, or base_from_camera
    target: Pose  # base_from_target, or flange_from_target
    covariance: Array  # (6, 6) of ``sensor``: x, y, z mm, turns about x, y, z of the frame it leads to, rad
    robot: Repeatability  # standard deviations of one pose of the robot
    rig_sha256: str  # of the rig whose C it is; empty where it was in memory
    passed: bool
    why: str
    told: Mapping[str, Any] = field(default_factory=dict)  # further figures of --json

    def content(self) -> dict[str, Any]:
        """What the file holds, and --json prints."""
        return {
            "kind": KIND,
            "format": FORMAT,
            "units": "mm",
            "mount": self.mount,
            SENSOR[self.mount]: self.sensor.matrix.tolist(),
            TARGET[self.mount]: self.target.matrix.tolist(),
            "covariance": self.covariance.tolist(),
            "repeatability_mm": self.robot.mm,
            "repeatability_deg": float(np.rad2deg(self.robot.rad)),
            "rig_sha256": self.rig_sha256,
            "passed": self.passed,
            "why": self.why,
            **self.told,
        }

    def save(self, path: str | Path) -> None:
        """Write the file whole, with a seal."""
        write_text(Path(path), json.dumps(sealed(self.content()), indent=1, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> HandEye:
        """Read the file; ``FileError`` where it is missing, damaged, altered, of a newer format or something else."""
        path = Path(path)
        try:
            if path.stat().st_size > _LARGEST:
                raise FileError(f"{path}: {path.stat().st_size} bytes; give the hand-eye.json of scope hand-eye")
            content = json.loads(path.read_bytes())
        except OSError as error:
            raise FileError(
                f"{path}: cannot be read ({error.strerror}); give the hand-eye.json of scope hand-eye"
            ) from error
        except (ValueError, RecursionError) as error:
            raise FileError(f"{path}: is no JSON ({str(error)[:80]}); run scope hand-eye again") from error
        if not isinstance(content, dict) or content.get("kind") != KIND:
            raise FileError(f"{path}: says not where a camera is on a robot; give the hand-eye.json of scope hand-eye")
        if content.get("format") != FORMAT:
            raise FileError(f"{path}: format {content.get('format')!r}; this version reads {FORMAT}: update SCOPE")
        changed = altered(content)
        if changed:
            raise FileError(
                f"{path}: altered since it was written: {', '.join(changed)[:80]}; run scope hand-eye again"
            )
        try:
            mount: Mount = "hand" if checked.one_of(content["mount"], {"hand", "fixed"}) == "hand" else "fixed"
            return cls(
                mount, _pose(content[SENSOR[mount]]), _pose(content[TARGET[mount]]), checked.array(content["covariance"], 6, 6),
                Repeatability(float(content["repeatability_mm"]), float(np.deg2rad(content["repeatability_deg"]))),
                str(content["rig_sha256"]), content["passed"] is True, str(content["why"]),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
            raise FileError(f"{path}: damaged ({str(error)[:80]}); run scope hand-eye again") from error


def _pose(content: Any) -> Pose:
    return Pose.from_matrix(checked.array(content, 4, 4), tolerance=1e-6)
