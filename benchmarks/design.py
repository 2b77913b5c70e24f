"""Predicted rigs against rendered ones: ``python -m benchmarks.design run FIRST LAST FILE``, ``tell FILE...``, ``time``, ``briefs``.

Random designs (with and without window, with lens, defocus and tilted sensor or without) are predicted by `scope.design` and, as
the other witness, rendered, calibrated and ranged. ``run`` does designs FIRST to LAST (each has its own seed, so that slices may
run anywhere and in any order), adds a line of JSON for each to FILE, and passes over those that stand there. ``tell`` prints
predicted over found: the noise along the ray at twenty places (scatter of repeated exposures), and the rms of the calibration's
error over the sheet (several calibrations of each design, against the exact rays and sheet). ``time``: a prediction over one
simulated session. ``briefs``: what ``--want`` proposes, rendered, calibrated and ranged.

To be run with OMP_NUM_THREADS=1, as the command `scope` does: BLAS is several times slower with more.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.shared import head, row
from calibration.geometry import Array, Pose
from calibration.targets import SpotGrid
from ranging.stripe import StripeOptions, extract
from ranging.triangulation import triangulate
from scope.calibrating import calibrate
from scope.design import DesignResult, Wanted, design_rig, propose
from scope.scanning import Scanner, scan
from scope.session import CalibrationSession, PlaneView
from scope.simulation import RigDesign, VirtualRig, read_design, simulate
from scope.simulation.hardware_design import CameraDesign, JigDesign, LaserDesign, WindowDesign
from scope.simulation.solids import Part, Scene, Sheet

EXPOSURES, LINES = 24, 13  # of each place: repeats, and neighbouring lines that are taken together
CALIBRATIONS = 8  # of each design
SEED = 14


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Predicted over found."""

    noise: Array  # (places,)
    calibration: tuple[float, float]  # rms over the sheet, mm: predicted, found


def random_design(rng: np.random.Generator, *, window: bool, lens: bool = False) -> RigDesign:
    """A rig of the kind people build, of moderate size so that it renders in seconds."""
    focal = float(rng.uniform(700.0, 1100.0))
    near = float(rng.uniform(280.0, 380.0))
    depth = float(rng.uniform(60.0, 120.0))
    middle = near + depth / 2
    baseline = middle * float(np.tan(np.radians(rng.uniform(18.0, 35.0))))
    origin = (
        (float(rng.uniform(-8, 8)), -baseline, 6.0)
        if rng.random() < 0.5
        else (-baseline, float(rng.uniform(-8, 8)), 6.0)
    )
    pitch = 0.9 * 640.0 / focal * near / 17.0
    camera = CameraDesign(
        (640, 480), focal, (float(rng.uniform(310, 330)), float(rng.uniform(230, 250))),
        distortion=(float(rng.uniform(-0.2, 0.05)), 0.04, 3e-4, -3e-4, 0.0), gain_e=float(rng.uniform(10, 60)),
        read_noise=float(rng.uniform(0.6, 2.0)), blur_px=float(rng.uniform(0.5, 1.3)),
    )  # fmt: skip
    laser = LaserDesign(
        origin, (0.0, 0.0, middle), roll=float(rng.uniform(-3, 3)), width=float(rng.uniform(0.25, 0.5)),
        peak=float(rng.uniform(110.0, 200.0)),
    )  # fmt: skip
    if lens:  # large pixels: blurs of some px at the ends of the volume
        away = focal * 0.012
        tilt = (float(rng.uniform(-5, 5)), 0.0) if rng.random() < 0.5 else (0.0, 0.0)
        camera = replace(
            camera, blur_px=0.5, pixel_um=12.0, focal_mm=1.0 / (1.0 / away + 1.0 / middle), focus=middle, tilt=tilt,
            f_number=float(rng.uniform(1.4, 4.0)),
        )  # fmt: skip
        reach = float(np.linalg.norm([*origin[:2], middle]))
        laser = replace(laser, waist=0.2, waist_at=reach, divergence=float(rng.uniform(1.0, 5.0)))
    return RigDesign(
        camera=camera, laser=laser,
        jig=JigDesign(
            tuple(float(z) for z in np.round(np.linspace(near, near + depth, int(rng.integers(4, 6))), 1)), 13, 17, pitch, 0.42 * pitch,
            fiducials=((6, 8), (6, 10), (3, 8)), fiducial_diameter=0.63 * pitch,
        ),
        window=WindowDesign(10.0, 1.52, (float(rng.uniform(-15, 15)), float(rng.uniform(-15, 15))), 100.0) if window else None,
    )  # fmt: skip


def judge(design: RigDesign, rng: np.random.Generator) -> Found:
    """Predict a design, and render, calibrate and range it."""
    predicted = design_rig(design)
    rig = predicted.rig
    rigs = [calibrate(session).rig for session in sessions(rig, rng)]
    area = predicted.area.prediction
    points = area.points[area.inside]
    errors = np.array([_errors(each, rig, points) for each in rigs])
    known = np.isfinite(errors).all(axis=0)
    both = (
        float(np.sqrt(np.mean(area.sigma_cal[area.inside][known] ** 2))),
        float(np.sqrt(np.mean(errors[:, known] ** 2))),
    )
    noise = np.concatenate([_noise(rigs[0], predicted, float(z), rng) for z in np.linspace(*_depths(design), 4)])
    return Found(noise, both)


