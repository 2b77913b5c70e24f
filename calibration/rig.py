"""A calibrated rig, and the one versioned JSON file that holds it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration import checked
from calibration.atomic import write_text
from calibration.errors import FileError
from calibration.geometry import Array, Plane, Pose
from calibration.notebook import Picture, Shown, Summary, scatter
from calibration.rays import Domain, PinholeCamera, PlaneMap, RayField, TwoPlaneCamera, exponents
from calibration.seal import altered, sealed
from calibration.sheet import CurvedSheet, Laser, PlaneOfLight, Sheet, SheetFrame, order_of
from calibration.stages import Stage
from calibration.volume import Volume

FORMAT = 1
_LARGEST = 64 << 20  # bytes
_CHANNELS = {"auto", "gray", *(f"{colour}{kind}" for colour in ("red", "green", "blue") for kind in ("", "-excess"))}

AnyCamera = TwoPlaneCamera | PinholeCamera


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """The verdict on a calibration."""

    passed: bool
    why: str
    faults: tuple[dict[str, Any], ...] = ()
    planes: tuple[dict[str, Any], ...] = ()  # as `scope calibrate --json` gives them
    interplane_px: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rig(Shown):
    """Camera, lasers and stages in frame C, and what was verified."""

    camera: AnyCamera
    lasers: Mapping[str, Laser]
    stages: tuple[Stage, ...]
    verification: Verification
    accept: Mapping[str, float] = field(default_factory=dict)  # limits of [accept]
    camera_id: str = ""
    blur_px: float = float("nan")  # one sigma of lens and pixel, as the edges of spots show it; NaN without spots
    written: str = ""  # date and time, ISO 8601
    software: str = ""
    operator: str = ""  # who calibrated, where he was named
    inputs: Mapping[str, str] = field(default_factory=dict)  # file name: SHA-256
    sha256: str = ""  # of the file it was read from
    sealed: bool = True  # False: read from a file of an earlier version, in which an alteration cannot be seen

    @classmethod
    def load(cls, path: str | Path, *, allow_edited: bool = False) -> Rig:
        """Read a rig; ``FileError`` where it is missing, damaged, altered, of a newer format or no rig at all.

        With ``allow_edited`` a rig that was altered since it was written, as its seal tells, is taken as one that did not
        pass its verification. A rig without a seal is of an earlier version: it is taken as it is, and says so.
        """
        path = Path(path)
        try:
            size = path.stat().st_size
            if size > _LARGEST:
                raise FileError(f"{path}: {size} bytes; a rig has at most {_LARGEST}: check the path")
            data = path.read_bytes()
        except OSError as error:
            raise FileError(
                f"{path}: cannot be read ({error.strerror}); give the rig.json of scope calibrate"
            ) from error
        try:
            content = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise FileError(
                f"{path}: is no JSON ({str(error)[:80]}); give the rig.json of scope calibrate; if it is that, calibrate again"
            ) from error
        if not isinstance(content, dict) or content.get("kind") != "scope rig":
            raise FileError(f"{path}: is no rig; give the rig.json of scope calibrate")
        if content.get("format") != FORMAT:
            raise FileError(
                f"{path}: rig format {content.get('format')!r}; this version reads format {FORMAT}: update SCOPE or "
                "calibrate again with this version"
            )
        where = ""
        try:
            changed = altered(content)
            where = "" if not changed else f" in {_listed(changed)}"
            rig = _rig(content, hashlib.sha256(data).hexdigest())
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError, RecursionError) as error:
            text = f"{type(error).__name__}: {error}"[:100]
            raise FileError(f"{path}: damaged or edited{where} ({text}); calibrate again") from error
        if changed is None:
            return replace(rig, sealed=False)
        if not changed:
            return rig
        if not allow_edited:
            raise FileError(
                f"{path}: altered since it was calibrated: {_listed(changed)}; restore the file or calibrate again "
                "(--allow-edited takes it as unverified)"
            )
        why = f"edited after calibration: {_listed(changed)}; {rig.verification.why}"
        return replace(rig, verification=replace(rig.verification, passed=False, why=why))

    def summary(self) -> Summary:
        """Camera, lasers, stages and verdict."""
        width, height = self.camera.size
        verdict = "verified" if self.verification.passed else f"not verified ({self.verification.why})"
        figures = [("camera", f"{width} x {height} px"), ("lasers", ", ".join(self.lasers) or "none")]
        if self.stages:
            figures.append(("stages", ", ".join(stage.kind for stage in self.stages)))
        if self.sha256:
            figures.append(("file", self.sha256[:8]))
        return Summary(f"Rig, {verdict}", tuple(figures))

    def picture(self) -> tuple[Picture | None, str]:
        """The sheets of light within the calibrated volume, from the side."""
        width, height = self.camera.size
        u, v = np.meshgrid(np.linspace(0, width - 1, 120), np.linspace(0, height - 1, 120))
        rays = self.camera.rays(np.stack([u.ravel(), v.ravel()], axis=1))
        lit = [laser.sheet.intersect(rays).points for laser in self.lasers.values()]
        points = np.concatenate([np.zeros((0, 3)), *lit])
        number = np.repeat(np.arange(len(lit), dtype=np.float64), [len(part) for part in lit])
        inside = self.camera.volume.contains(points)
        x, y, z = points[inside].T
        return scatter(x, z, number[inside] if len(lit) > 1 else y), "sheets in the calibrated volume: x right, z down"

    def save(self, path: str | Path) -> None:
        """Write the rig whole, or not at all."""
        content = _content(self)
        write_text(
            Path(path), json.dumps(sealed(content) if self.sealed else content, indent=1, allow_nan=False) + "\n"
        )


def _listed(names: tuple[str, ...]) -> str:
    """Names in one short line."""
    shown = ", ".join(name[:40] for name in names[:4])
    return shown if len(names) <= 4 else f"{shown} and {len(names) - 4} more"


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal; ``FileError`` where it cannot be read."""
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); check the path") from error


