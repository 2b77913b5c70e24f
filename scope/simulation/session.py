"""A rig, its targets and its scans, with known truth: an independent witness for the code that calibrates and ranges.

`read_design` reads a rig-design.toml, `simulate` renders it and writes a session: calibration.toml and capture.toml as
a user would write them, the images they name, and the truth. The optics are in `scope.simulation.optics`, the solids in
`scope.simulation.solids`, the images in `scope.simulation.rendering`; none of them shares code with what they judge.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.errors import FileError
from calibration.geometry import Array, fit_plane
from scope.simulation.object_design import MeshDesign, MotionDesign, ObjectDesign, RoughDesign
from scope.simulation.refusals import check_session
from scope.simulation.rendering import disk_centroids
from scope.simulation.rig_design import RigDesign, read_any_design, read_design
from scope.simulation.stripe_truth import TrueStripe
from scope.simulation.virtual_rig import VirtualRig, placed, rough_field
from scope.simulation.wild import WildScene, write_wild
from scope.simulation.wild_design import WildDesign
from scope.simulation.written import calibration_toml, listed_marks, toml

_MARK = "scope simulate"


@dataclass(frozen=True, slots=True, eq=False)
class Simulation:
    """What was written."""

    folder: Path
    planes: tuple[str, ...]
    frames: int
    images: int
    expected_sigma_mm: float | None  # median over the scan's (else the planes') stripe points, along the sighting ray

    @property
    def result(self) -> dict[str, Any]:
        """What --json gives."""
        return {
            "folder": str(self.folder),
            "planes": list(self.planes),
            "frames": self.frames,
            "images": self.images,
            "expected_sigma_mm": self.expected_sigma_mm,
        }


def simulate(
    design: RigDesign | WildDesign | str | Path,
    out: str | Path,
    seed: int | np.random.Generator = 0,
    *,
    on_image: Callable[[int, int], None] | None = None,
    threads: int | None = None,
) -> Simulation:
    """Render a whole session of a designed rig and write it to a folder, which appears whole or not at all.

    Parameters
    ----------
    design : RigDesign, WildDesign or path
        A rig-design.toml, or what `read_design` made of one, or built in Python.
    out : path
        A folder that does not exist, is empty, or holds a former simulation, which is replaced.
    seed : int or numpy.random.Generator
        Of noise, dirt and speckle; the same gives the same files, whatever the number of threads.
    on_image : callable, optional
        Called with (images written, images in all) after each.
    threads : int, optional
        Workers; one a processor, four at most, by default.

    Returns
    -------
    Simulation
        With ``expected_sigma_mm``: the median over all stripe points of the Cramer-Rao bound of the stripe's position
        in its own line, times the geometry of triangulation, along the sighting ray.

    Raises
    ------
    FileError
        A folder that holds something else, cannot be written, or a rig that cannot stand as designed.
    """
    out = Path(out)
    _refuse(out)
    rng = np.random.default_rng(seed)
    designed = read_any_design(design) if isinstance(design, str | Path) else design
    if isinstance(designed, WildDesign):
        scene = designed.scene(rng)

        def write(folder: Path) -> Simulation:
            return _write_wild(scene, folder, out, rng, on_image)

    else:
        rig = VirtualRig.of(designed)
        check_session(rig)

        def write(folder: Path) -> Simulation:
            return _write(rig, folder, out, rng, on_image, threads)

    try:
        part = Path(tempfile.mkdtemp(prefix=f".{out.name}.", suffix=".part", dir=out.parent))
        try:
            result = write(part)
            part.chmod(0o755)
            _replace(part, out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
    except OSError as error:
        raise FileError(
            f"{out}: could not be written ({error.strerror}); free space or choose another folder"
        ) from error
    return result


def planned_session(design: str | Path) -> tuple[str, dict[str, Any]]:
    """calibration.toml of a designed rig, and the table [motion] of its scan, with no image rendered."""
    rig = VirtualRig.of(read_design(Path(design)))
    motion = rig.design.motion
    if motion is None or motion.kind == "fixed":
        return calibration_toml(rig, rig.design.camera.ambient > 0), {"kind": "fixed"}
    told: dict[str, Any] = {"kind": motion.kind, "moves": motion.moves, "step": motion.step, "start": motion.start}
    for key in ("direction", "axis_point", "axis_direction"):
        if getattr(motion, key) is not None:
            told[key] = list(getattr(motion, key))
    return calibration_toml(rig, rig.design.camera.ambient > 0), told


def _refuse(out: Path) -> None:
    if not out.parent.is_dir():
        raise FileError(f"{out}: its folder {out.parent} does not exist; create it or choose another place")
    if out.exists() and not out.is_dir():
        raise FileError(f"{out}: is a file; name a folder for the simulation")
    if out.is_dir() and any(out.iterdir()):
        try:
            former = json.loads((out / "truth" / "truth.json").read_text(encoding="utf-8"))["made_by"] == _MARK
        except (OSError, ValueError, KeyError, TypeError):
            former = False
        if not former:
            raise FileError(f"{out}: holds files that are no former simulation; name an empty or a new folder")


def _replace(part: Path, out: Path) -> None:
    """Put a finished folder in another's place."""
    if not out.exists():
        part.rename(out)
        return
    former = out.with_name(f"{part.name}.old")
    out.rename(former)
    part.rename(out)
    shutil.rmtree(former, ignore_errors=True)


