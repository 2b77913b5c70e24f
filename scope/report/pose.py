"""A pose on a page: the part as it lies in the scan, what each face leaves, and the runner-up where it differs most."""

from __future__ import annotations

import numpy as np

from calibration.geometry import Array, Pose
from scope.cloud import ScanCloud
from scope.model import Surface
from scope.pose import CONVENTION, Candidate, Placed, PoseResult, difference, notations_text, pose_text, viewpoints
from scope.report.page import Page
from scope.report.part import Look, colour_bar, deviation_colours, nice_limit, ringed, shaded, with_scan
from scope.viewer import Scalar, cloud_scene, mesh_layer

SHOWN = 20_000  # points that can be turned on the page
NEAR = 0.16  # diameters: half of what is shown about the place where two poses differ
FACES = 16  # rows of the table


def pose_html(cloud: ScanCloud, placed: Placed) -> str:
    """The page of --report.

    Parameters
    ----------
    cloud, placed : ScanCloud, Placed
        The scan and its answer, refused or not.
    """
    result = placed.result
    page = Page(f"Pose of {result.model.name}")
    told, *more = pose_text(placed).splitlines()
    page.verdict("good" if result.found else "bad", told)
    for line in more if result.cloud_from_model is None else _without_notations(more):
        page.text(line)
    if result.tell_apart:
        page.text(f"What would settle it: {result.tell_apart}.")
    if result.candidates:
        surface = Surface(result.model.vertices, result.model.faces)
        limit = nice_limit(result.deviation[np.abs(result.deviation) < 2.0])
        _add_pictures(page, cloud, result, surface, limit)
        _add_faces(page, result)
        _add_candidates(page, result.candidates)
        _add_turned(page, cloud, result, surface, limit)
    _add_numbers(page, placed)
    return page.html()


def _without_notations(lines: list[str]) -> list[str]:
    """Lines of the answer but those that tables of the page tell."""
    elsewhere = ("  ", "undecided here")
    return [line for line in lines if not line.startswith(elsewhere) and "notations of robots" not in line]


def _add_numbers(page: Page, placed: Placed) -> None:
    """The pose in each frame and in every notation, one line each."""
    result = placed.result
    named = [("cloud", result.cloud_from_model), (f"camera at frame {placed.at}", placed.camera_from_model)]
    rows = []
    for name, pose in [*named, ("robot", placed.robot_from_model)]:
        if pose is not None:
            told = [line.strip().split(": ", 1) for line in notations_text(pose)]
            rows += [[name if k == 0 else "", *line] for k, line in enumerate(told)]
    if rows:
        page.heading("In the notations of robots")
        page.table(["frame", "notation", "numbers"], rows)
    page.text(CONVENTION)


def _best(result: PoseResult) -> Pose:
    return result.cloud_from_model or result.candidates[0].cloud_from_model


def _off(surface: Surface, pose: Pose, points: Array) -> Array:
    return surface.signed_distance(pose.inverse.apply(points))