def _depths(design: RigDesign) -> tuple[float, float]:
    low, high = min(design.jig.stand_offs), max(design.jig.stand_offs)
    return low + 0.05 * (high - low), high - 0.05 * (high - low)


def sessions(rig: VirtualRig, rng: np.random.Generator, count: int = 0) -> list[CalibrationSession]:
    """Several sessions of one rig: the same light, other noise."""
    jig, count = rig.design.jig, count or CALIBRATIONS
    target = SpotGrid(jig.rows, jig.columns, jig.pitches, jig.diameter, "light", jig.fiducials, jig.fiducial_diameter)
    lit = [rig.target_images(k, count * jig.images, rng) for k in range(len(jig.names))]
    striped = [rig.stripe_images(rig.blank(k), count * jig.laser_images, rng) for k in range(len(jig.names))]
    return [
        CalibrationSession(target, [
            PlaneView(lit[k][n::count], pose.translation, jig.rotation, laser=striped[k][n::count])
            for k, pose in enumerate(rig.stated)
        ])
        for n in range(count)
    ]  # fmt: skip


def _errors(calibrated: object, rig: VirtualRig, points: Array) -> Array:
    """Errors (N,) mm along the ray of points of the exact sheet, ranged by a calibrated rig from their exact pixels."""
    from scope.simulation import exact_rays, project

    pixels = project(rig.camera, points)
    camera, lasers = calibrated.camera, list(calibrated.lasers.values())  # type: ignore[attr-defined]
    found = triangulate(
        camera, lasers[0], pixels, np.zeros(len(pixels)), 1 if rig.along == "rows" else 0, extrapolate=5.0
    )
    return np.asarray(np.einsum("ni,ni->n", found.points - points, exact_rays(rig.camera, pixels).direction))


def _noise(calibrated: object, predicted: DesignResult, depth: float, rng: np.random.Generator) -> Array:
    """Predicted over found noise (5,) at five places of a plate at one depth."""
    rig = predicted.rig
    scene = Scene((Part(Sheet(None), Pose(np.eye(3), np.array([0.0, 0.0, depth]))),))
    scanner = Scanner(calibrated)  # type: ignore[arg-type]
    profiles = [scanner.profile(image) for image in rig.stripe_images(scene, EXPOSURES, rng)]
    ranged = np.array([p.points for p in profiles])  # (exposures, lines, 3)
    truth = rig.truth_of(scene)
    lines = np.flatnonzero(np.isfinite(ranged).all(axis=(0, 2)) & np.isfinite(truth.position))
    if len(lines) < 5 * LINES:
        return np.zeros(0)
    view = truth.points / np.linalg.norm(truth.points, axis=1, keepdims=True)
    along = np.einsum("eni,ni->en", ranged - truth.points, view)
    from scope.design.prediction import predict

    ratios = []
    for start in np.linspace(LINES, len(lines) - 2 * LINES, 5).astype(int):
        use = lines[start : start + LINES]
        found = np.sqrt(np.mean(along[:, use].var(axis=0, ddof=1)))
        expected = predict(rig, predicted.planned, truth.points[use], predicted.surface).look.sigma
        ratios.append(float(np.sqrt(np.mean(expected**2)) / found))
    return np.array(ratios)


def times() -> tuple[float, float]:
    """CPU seconds of predicting the demo's rig, and of rendering, calibrating and scanning it; both once before, to compile."""
    design = Path(__file__).resolve().parents[1] / "scope" / "demo" / "rig-design.toml"
    design_rig(design)
    begin = time.process_time()
    design_rig(design)
    predicted = time.process_time() - begin
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "s"
        begin = time.process_time()
        simulate(design, out, 1)
        calibrate(out / "calibration.toml").rig.save(out / "rig.json")
        scan(out / "capture.toml", out / "rig.json")
    return predicted, time.process_time() - begin


def briefs() -> None:
    """Ten briefs proposed, and the noise of rendered stripes all over the volume of each: scatter over wanted."""
    base = read_design(Path(__file__).resolve().parents[1] / "examples" / "brief-design.toml")
    head(
        "wanted, mm",
        "over, mm",
        "lens, mm",
        "stand-off, mm",
        "angle",
        "predicted, mm",
        "rendered, mm",
        "rendered over wanted",
        "",
    )
    rng = np.random.default_rng(10)
    sides = [(60, 40, 40), (100, 80, 60), (150, 80, 60), (200, 100, 80), (240, 100, 100), (80, 50, 100), (120, 60, 40), (300, 100, 120),
             (50, 30, 20), (180, 90, 150)]  # fmt: skip
    for k, side in enumerate(sides):
        wanted = Wanted(float(np.round((0.006 + 0.004 * (k % 3)) * side[0] / 100, 4)), tuple(float(v) for v in side))
        proposal = propose(base, wanted)
        found = _rendered_noise(proposal.chosen.design, wanted.volume[0] / 2, rng)
        told = "met" if proposal.met and found <= 1.1 * wanted.sigma else "**missed**"
        if not proposal.met:
            told = "said to be impossible"
        c = proposal.chosen
        row(
            wanted.sigma,
            "x".join(map(str, side)),
            c.focal,
            round(c.stand_off),
            c.angle,
            c.sigma,
            found,
            found / wanted.sigma,
            told,
        )