def _write(
    rig: VirtualRig,
    folder: Path,
    final: Path,
    rng: np.random.Generator,
    on_image: Callable[[int, int], None] | None,
    threads: int | None,
) -> Simulation:
    """Images, TOML and truth into an empty folder."""
    jig, motion = rig.design.jig, rig.design.motion
    frames = motion.frames if motion is not None else 0
    off = motion.off_images if motion is not None else 0
    planes = range(len(jig.names))
    dark = jig.laser_images if rig.design.camera.ambient else 0
    total = len(jig.names) * (jig.images + jig.laser_images + dark) + frames + off
    sources = rng.spawn(3 * len(jig.names) + frames + 1)
    digits = len(str(max(frames - 1, 1)))

    def plane(k: int) -> tuple[int, TrueStripe | None]:
        name = jig.names[k]
        _save(folder / name, rig.target_images(k, jig.images, sources[3 * k]))
        blank = rig.blank(k)
        _save(folder / f"{name}-laser", rig.stripe_images(blank, jig.laser_images, sources[3 * k + 1]))
        _save(folder / f"{name}-dark", rig.dark_images(dark, sources[3 * k + 2]))
        return jig.images + jig.laser_images + dark, rig.truth_of(blank)

    def frame(i: int) -> tuple[int, TrueStripe | None]:
        scene = rig.scene.moved(rig.object_pose(i))
        image = rig.stripe_images(scene, 1, sources[3 * len(jig.names) + i])
        _save(folder / "frames", image, first=i, digits=digits)
        return 1, rig.truth_of(scene)

    def background(_: int) -> tuple[int, TrueStripe | None]:
        _save(folder / "off", rig.dark_images(off, sources[-1]))
        return off, None

    jobs = [(plane, k) for k in planes] + [(frame, i) for i in range(frames)] + [(background, 0)] * (off > 0)
    stripes: list[TrueStripe] = []
    done = 0
    with ThreadPoolExecutor(threads or min(4, os.cpu_count() or 1)) as pool:
        waiting = [pool.submit(job, k) for job, k in jobs]
        try:
            for future in waiting:
                count, stripe = future.result()
                done += count
                if stripe is not None:
                    stripes.append(stripe)
                if on_image is not None:
                    on_image(done, total)
        finally:
            pool.shutdown(cancel_futures=True)
    on_planes, on_object = stripes[: len(jig.names)], stripes[len(jig.names) :]
    expected = _median([s.sigma_mm for s in (on_object or on_planes)])
    (folder / "calibration.toml").write_text(calibration_toml(rig, dark > 0), encoding="utf-8")
    for name, text in listed_marks(rig).items():
        (folder / name).write_text(text, encoding="utf-8")
    if motion is not None:
        (folder / "capture.toml").write_text(_capture_toml(motion), encoding="utf-8")
    _write_truth(rig, folder / "truth", on_planes, on_object, expected)
    return Simulation(final, jig.names, frames, total, expected)


def _write_wild(
    scene: WildScene, folder: Path, final: Path, rng: np.random.Generator, on_image: Callable[[int, int], None] | None
) -> Simulation:
    """Pictures, TOML and truth of a session that nobody prepared."""
    truth = write_wild(scene, folder, rng, on_image=on_image)
    (folder / "truth").mkdir()
    told = {"format": 1, "made_by": _MARK, **truth}
    (folder / "truth" / "truth.json").write_text(json.dumps(told, indent=1), encoding="utf-8")
    return Simulation(final, (), scene.frames, scene.images, None)


def _save(folder: Path, images: Iterable[NDArray[Any]], *, first: int = 0, digits: int = 1) -> None:
    for i, image in enumerate(images, first):
        folder.mkdir(exist_ok=True)
        (folder / f"{i:0{digits}d}.png").write_bytes(
            cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        )


def _capture_toml(motion: MotionDesign) -> str:
    lines = ["# A simulated scan.", "format = 1", 'units = "mm"', 'images = "frames/*.png"']
    lines += ['background = "off/*.png"'] * (motion.off_images > 0)
    lines += ["", "[motion]", f"kind = {toml(motion.kind)}", f"moves = {toml(motion.moves)}"]
    for key in ("direction", "axis_point", "axis_direction"):
        value = getattr(motion, key)
        lines += [f"{key} = {toml(list(value))}"] if value is not None else []
    if motion.kind != "fixed":
        lines += [f"step = {toml(motion.step)}", f"start = {toml(motion.start)}"]
    return "\n".join(lines) + "\n"