def _add_pictures(page: Page, cloud: ScanCloud, result: PoseResult, surface: Surface, limit: float) -> None:
    """Best pose and runner-up from where the camera was, one scale for both, and what tells them apart from near."""
    points = cloud.points[result.points]
    points = points[:: max(1, len(points) // 60_000)]
    best = _best(result)
    camera = viewpoints(cloud, result.points)[0]
    middle = best.apply(result.model.centre)
    into = np.array([0.0, 0.0, 1.0]) if camera is None else middle - camera.mean(axis=0)
    rival = result.candidates[1].cloud_from_model if len(result.candidates) > 1 else None
    poses = [best] if rival is None else [best, rival]
    corners = np.concatenate([pose.apply(result.model.vertices) for pose in poses])
    look = Look.along(into, corners)
    apart = None if rival is None else difference(result.model, best, rival)
    page.heading("The part in the scan")
    for k, pose in enumerate(poses):
        picture = with_scan(
            *shaded(surface, pose, look), look, points, deviation_colours(_off(surface, pose, points), limit)
        )
        name = "Best pose"
        if k == 1:
            name = f"Runner-up, {result.candidates[1].behind:.0f} nats behind"
        if apart is not None:
            picture = ringed(picture, look, best.apply(apart.at), NEAR * result.model.diameter)
        page.image(picture, f"{name}: the mesh in grey, the points of the scan by their distance from it", width=440)
    page.drawing(
        colour_bar(limit, result.part_tolerance),
        "Distance of the points from the mesh, one scale for all pictures here",
    )
    if apart is None or rival is None:
        return
    page.heading("Where the runner-up differs most")
    page.text(
        f"About ({', '.join(f'{x:.0f}' for x in apart.at)}) mm of the model the two poses lie {apart.size:.2g} mm apart: ringed above, "
        "below from near, seen from where it shows. Points stand where the scan has some: what lies on the mesh in one picture and "
        "off it in the other decides."
    )
    place, reach = best.apply(apart.at), NEAR * result.model.diameter
    near = Look.along(-(best.rotation @ apart.out), place + reach * np.vstack([np.eye(3), -np.eye(3)]))
    for name, pose in (("Best pose", best), ("Runner-up", rival)):
        picture = with_scan(
            *shaded(surface, pose, near), near, points, deviation_colours(_off(surface, pose, points), limit)
        )
        page.image(picture, f"{name}, {2 * reach:.0f} mm across", width=440)


def _add_faces(page: Page, result: PoseResult) -> None:
    """What each face leaves, and what the test for another part said."""
    faces = result.faces
    page.heading("Residuals by face")
    variant = result.variant
    if variant is not None:
        page.text(f"Not this part: {variant.text}.")
        if variant.alternatives:
            page.text(f"What explains the scan about as well: {'; '.join(variant.alternatives)}.")
    page.table(
        ["surface", "at, mm of the model", "normal or axis", "points", "mean, mm", "error of it, mm", "scatter, mm", "sigma stated, mm", ""],
        [
            [
                face.what,
                ", ".join(f"{x:.1f}" for x in face.at),
                ", ".join(f"{x:.2f}" for x in face.direction) if np.isfinite(face.direction).all() else "-",
                f"{face.points}",
                f"{face.mean:+.4f}",
                f"{face.error:.4f}",
                f"{face.scatter:.4f}",
                f"{face.stated:.4f}" if np.isfinite(face.stated) else "-",
                "off" if face.off else "within",
            ]
            for face in faces[:FACES]
        ],
    )  # fmt: skip
    rest = f" {len(faces) - FACES} faces with fewer points are left out." if len(faces) > FACES else ""
    page.text(
        f"Mean: median distance from the mesh, outside positive. Off: further than three errors of the mean and the part's tolerance of "
        f"{result.part_tolerance:g} mm explain. Sigma is that of one point along its sighting ray.{rest}"
    )
    if result.undecided:
        page.text("What this view cannot decide:")
        page.table(
            ["variant", "look from, direction of the cloud"],
            [
                [u.what, ", ".join(f"{x:.2f}" for x in u.look_from) if np.isfinite(u.look_from).all() else "-"]
                for u in result.undecided
            ],
        )


def _add_candidates(page: Page, candidates: tuple[Candidate, ...]) -> None:
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
                f"{100 * c.explained:.1f} %",
                f"{100 * c.blocked:.1f} %",
                "-" if not np.isfinite(c.covered) else f"{100 * c.covered:.1f} %",
                f"{c.behind:.0f}",
            ]
            for k, c in enumerate(candidates)
        ],
    )


def _add_turned(page: Page, cloud: ScanCloud, result: PoseResult, surface: Surface, limit: float) -> None:
    """The scan on the model, to be turned."""
    part = cloud.select(result.points[:: max(1, len(result.points) // SHOWN)])
    local = _best(result).inverse.apply(part.points)
    off = Scalar("deviation", surface.signed_distance(local), kind="diverging", limits=(-limit, limit))
    mesh = mesh_layer(result.model.vertices, result.model.faces, "model")
    scene = cloud_scene(part, first=[off], layers=[mesh] if mesh else [], at=local)
    page.cloud(
        scene,
        "Best pose, to be turned: the scan on the model (grey) by its distance, mm, outside positive",
        limit=2 * SHOWN,
    )
