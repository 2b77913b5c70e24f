"""The axis of a turntable, or the direction of a linear stage, from markers on it that a scan's own frames show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calibration.camera import Camera
from calibration.errors import CalibrationError, FileError, ScopeError
from calibration.geometry import Array, Pose
from calibration.rays import PlaneMarks, centre_covariance, locate_target
from calibration.rig import Rig
from calibration.stages import Stage, fit_linear, fit_turntable
from calibration.targets import find_markers, spread_of, upright
from ranging.motion import Linear, Motion, Turntable
from scope.session import Capture, StageUse, gray, read_image

_FRAMES = 24  # looked at, spread over the scan
_LEAST = 3  # frames with two markers or more
_FAR = 5.0  # times the median residual beyond which a frame is left out
_CLOSE = 0.03  # share by which sides and places may disagree, as they were measured
_STRAY = 0.02  # of the markers' extent: rms beyond which they do not move as stated


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """What the markers say."""

    motion: Motion
    stage: Stage
    frames: tuple[int, ...]  # that count
    looked: int
    warning: str = ""  # that their places contradict their sides


def table_motion(capture: Capture, rig: Rig, use: StageUse) -> Table:
    """Motion of a capture by the markers of its table.

    Parameters
    ----------
    capture : Capture
        With images: 24 of them, spread over the scan, are looked at.
    rig : Rig
        Whose camera places the markers.
    use : StageUse
        Kind, positions and markers.

    Returns
    -------
    Table
        The object's apparent motion, whether it or the sensor moves. Frames whose markers lie five times as far off as the
        median's are left out.

    Raises
    ------
    FileError
        Fewer than three frames with two markers, or markers that do not move as the positions say.
    """
    shown = capture.images[::2] if capture.background_mode == "alternate" else capture.images
    chosen = np.unique(np.linspace(0, len(shown) - 1, min(len(shown), _FRAMES)).round().astype(int)).tolist()
    seen, frames, why = [], [], ""
    images = [gray(read_image(shown[k])) for k in chosen]
    use, warning = _with_sides(use, images)
    for k, image in zip(chosen, images, strict=True):
        try:
            seen.append(_placed(rig.camera, use, shown[k].name, image))
            frames.append(k if capture.numbers is None else capture.numbers[k])
        except FileError:
            raise
        except ScopeError as error:
            why = f"; {shown[k].name}: {error}"
    if len(seen) < _LEAST:
        raise FileError(
            f"{capture.path}: two markers of the table are seen in {len(seen)} of {len(chosen)} frames that were looked at, {_LEAST} are "
            f"needed: light them, or calibrate the stage{why}"[:300]
        )
    positions = np.array([use.positions.at(f) for f in frames])
    try:
        stage, keep = _fitted(rig.camera, use, seen, positions)
    except CalibrationError as error:
        raise FileError(f"{capture.path}: markers of the table: {error}") from error
    extent = float(np.ptp(np.concatenate([view.points for view in seen]), axis=0).max())
    if stage.rms_mm > max(_STRAY * extent, 0.2) or (stage.kind == "linear" and abs(stage.scale - 1.0) > _STRAY):
        raise FileError(f"{capture.path}: {_contradiction(use, stage, seen, positions)}")
    motion: Motion
    if stage.kind == "linear":
        motion = Linear(stage.direction, positions=use.positions, sign=1.0)
    else:
        motion = Turntable(stage.point, stage.direction, positions=use.positions, sign=1.0)
    return Table(
        motion, stage, tuple(f for f, use_it in zip(frames, keep, strict=True) if use_it), len(chosen), warning
    )


def _with_sides(use: StageUse, images: list[np.typing.NDArray[np.generic]]) -> tuple[StageUse, str]:
    """The markers as far apart as their sides say, where `places` says otherwise, and a warning then."""
    if use.markers is None:
        return use, ""
    factors = np.array([spread_of(image, use.markers) for image in images])
    factors = factors[np.isfinite(factors)]
    middle = float(np.median(factors)) if len(factors) else 1.0
    if abs(middle - 1.0) < _CLOSE or float(np.median(np.abs(factors - middle))) > 0.3 * abs(middle - 1.0):
        return use, ""
    told = f"the table's markers stand {middle:.3f} times as far apart as `places` says, if their side is {use.markers.side:g} mm: measure both; the side was believed"
    return replace(use, markers=replace(use.markers, spread=middle)), told


def _placed(camera: Camera, use: StageUse, name: str, image: np.typing.NDArray[np.generic]) -> PlaneMarks:
    markers = use.markers
    if markers is None:
        raise ValueError("no markers")
    corners = find_markers(image, markers)
    if image.shape[::-1] != camera.size:
        raise FileError(
            f"{name}: {image.shape[1]} x {image.shape[0]} px; the rig was calibrated at {camera.size[0]} x {camera.size[1]} px"
        )
    own = upright(markers, corners).marks
    unknown = np.full((len(corners.pixels), 2, 2), np.nan)
    marks = PlaneMarks(name, corners.pixels, own[corners.mark, :2], Pose.identity(), corners.mark, unknown)
    known = np.asarray(np.isfinite(camera.rays(marks.pixels).direction).all(axis=1))
    return locate_target(camera, marks.select(known) if not known.all() else marks)


def _fitted(camera: Camera, use: StageUse, seen: list[PlaneMarks], positions: Array) -> tuple[Stage, list[bool]]:
    """Stage from the frames that agree, and which these are."""
    if use.markers is None:
        raise ValueError("no markers")
    tracks = np.stack([view.c_from_plane.apply(use.markers.marks) for view in seen])
    spread = np.stack([centre_covariance(camera, view) for view in seen])
    keep = np.ones(len(seen), dtype=np.bool_)
    stage = None
    for _ in range(3):
        if use.kind == "linear":
            stage = fit_linear(tracks[keep], positions[keep], covariance=spread[keep])
            back = tracks - (positions * stage.scale)[:, None, None] * stage.direction
        else:
            stage = fit_turntable(tracks[keep], positions[keep])
            turns = [Pose.from_rotation_vector(-p * stage.direction, np.zeros(3)).rotation for p in positions]
            back = np.stack([(t - stage.point) @ turn.T for t, turn in zip(tracks, turns, strict=True)])
        off = np.sqrt(((back - np.median(back[keep], axis=0)) ** 2).sum(axis=2).mean(axis=1))
        sound = off <= _FAR * max(float(np.median(off[keep])), 0.1)  # mm: what is nearer is no stranger
        if sound.sum() < _LEAST or np.array_equal(sound, keep):
            break
        keep = sound
    if stage is None:
        raise ValueError("no frames")
    return stage, keep.tolist()


def _contradiction(use: StageUse, stage: Stage, seen: list[PlaneMarks], positions: Array) -> str:
    """How the markers move, against what was stated."""
    if use.kind == "linear":
        return (
            f"the markers of the table move by {stage.scale:.4f} mm a stated mm (rms {stage.rms_mm:.3f} mm about a line): correct step or "
            "positions, or the side of the markers"
        )
    steps = np.diff(positions)
    pairs = [(b.c_from_plane @ a.c_from_plane.inverse).rotation for a, b in pairwise(seen)]
    turned = [np.arccos(np.clip((np.trace(r) - 1.0) / 2.0, -1.0, 1.0)) for r in pairs]
    ratio = float(np.median(np.array(turned) / np.maximum(np.abs(steps), 1e-9)))
    return (
        f"the markers of the table turn by {ratio:.3f} degrees a stated degree (rms {stage.rms_mm:.2f} mm about the axis): correct step or "
        "positions, or their places"
    )