def _rendered_noise(design: RigDesign, half: float, rng: np.random.Generator) -> float:
    """Largest noise along the ray, mm, of rendered stripes at both ends of the volume, in pieces of 39 lines."""
    rig = VirtualRig.of(design)
    worst = 0.0
    for depth in (min(design.jig.stand_offs), max(design.jig.stand_offs)):
        scene = Scene((Part(Sheet(None), Pose(np.eye(3), np.array([0.0, 0.0, depth]))),))
        truth = rig.truth_of(scene)
        images = rig.stripe_images(scene, EXPOSURES, rng)
        found = np.array([extract(image, along=rig.along, options=StripeOptions()).position for image in images])
        mm = truth.sigma_mm / truth.sigma_px  # along the ray, a pixel across
        lines = np.flatnonzero(np.isfinite(found).all(axis=0) & (np.abs(truth.points[:, 0]) <= half))
        scatter = found[:, lines].var(axis=0, ddof=1) * mm[lines] ** 2
        piece = 3 * LINES
        whole = len(lines) // piece * piece
        worst = max(worst, float(np.sqrt(scatter[:whole].reshape(-1, piece).mean(axis=1).max())))
    return worst


def run(first: int, last: int, file: Path) -> None:
    """Judge designs ``first`` to ``last`` - 1 that ``file`` does not have."""
    done = {each["design"] for each in _read([file])}
    for k in sorted(set(range(first, last)) - done):
        rng = np.random.default_rng([SEED, k])
        design = random_design(rng, window=k % 2 == 1, lens=k % 4 >= 2)
        found = judge(design, rng)
        kind = ", ".join(name for name, there in (
            ("air" if design.window is None else "window", True), ("lens", k % 4 >= 2), ("tilted sensor", design.camera.tilt != (0.0, 0.0)),
        ) if there)  # fmt: skip
        line = {"design": k, "kind": kind, "noise": found.noise.tolist(), "predicted_mm": found.calibration[0], "found_mm": found.calibration[1]}  # fmt: skip
        with file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(line) + "\n")


def _read(files: list[Path]) -> list[dict[str, object]]:
    lines = [line for file in files if file.exists() for line in file.read_text(encoding="utf-8").splitlines()]
    return sorted((json.loads(line) for line in lines), key=lambda each: each["design"])


def tell(files: list[Path]) -> None:
    """Print what the slices found."""
    everything = _read(files)
    head("design", "kind", "noise: least, median, largest ratio", "calibration, um: predicted / found", "ratio")
    for each in everything:
        low, middle, high = np.percentile(each["noise"], [0, 50, 100])
        told, found = 1e3 * each["predicted_mm"], 1e3 * each["found_mm"]
        row(
            each["design"],
            each["kind"],
            f"{low:.3f}, {middle:.3f}, {high:.3f}",
            f"{told:.2f} / {found:.2f}",
            told / found,
        )
    noise = np.concatenate([each["noise"] for each in everything])
    ratio = np.array([each["predicted_mm"] / each["found_mm"] for each in everything])
    print()
    head("figure", "reach", "found", "")
    share = float(np.mean((noise > 0.9) & (noise < 1.1)))
    row("predicted sigma over scatter: median; 2.5 and 97.5 %", "0.9 to 1.1 in 95 %",
        f"{np.median(noise):.3f}; {np.percentile(noise, 2.5):.3f}, {np.percentile(noise, 97.5):.3f}: {share:.1%} "
        f"of {len(noise)} places", "met" if share >= 0.95 else "**missed**")  # fmt: skip
    inside = float(np.mean((ratio > 0.8) & (ratio < 1.25)))
    pooled = float(np.exp(np.mean(np.log(ratio))))
    row("predicted sigma_cal over rms error: geometric mean; range", "0.8 to 1.25",
        f"{pooled:.2f}; {ratio.min():.2f} to {ratio.max():.2f}: {inside:.0%} of {len(ratio)} designs",
        "met" if inside == 1.0 else "**missed**")  # fmt: skip


def main() -> None:
    match sys.argv[1:]:
        case ["run", first, last, file]:
            run(int(first), int(last), Path(file))
        case ["tell", *files] if files:
            tell([Path(file) for file in files])
        case ["briefs"]:
            briefs()
        case ["time"]:
            predicted, session = times()
            head("figure", "reach", "found", "")
            share = predicted / session
            row(f"time of a prediction ({predicted:.2f} s CPU) over simulating, calibrating and scanning it ({session:.1f} s)", "<= 0.02",
                share, "met" if share <= 0.02 else "**missed**")  # fmt: skip
        case _:
            raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