def _write_truth(
    rig: VirtualRig, folder: Path, on_planes: list[TrueStripe], on_object: list[TrueStripe], expected: float | None
) -> None:
    """truth.json and, point by point, arrays; see docs/formats.md for their names and shapes."""
    folder.mkdir()
    still = np.random.default_rng(0)  # dirt is not part of these
    looks = [rig.look(k, still) for k in range(len(rig.actual))]
    np.save(folder / "spots.npy", np.stack([_spots(rig, k, look.marks, look.radii) for k, look in enumerate(looks)]))
    np.save(folder / "plane_stripe_position.npy", np.stack([s.position for s in on_planes]))
    np.save(folder / "plane_stripe_points.npy", np.stack([s.points for s in on_planes]))
    if on_object:
        np.save(folder / "stripe_position.npy", np.stack([s.position for s in on_object]))
        points = [rig.object_pose(i).inverse.apply(s.points) for i, s in enumerate(on_object)]
        np.save(folder / "stripe_points.npy", np.stack(points))
        np.save(folder / "stripe_sigma_px.npy", np.stack([s.sigma_px for s in on_object]))
        np.save(folder / "stripe_sigma_mm.npy", np.stack([s.sigma_mm for s in on_object]))
        np.save(folder / "stripe_crossings.npy", np.stack([s.crossings for s in on_object]))
    design, camera, laser = rig.design, rig.camera, rig.laser
    window = None
    if design.window is not None and camera.window is not None:
        window = {
            "thickness": design.window.thickness,
            "index": design.window.index,
            "tilt_deg": list(design.window.tilt),
            "distance": design.window.distance,
            "normal": camera.window.normal.tolist(),
        }
    truth: dict[str, Any] = {
        "format": 1,
        "made_by": _MARK,
        "size": list(camera.size),
        "K": camera.matrix.tolist(),
        "dist": list(camera.distortion),
        "blur_px": rig.sensor.blur_px,
        "gain_e": rig.sensor.gain_e,
        "read_noise": rig.sensor.read_noise,
        "black": rig.sensor.black,
        "window": window,
        "laser": {
            "origin": laser.origin.tolist(),
            "axis": laser.axis.tolist(),
            "normal": laser.normal.tolist(),
            "offset": float(laser.normal @ laser.origin),
            "width_mm": laser.width,
            "peak": rig.level,
            "along": rig.along,
            "sheet": _sheet(rig),
        },
        "planes": [
            {"name": name, "stated": stated.matrix.tolist(), "actual": actual.matrix.tolist()}
            for name, stated, actual in zip(design.jig.names, rig.stated, rig.actual, strict=True)
        ],
        "object": [_object_truth(item, k, folder) for k, item in enumerate(design.objects)],
        "frames": [rig.object_pose(i).matrix.tolist() for i in range(len(on_object))],
        "expected_sigma_mm": expected,
        "expected_sigma_px": _median([s.sigma_px for s in (on_object or on_planes)]),
    }
    (folder / "truth.json").write_text(json.dumps(truth, indent=1), encoding="utf-8")


def _spots(rig: VirtualRig, plane: int, marks: Array, radii: Array) -> Array:
    """Centroids (marks, 2) px of a plane's spots; NaN for those missing or not wholly in view."""
    found = np.full((len(marks), 2), np.nan)
    present = radii > 0.0
    found[present] = disk_centroids(rig.camera, rig.actual[plane], marks[present], radii[present])
    columns, rows = rig.camera.size
    inside = np.all((found > -0.5) & (found < [columns - 0.5, rows - 0.5]), axis=1)
    return np.where(inside[:, None], found, np.nan)


def _median(values: list[Array]) -> float | None:
    known = np.concatenate(values)
    known = known[np.isfinite(known)]
    return float(np.median(known)) if len(known) else None


def _sheet(rig: VirtualRig) -> dict[str, object]:
    """The best plane of the sheet of light within the jig's depths, beyond the window, and how far it leaves it."""
    angle = np.linspace(-0.9, 0.9, 31) * min(rig.laser.half_fan, np.pi / 12)
    depths = np.linspace(min(rig.design.jig.stand_offs), max(rig.design.jig.stand_offs), 9)
    points = np.concatenate([rig.laser.rays(angle).at_depth(z) for z in depths])
    points = (
        points
        if len(depths) and np.ptp(depths)
        else np.concatenate([points, rig.laser.rays(angle).at_depth(0.9 * depths[0])])
    )
    plane = fit_plane(points)
    return {
        "normal": plane.normal.tolist(),
        "offset": plane.offset,
        "flatness_mm": float(np.abs(plane.distance(points)).max()),
    }


def _object_truth(item: ObjectDesign, index: int, folder: Path) -> dict[str, object]:
    """What one object is and where; heights and meshes as files beside truth.json."""
    skip = ("pose", "origin", "rotation")
    truth: dict[str, object] = {f.name: getattr(item, f.name) for f in fields(item) if f.name not in skip}
    truth["cloud_from_model"] = placed(item).matrix.tolist()
    if isinstance(item, RoughDesign):
        surface = rough_field(item)
        name = f"heights-{index}.npy"
        np.save(folder / name, surface.heights)
        truth |= {"heights": name, "spacing": surface.spacing, "Sa": float(np.abs(surface.heights).mean())}
    if isinstance(item, MeshDesign):
        name = f"mesh-{index}{Path(item.mesh).suffix}"
        shutil.copyfile(item.mesh, folder / name)
        truth["mesh"] = name
    return truth
