"""A calibrated rig, and the one versioned JSON file that holds it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from calibration.atomic import write_text
from calibration.errors import FileError
from calibration.geometry import Array, Plane, Pose
from calibration.rays import Domain, PinholeCamera, PlaneMap, RayField, TwoPlaneCamera, exponents
from calibration.sheet import CurvedSheet, Laser, PlaneOfLight, Sheet, SheetFrame, order_of
from calibration.stages import Stage
from calibration.volume import Volume

FORMAT = 1
_LARGEST = 64 << 20  # bytes
_HIGHEST = 20  # order of a polynomial that a rig may ask for
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


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
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
    inputs: Mapping[str, str] = field(default_factory=dict)  # file name: SHA-256
    sha256: str = ""  # of the file it was read from

    @classmethod
    def load(cls, path: str | Path) -> Rig:
        """Read a rig; ``FileError`` where it is missing, damaged, of a newer format or no rig at all."""
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
        try:
            return _rig(content, hashlib.sha256(data).hexdigest())
        except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
            text = f"{type(error).__name__}: {error}"[:100]
            raise FileError(f"{path}: damaged or edited ({text}); calibrate again") from error

    def save(self, path: str | Path) -> None:
        """Write the rig whole, or not at all."""
        write_text(Path(path), json.dumps(_content(self), indent=1, allow_nan=False) + "\n")


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


T = TypeVar("T")


def _array(content: Any, *shape: int, known: bool = True) -> Array:
    """Array of a shape (-1: any length), finite where it must be ``known``; null becomes NaN."""
    values = np.array(content, dtype=np.float64)
    if values.size == 0:
        values = values.reshape([max(n, 0) for n in shape])
    if values.ndim != len(shape) or any(n not in {-1, m} for n, m in zip(shape, values.shape, strict=True)):
        raise ValueError(f"an array of shape {shape} was expected, found {values.shape}")
    if known and not np.isfinite(values).all():
        raise ValueError("a number that must be known is null or infinite")
    return values


def _unit(content: Any) -> Array:
    """Unit vector (3,)."""
    vector = _array(content, 3)
    if abs(float(np.linalg.norm(vector)) - 1.0) > 1e-6:
        raise ValueError(f"a unit vector was expected, found length {np.linalg.norm(vector):g}")
    return vector


def _rotation(content: Any) -> Array:
    rotation = _array(content, 3, 3)
    Pose.from_matrix(Pose(rotation, np.zeros(3)).matrix, tolerance=1e-6)  # its ValueError is this rig's
    return rotation


def _positive(content: Any) -> float:
    value = float(content)
    if not 0 < value < np.inf:
        raise ValueError(f"a positive number was expected, found {value}")
    return value


def _order(content: Any) -> int:
    order = int(content)
    if not 0 <= order <= _HIGHEST:
        raise ValueError(f"an order from 0 to {_HIGHEST} was expected, found {order}")
    return order


def _one_of(content: Any, allowed: set[str]) -> str:
    if content not in allowed:
        raise ValueError(f"{content!r} is none of {', '.join(sorted(allowed))}")
    return str(content)


def _number(content: Any) -> float:
    return float("nan") if content is None else float(content)


def _blur(content: Any) -> float:
    value = _number(content)
    if value == value and not 0.1 < value < 50.0:
        raise ValueError(f"a blur of {value} px")
    return value


def _each(content: Any, read: Callable[[Any], T]) -> tuple[T, ...]:
    return tuple(read(item) for item in content)


def _rig(content: dict[str, Any], digest: str) -> Rig:
    verdict = content["verification"]
    return Rig(
        camera=_camera(content["camera"]),
        lasers={str(name): _laser(item) for name, item in content["lasers"].items()},
        stages=_each(content["stages"], _stage),
        verification=Verification(
            verdict["passed"] is True, str(verdict["why"]), _each(verdict["faults"], dict), _each(verdict["planes"], _told),
            _number(verdict["interplane_px"]),
        ),
        accept={str(key): float(value) for key, value in content["accept"].items()},
        camera_id=str(content["camera_id"]),
        blur_px=_blur(content.get("blur_px")),  # rigs of earlier versions have none
        written=str(content["written"]),
        software=str(content["software"]),
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
    volume = Volume(_array(content["volume"]["normals"], -1, 3), _array(content["volume"]["offsets"], -1))
    if content["model"] == "pinhole":
        return PinholeCamera(
            _array(content["matrix"], 3, 3), _array(content["distortion"], 5), _pose(content["c_from_camera"]), size, volume,
            _array(content["covariance"], 9, 9, known=False), _number(content["sigma"]),
        )  # fmt: skip
    if content["model"] not in {"two-plane", "joint"}:
        raise ValueError(f"camera model {content['model']!r}")
    maps, field = _each(content["maps"], _plane_map), _field(content["field"])
    if len(maps) < 2 or len(maps) != len(field.depths):
        raise ValueError(f"{len(maps)} plane maps and {len(field.depths)} depths; two or more, one a depth")
    return TwoPlaneCamera(maps, field, size, volume, content["model"])


def _pose(content: dict[str, Any]) -> Pose:
    return Pose(_rotation(content["rotation"]), _array(content["translation"], 3))


def _domain(content: dict[str, Any]) -> Domain:
    return Domain(_array(content["homography"], 3, 3), _array(content["centre"], 2), _array(content["half"], 2))


def _plane_map(content: dict[str, Any]) -> PlaneMap:
    terms = content["terms"] if content["terms"] in {"linear", "paper"} else _order(content["terms"])
    n = len(exponents(terms))
    return PlaneMap(
        str(content["name"]), terms, _domain(content["domain"]), _array(content["coefficients"], n, 2),
        _pose(content["c_from_plane"]), _array(content["inverse"], n, n, known=False), _number(content["sigma"]),
    )  # fmt: skip


def _field(content: dict[str, Any]) -> RayField:
    slope, origin = _order(content["slope_order"]), _order(content["origin_order"])
    n = len(exponents(slope)) + len(exponents(origin))
    return RayField(
        _rotation(content["c_from_d"]), _domain(content["domain"]), slope, origin, float(content["pivot"]),
        _positive(content["reach"]), _array(content["coefficients"], n, 2), _array(content["inverse"], n, n, known=False),
        _number(content["sigma"]), _array(content["depths"], -1), float(content["forward"]),
    )  # fmt: skip


def _frame(content: dict[str, Any]) -> SheetFrame:
    return SheetFrame(_array(content["centre"], 3), _array(content["axes"], 2, 3), _positive(content["reach"]))


def _laser(content: dict[str, Any]) -> Laser:
    terms = len(content["covariance"])
    order_of(terms)
    return Laser(
        str(content["name"]), _sheet(content["sheet"]), _frame(content["frame"]), _array(content["covariance"], terms, terms, known=False),
        _array(content["origin"], 3, known=False), _one_of(content["along"], {"rows", "columns"}),
        _one_of(content["channel"], _CHANNELS), _number(content["rms_mm"]),
        _number(content["loo_mm"]), _number(content["flatness_mm"]), _number(content["flatness_sigma"]), int(content["n"]),
        _each(
            content["planes"],
            lambda p: PlaneOfLight(str(p["plane"]), int(p["n"]), _number(p["rms_mm"]), _number(p["loo_mm"])),
        ),
    )  # fmt: skip


def _sheet(content: dict[str, Any]) -> Sheet:
    if content["kind"] == "curved":
        base = content["plane"]
        plane = Plane(_unit(base["normal"]), float(base["offset"]))
        order_of(3 + len(content["curvature"]))
        return CurvedSheet(plane, _frame(content["frame"]), _array(content["curvature"], -1))
    return Plane(_unit(content["normal"]), float(content["offset"]))


def _stage(content: dict[str, Any]) -> Stage:
    if content["kind"] not in {"linear", "turntable"}:
        raise ValueError(f"stage {content['kind']!r}")
    return Stage(
        content["kind"], _unit(content["direction"]), _array(content["point"], 3), _number(content["direction_sigma"]),
        _number(content["scale"]), _number(content["rms_mm"]),
    )  # fmt: skip