def _content(rig: Rig) -> dict[str, Any]:
    content: dict[str, Any] = _plain(
        {
            "kind": "scope rig",
            "format": FORMAT,
            "units": "mm",
            "written": rig.written,
            "software": rig.software,
            "operator": rig.operator,
            "camera_id": rig.camera_id,
            "blur_px": rig.blur_px,
            "camera": _camera_content(rig.camera),
            "lasers": {name: _laser_content(laser) for name, laser in rig.lasers.items()},
            "stages": [_fields(stage) for stage in rig.stages],
            "accept": dict(rig.accept),
            "verification": _fields(rig.verification),
            "inputs": dict(rig.inputs),
        }
    )
    return content


def _camera_content(camera: AnyCamera) -> dict[str, Any]:
    if isinstance(camera, PinholeCamera):
        return {"model": "pinhole", **_fields(camera)}
    return {
        "model": camera.model,
        "size": list(camera.size),
        "volume": _fields(camera.volume),
        "maps": [_fields(plane_map) for plane_map in camera.maps],
        "field": _fields(camera.field),
    }


def _laser_content(laser: Laser) -> dict[str, Any]:
    content = _fields(laser)
    content["sheet"] = {"kind": "curved" if isinstance(laser.sheet, CurvedSheet) else "plane", **_fields(laser.sheet)}
    return content


def _fields(value: Any) -> dict[str, Any]:
    """Fields of a frozen value, nested values too."""
    return {name: getattr(value, name) for name in type(value).__dataclass_fields__}


