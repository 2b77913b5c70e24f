"""The images that a calibration.toml asks for, taken by its camera: which there are, which are missing, and where they go."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from glob import glob
from pathlib import Path
from typing import Any, Protocol

from calibration.errors import FileError, ScopeError
from scope.cameras import Camera, Shot, SimulatedCamera, View, open_camera
from scope.errors import CameraError
from scope.session import PlannedPlane, planned_camera, planned_planes, planned_views, save_images

TARGET, LASER, DARK = "target", "laser", "dark"  # what is taken at a stand-off; "laser NAME" where there are several
REPEATS = 3  # images where the file names a pattern
_MOST_VIEWS = 200
_STALE = 2  # frames that a camera may have exposed before it was asked


class Ask(Protocol):
    """Tells what is to be put before the camera, and waits; False where the work is to end."""

    def __call__(self, what: str) -> bool:
        """Ask."""
        ...


def shots_of(plane: PlannedPlane) -> dict[str, tuple[str, ...]]:
    """What is taken at a stand-off: patterns of its images, relative to the file, by kind."""
    shots = {TARGET: plane.images}
    shots |= {f"{LASER} {name}".rstrip(): patterns for name, patterns in plane.laser.items()}
    return shots | {f"{DARK} {name}".rstrip(): patterns for name, patterns in plane.background.items()}


def images_there(root: Path, patterns: Sequence[str]) -> list[Path]:
    """Images of some patterns within the folder of the file; ``FileError`` for one that leads out of it."""
    for pattern in patterns:
        _require_within(root, pattern)
    return sorted({path for pattern in patterns for path in root.glob(pattern) if path.is_file()})


def image_places(root: Path, patterns: Sequence[str], repeats: int = REPEATS) -> list[Path]:
    """Where images go so that the patterns find them: ``repeats`` of them for a pattern, else one for each name."""
    for pattern in patterns:
        _require_within(root, pattern)
    if not any(sign in pattern for pattern in patterns for sign in "*?["):
        return [root / pattern for pattern in patterns]
    parent, name = Path(patterns[0]).parent, Path(patterns[0]).name
    if len(patterns) > 1 or name.count("*") != 1 or any(sign in name for sign in "?[") or "*" in str(parent):
        raise FileError(f"calibration.toml: {patterns[0][:80]}: no new image can be named by it; write folder/*.png")
    named = name if Path(name).suffix.lower() in {".png", ".tif", ".tiff", ".bmp"} else "*.png"
    return [root / parent / named.replace("*", str(k)) for k in range(repeats)]


def keep_shots(root: Path, patterns: Sequence[str], images: Sequence[Any], places: Sequence[Path]) -> None:
    """Put images in the place of those that were there, when all of them are on the disk."""
    old = set(images_there(root, patterns))
    save_images(list(zip(places, images, strict=True)))
    for path in old - set(places):
        path.unlink(missing_ok=True)


def show_stand_off(camera: Camera, plane: str, kind: str) -> None:
    """Put a simulated rig's target before it, or switch the laser of a camera that can."""
    lit = kind.startswith(LASER)
    if isinstance(camera, SimulatedCamera):
        camera.show(View("" if kind.startswith(DARK) else plane, laser=lit, moving=False))
    elif camera.switches_laser:
        camera.switch_laser(lit)


def take_missing(
    file: Path, ask: Ask, tell: Callable[[str], None], *, again: bool = False, repeats: int = REPEATS
) -> bool:
    """Take the images that the file asks for and that are not there yet, stand-off by stand-off, by the file's [camera].

    Parameters
    ----------
    file : path
        calibration.toml.
    ask : callable
        Called before each shot with what is to stand before the camera; not for a simulated one.
    tell : callable
        Told how each stand-off is judged, as `scope calibrate --check` does.
    again : bool
        Take all images anew.
    repeats : int
        Images where the file names a pattern.

    Returns
    -------
    bool
        False where ``ask`` ended it; what was taken is kept.

    Raises
    ------
    CameraError, FileError
        The camera does not answer, or images cannot be written.
    """
    settings = planned_camera(file)
    planes = planned_planes(file)
    root = file.parent.resolve()
    missing = [
        (plane.name, kind, patterns)
        for plane in planes
        for kind, patterns in shots_of(plane).items()
        if again or not _any(file, patterns)
    ]
    if settings is None:
        return True
    views = [patterns for patterns in planned_views(file) if again or not _any(file, patterns)]
    if not missing and not views:
        return True
    camera = open_camera(settings, again=True)
    try:
        for patterns in views:
            _take_views(camera, root, patterns, ask, settings.name)
        for k, (plane, kind, patterns) in enumerate(missing):
            places = image_places(root, patterns, repeats)
            waits = isinstance(camera, SimulatedCamera)
            switched = camera.switches_laser and k > 0 and missing[k - 1][0] == plane
            if not waits and not switched and not ask(_words(plane, kind, len(places), camera)):
                return False
            show_stand_off(camera, plane, kind)
            keep_shots(root, patterns, [shot.image for shot in _taken(camera, len(places), settings.name)], places)
            if k + 1 == len(missing) or missing[k + 1][0] != plane:
                tell(_judged(file, plane))
    finally:
        camera.close()
    return True


def _any(file: Path, patterns: Sequence[str]) -> bool:
    return any(glob(str(file.parent / pattern)) for pattern in patterns)  # noqa: PTH207  (patterns may be absolute)


def _take_views(camera: Camera, root: Path, patterns: Sequence[str], ask: Ask, name: str) -> None:
    """One image a pose, until nobody wants more."""
    if not any("*" in pattern for pattern in patterns):
        raise FileError(f"calibration.toml: views.images: {patterns[0][:80]}: name a pattern such as board/*.png")
    places = image_places(root, patterns, _MOST_VIEWS)
    for k, place in enumerate(places):
        if not ask(f"{patterns[0]}: hold the target in view {k + 1}, at many angles and places; q after ten or more"):
            return
        save_images([(place, _taken(camera, 1, name)[0].image)])


def _words(plane: str, kind: str, count: int, camera: Camera) -> str:
    where = {TARGET: "the target, laser off", DARK: "the same place, laser off"}.get(
        kind.split(maxsplit=1)[0], f"the target's place, {kind} on"
    )
    if camera.switches_laser:
        where = "the target; the camera switches the laser"
    return f"{plane}: {where}; {count} image{'s' if count > 1 else ''}"


def _taken(camera: Camera, count: int, name: str) -> list[Shot]:
    camera.start()
    for _ in range(0 if camera.waits else _STALE):
        camera.read()
    shots = [shot for _ in range(count) if (shot := camera.read()) is not None]
    if len(shots) < count:
        raise CameraError(f"{name}: gave {len(shots)} of {count} frames; check it and call the command again")
    return shots


def _judged(file: Path, plane: str) -> str:
    from scope.calibrating.verifying import check_plane

    try:
        found = check_plane(file, plane)
    except ScopeError as error:
        return f"{plane}: not good: {' '.join(str(error).split())}"[:300]
    if found["remedy"]:
        return f"{plane}: not good: {found['remedy']}"[:300]
    return f"{plane}: good, {found['used']} of {found['expected']} marks"


def _require_within(root: Path, pattern: str) -> None:
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise FileError(f"calibration.toml: {pattern[:80]}: leads out of the session folder; name images inside it")
    parent = root / Path(pattern).parent
    if not parent.resolve().is_relative_to(root):
        raise FileError(
            f"calibration.toml: {pattern[:80]}: leads out of the session folder by a link; use a folder inside it"
        )