def _plain(value: Any) -> Any:
    """Value made of what JSON has; NaN and infinities become null."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if hasattr(type(value), "__dataclass_fields__"):
        value = _fields(value)
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def _rig(content: dict[str, Any], digest: str) -> Rig:
    verdict = content["verification"]
    camera = _camera(content["camera"])
    return Rig(
        camera=camera,
        lasers={str(name): _laser(item, camera) for name, item in content["lasers"].items()},
        stages=checked.each(content["stages"], lambda item: _stage(item, camera)),
        verification=Verification(
            verdict["passed"] is True, str(verdict["why"]), checked.each(verdict["faults"], dict), checked.each(verdict["planes"], _told),
            checked.number(verdict["interplane_px"]),
        ),
        accept={str(key): float(value) for key, value in content["accept"].items()},
        camera_id=str(content["camera_id"]),
        blur_px=checked.blur(content.get("blur_px")),  # rigs of earlier versions have none
        written=str(content["written"]),
        software=str(content["software"]),
        operator=str(content.get("operator", "")),  # rigs of earlier versions have none
        inputs={str(key): str(value) for key, value in content["inputs"].items()},
        sha256=digest,
    )  # fmt: skip


def _told(content: Any) -> dict[str, Any]:
    """What was found on one plane."""
    return {**dict(content), "name": content["name"], "loo_px": content["loo_px"], "heldout_mm": content["heldout_mm"]}


def _camera(content: dict[str, Any]) -> AnyCamera:
    size = (int(content["size"][0]), int(content["size"][1]))
    if not (0 < size[0] < 1 << 20 and 0 < size[1] < 1 << 20):
        raise ValueError(f"images of {size[0]} x {size[1]} px")
    volume = _volume(content["volume"])
    if content["model"] == "pinhole":
        return PinholeCamera(
            checked.array(content["matrix"], 3, 3), checked.array(content["distortion"], 5), _pose(content["c_from_camera"]), size, volume,
            checked.array(content["covariance"], 9, 9, known=False), checked.number(content["sigma"]),
        )  # fmt: skip
    if content["model"] not in {"two-plane", "joint"}:
        raise ValueError(f"camera model {content['model']!r}")
    maps, field = checked.each(content["maps"], _plane_map), _field(content["field"])
    if len(maps) < 2 or len(maps) != len(field.depths):
        raise ValueError(f"{len(maps)} plane maps and {len(field.depths)} depths; two or more, one a depth")
    return TwoPlaneCamera(maps, field, size, volume, content["model"])


def _volume(content: dict[str, Any]) -> Volume:
    normals, offsets = checked.array(content["normals"], -1, 3), checked.array(content["offsets"], -1)
    if len(normals) != len(offsets):
        raise ValueError(f"a volume of {len(normals)} normals and {len(offsets)} offsets; one each")
    return Volume(normals, offsets)


def _pose(content: dict[str, Any]) -> Pose:
    return Pose(checked.rotation(content["rotation"]), checked.array(content["translation"], 3))


def _domain(content: dict[str, Any]) -> Domain:
    return Domain(
        checked.array(content["homography"], 3, 3),
        checked.array(content["centre"], 2),
        checked.array(content["half"], 2),
    )


def _plane_map(content: dict[str, Any]) -> PlaneMap:
    terms = content["terms"] if content["terms"] in {"linear", "paper"} else checked.order(content["terms"])
    n = len(exponents(terms))
    return PlaneMap(
        str(content["name"]), terms, _domain(content["domain"]), checked.array(content["coefficients"], n, 2),
        _pose(content["c_from_plane"]), checked.array(content["inverse"], n, n, known=False), checked.number(content["sigma"]),
    )  # fmt: skip


def _field(content: dict[str, Any]) -> RayField:
    slope, origin = checked.order(content["slope_order"]), checked.order(content["origin_order"])
    n = len(exponents(slope)) + len(exponents(origin))
    return RayField(
        checked.rotation(content["c_from_d"]), _domain(content["domain"]), slope, origin, float(content["pivot"]),
        checked.positive(content["reach"]), checked.array(content["coefficients"], n, 2), checked.array(content["inverse"], n, n, known=False),
        checked.number(content["sigma"]), checked.array(content["depths"], -1), float(content["forward"]),
    )  # fmt: skip


def _frame(content: dict[str, Any]) -> SheetFrame:
    return SheetFrame(
        checked.array(content["centre"], 3), checked.array(content["axes"], 2, 3), checked.positive(content["reach"])
    )


def _laser(content: dict[str, Any], camera: AnyCamera) -> Laser:
    terms = len(content["covariance"])
    order_of(terms)
    return Laser(
        str(content["name"]), _sheet(content["sheet"]), _frame(content["frame"]), checked.array(content["covariance"], terms, terms, known=False),
        checked.array(content["origin"], 3, known=False), checked.one_of(content["along"], {"rows", "columns"}),
        checked.one_of(content["channel"], _CHANNELS), checked.number(content["rms_mm"]),
        checked.number(content["loo_mm"]), checked.number(content["flatness_mm"]), checked.number(content["flatness_sigma"]), int(content["n"]),
        checked.each(
            content["planes"],
            lambda p: PlaneOfLight(str(p["plane"]), int(p["n"]), checked.number(p["rms_mm"]), checked.number(p["loo_mm"])),
        ),
        _coupling(content.get("coupling"), terms, camera), checked.number(content.get("local_mm")),
    )  # fmt: skip


def _coupling(content: Any, terms: int, camera: AnyCamera) -> Array:
    """How a sheet or a stage follows the camera; rigs of a jig or of earlier versions have none."""
    return checked.array(content, terms, len(camera.covariance)) if content else np.zeros((0, 0))


def _sheet(content: dict[str, Any]) -> Sheet:
    if content["kind"] == "curved":
        base = content["plane"]
        plane = Plane(checked.unit(base["normal"]), float(base["offset"]))
        order_of(3 + len(content["curvature"]))
        return CurvedSheet(plane, _frame(content["frame"]), checked.array(content["curvature"], -1))
    return Plane(checked.unit(content["normal"]), float(content["offset"]))


def _stage(content: dict[str, Any], camera: AnyCamera) -> Stage:
    if content["kind"] not in {"linear", "turntable"}:
        raise ValueError(f"stage {content['kind']!r}")
    return Stage(
        content["kind"], checked.unit(content["direction"]), checked.array(content["point"], 3), checked.number(content["direction_sigma"]),
        checked.number(content["scale"]), checked.number(content["rms_mm"]), _coupling(content.get("coupling"), 6, camera),
    )  # fmt: skip
