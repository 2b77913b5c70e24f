"""The pieces of pose estimation against independent truth: closed forms, brute force, Monte Carlo."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import parts
from benchmarks.pose import about
from calibration.errors import FileError
from calibration.geometry import Pose
from scope.cloud import ScanCloud
from scope.errors import MeasurementError, MissingLibraryError
from scope.model import (
    Model,
    Scanned,
    Surface,
    align,
    angle_between,
    hidden,
    load_model,
    rotations,
)
from scope.model.files import read_mesh
from scope.model.model import prepare_model, principal_axes
from scope.pose import estimate_pose, largest_plane, normals_of, place, read_transform, thin
from scope.pose.decision import Likelihood, lines_blocked, margin, same_answer
from scope.pose.estimate import PoseOptions
from scope.pose.placed import frame_of, write_deviation
from scope.pose.search import View
from scope.pose.segmentation import clusters, extent
from scope.pose.uncertainty import Shared, Uncertainty, uncertainty
from scope.pose.visibility import visibility_of
from scope.pose.wording import pose_result, roll_pitch_yaw
from scope.refinement import Frame, Held, Seen, refined


@cache
def ball() -> Model:
    made = trimesh.creation.icosphere(subdivisions=4, radius=30.0)
    return prepare_model(np.asarray(made.vertices), np.asarray(made.faces))


@cache
def casting() -> Model:
    made = parts.casting()
    return prepare_model(made.vertices, made.faces)


class TestGrid:
    def test_distance_and_gradient_are_those_of_a_sphere(self) -> None:
        rng = np.random.default_rng(0)
        points = rng.normal(size=(500, 3))
        points *= (rng.uniform(28.2, 31.8, 500) / np.linalg.norm(points, axis=1))[:, None]
        distance, gradient = ball().fine.look_up(points)
        radius = np.linalg.norm(points, axis=1)
        assert np.abs(distance - (radius - 30)).max() < 0.08  # facets of the mesh: 0.05 mm, trilinear: the rest
        assert ((gradient * points).sum(axis=1) / radius).min() > 0.98

    def test_outside_the_grid_distance_goes_on(self) -> None:
        far = np.array([[100.0, 0, 0], [0, -80, 60]])
        distance, _ = ball().fine.look_up(far)
        assert distance == pytest.approx([70.0, 70.0], rel=0.1)

    def test_alignment_undoes_a_motion(self) -> None:
        known = casting()
        moved = Pose.from_rotation_vector([0.1, -0.15, 0.12], [3.0, -2.0, 2.5])
        at, out = moved.apply(known.samples[::60]), known.normals[::60] @ moved.rotation.T
        reach = known.diameter * np.array([0.1] * 6 + [0.03] * 6)
        found = align(known.fine, at, out, np.eye(3)[None].copy(), np.zeros((1, 3)), reach)
        pose = Pose(found.rotation[0], found.translation[0]) @ moved
        assert np.degrees(angle_between(pose.rotation, np.eye(3))) < 0.1
        assert np.linalg.norm(pose.translation) < 0.1
        assert found.cost[0] < 0.01

    def test_hidden_is_what_brute_force_says(self) -> None:
        rng = np.random.default_rng(3)
        full = rng.random((12, 12, 12)) < 0.02
        start, end = rng.uniform(-6, 18, (2, 300, 3))
        found = hidden(full, np.zeros(3), 1.0, start, end)
        s = np.linspace(0, 1, 4000)[:, None]
        for k in range(300):
            way = start[k] + s * (end[k] - start[k])
            way = way[np.linalg.norm(way - start[k], axis=1) > 3.0]
            cell = np.floor(way).astype(int)
            cell = cell[((cell >= 0) & (cell < 12)).all(axis=1)]
            through = full[tuple(cell.T)]
            if through.sum() > 300:  # a long way through a voxel must be seen, none must stay unseen by chance
                assert found[k]
            if not through.any():
                assert not found[k]


class TestModel:
    def test_rotations_cover_so3(self) -> None:
        """No rotation is further from the nearest of 800 than 30 degrees; their mean is that of even cover."""
        set_ = rotations(800)
        assert np.abs(np.einsum("nij,nkj->nik", set_, set_) - np.eye(3)).max() < 1e-12
        rng = np.random.default_rng(0)
        worst = max(float(angle_between(set_, parts.random_rotation(rng)).min()) for _ in range(300))
        assert np.degrees(worst) < 30

    def test_block_has_the_three_half_turns(self) -> None:
        block = parts.box_part(np.array([0.0, 0, 0]), np.array([50.0, 40, 22]))
        known = prepare_model(block.vertices, block.faces)
        assert len(known.symmetries) == 3
        for motion in known.symmetries:
            assert np.degrees(angle_between(motion.rotation, np.eye(3))) == pytest.approx(180, abs=0.1)
            assert motion.apply(known.centre) == pytest.approx(known.centre, abs=0.05)

    def test_thin_sheet_has_its_flips(self) -> None:
        """Thinner than the grid can tell its faces apart."""
        sheet = parts.box_part(np.array([0.0, 0, 0]), np.array([60.0, 36, 0.6]))
        assert len(prepare_model(sheet.vertices, sheet.faces).symmetries) == 3

    def test_axis_of_revolution_is_that_of_the_mesh(self) -> None:
        made = trimesh.creation.cylinder(radius=12, height=50, sections=96)
        turn = Pose.from_rotation_vector([0.4, -0.7, 0.2], [3.0, 4.0, 5.0])
        middle, axes = principal_axes(turn.apply(np.asarray(made.vertices)), np.asarray(made.faces))
        assert middle == pytest.approx(turn.translation, abs=1e-9)
        assert np.abs(axes @ turn.rotation[:, 2]).max() == pytest.approx(1.0, abs=1e-12)

    def test_plate_is_like_itself_eight_ways_but_symmetric_in_none(self) -> None:
        made = parts.plate()
        known = prepare_model(made.vertices, made.faces)
        assert known.symmetries == ()
        axes = [np.eye(3), *(Pose.from_rotation_vector(v, np.zeros(3)).rotation for v in np.pi * np.eye(3))]
        for truth in axes[1:]:
            assert min(float(angle_between(m.rotation, truth)) for m in known.likenesses) < 0.02

    def test_nearest_point_matches_trimesh(self) -> None:
        made = parts.bracket()
        points = np.random.default_rng(1).uniform(-10, 110, (300, 3))
        closest, normal = Surface(made.vertices, made.faces).nearest(points)
        expected, distance, _ = trimesh.proximity.closest_point(made.mesh(), points)
        assert np.linalg.norm(points - closest, axis=1) == pytest.approx(distance, abs=1e-3)
        assert np.abs(np.linalg.norm(normal, axis=1) - 1).max() < 1e-12
        assert len(expected) == 300


class TestSharpEdges:
    def test_distance_to_the_edges_of_a_block_is_the_analytic_one(self) -> None:
        block = parts.box_part(np.array([0.0, 0, 0]), np.array([50.0, 40, 22]))
        points = np.random.default_rng(0).uniform(-5, 55, (400, 3))
        sides = np.array([50.0, 40.0, 22.0])
        away = np.minimum(np.abs(points), np.abs(points - sides))  # from the two planes across each axis
        over = np.maximum(np.maximum(-points, points - sides), 0.0)
        along = [
            np.sqrt(over[:, a] ** 2 + away[:, b] ** 2 + away[:, c] ** 2)
            for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        ]
        found = Surface(block.vertices, block.faces).crease_distance(points, 100.0)
        assert found == pytest.approx(np.min(along, axis=0), abs=0.01)

    def test_facets_of_a_round_part_are_no_edges(self) -> None:
        assert np.isinf(Surface(ball().vertices, ball().faces).crease_distance(ball().samples[::50], 10.0)).all()
        tube = trimesh.creation.cylinder(radius=15, height=60, sections=48)
        surface = Surface(np.asarray(tube.vertices), np.asarray(tube.faces))
        assert surface.crease_distance(np.array([[15.0, 0, 0], [15, 0, 20]]), 100.0) == pytest.approx(
            [30, 10], abs=0.05
        )

    def test_two_grazing_points_hold_nothing(self) -> None:
        """A face seen square on with two points of a wall beside it: the face still slides."""
        block = parts.box_part(np.array([0.0, 0, 0]), np.array([50.0, 40, 22]))
        surface = Surface(block.vertices, block.faces)
        rng = np.random.default_rng(0)
        top = np.column_stack(
            [rng.uniform(2, 48, 3000), rng.uniform(2, 38, 3000), 22 + rng.normal(scale=0.02, size=3000)]
        )
        points = np.concatenate([top, [[50.0, 20, 10], [25, 40, 9.0]]])
        scan = Scanned(points, np.full(len(points), 0.02), None)
        seen, frame = Seen(scan, None, None, stated=True, line=None), Frame(np.array([25.0, 20, 11]), 33.0)
        alone = Shared(None, np.zeros(len(points)), None)

        def known(held: Held | None = None) -> Uncertainty:
            found = refined(surface, Pose.identity(), seen, frame, cut=0.5, form=0.01, held=held)
            return uncertainty(found, seen, alone, centre=frame.middle, radius=frame.radius)

        free = known()
        assert len(free.loose) == 3
        settled = known(Held(Pose.identity(), free.loose_motions, np.full(3, 0.03)))
        assert settled.loose == ()  # what its rim holds is held, grazing points or not


class TestFiles:
    @pytest.fixture
    def bracket(self) -> trimesh.Trimesh:
        return parts.bracket().mesh()

    @pytest.mark.parametrize("ending", ["stl", "obj", "ply"])
    def test_formats(self, bracket: trimesh.Trimesh, tmp_path: Path, ending: str) -> None:
        bracket.export(tmp_path / f"b.{ending}")
        vertices, faces = read_mesh(tmp_path / f"b.{ending}")
        assert trimesh.Trimesh(vertices, faces).volume == pytest.approx(bracket.volume, rel=1e-5)

    def test_inverted_mesh_is_turned(self, bracket: trimesh.Trimesh, tmp_path: Path) -> None:
        bracket.invert()
        bracket.export(tmp_path / "b.stl")
        vertices, faces = read_mesh(tmp_path / "b.stl")
        assert trimesh.Trimesh(vertices, faces).volume > 0

    def test_small_hole_is_filled_and_large_one_refused(self, tmp_path: Path) -> None:
        made = parts.casting().mesh()
        made.update_faces(np.arange(len(made.faces)) != 7)
        made.export(tmp_path / "hole.stl")
        vertices, faces = read_mesh(tmp_path / "hole.stl")
        assert trimesh.Trimesh(vertices, faces).is_watertight
        open_ = parts.bracket().mesh()
        open_.update_faces(open_.triangles_center[:, 2] > 1.0)
        open_.export(tmp_path / "open.stl")
        with pytest.raises(FileError, match="open"):
            read_mesh(tmp_path / "open.stl")

    def test_overlapping_bodies_are_refused(self) -> None:
        a, b = trimesh.creation.box((40, 40, 40)), trimesh.creation.box((40, 40, 40))
        b.apply_translation([20, 13, 9])
        both = trimesh.util.concatenate([a, b])
        with pytest.raises(MeasurementError, match="overlap"):
            prepare_model(np.asarray(both.vertices), np.asarray(both.faces))

    def test_five_million_faces_are_refused_from_the_header(self, tmp_path: Path) -> None:
        path = tmp_path / "huge.stl"
        with path.open("wb") as stream:
            stream.write(b" " * 80 + (5_000_000).to_bytes(4, "little"))
            stream.truncate(84 + 50 * 5_000_000)
        with pytest.raises(FileError, match="5000000 faces"):
            load_model(path, use_cache=False)

    def test_no_mesh_at_all(self, tmp_path: Path) -> None:
        (tmp_path / "b.stl").write_bytes(b"solid nothing\nendsolid\n")
        with pytest.raises(FileError):
            read_mesh(tmp_path / "b.stl")
        with pytest.raises(FileError, match="STL, OBJ, PLY, GLB, 3MF or STEP"):
            read_mesh(tmp_path / "b.step")

    def test_cache_gives_the_same_model_and_a_damaged_one_is_made_anew(self, tmp_path: Path) -> None:
        block = parts.box_part(np.array([0.0, 0, 0]), np.array([50.0, 40, 22])).mesh()
        block.export(tmp_path / "b.stl")
        first = load_model(tmp_path / "b.stl", cache=tmp_path / "kept")
        again = load_model(tmp_path / "b.stl", cache=tmp_path / "kept")
        for name in ("vertices", "faces", "samples", "normals", "view_centroid"):
            assert np.array_equal(getattr(first, name), getattr(again, name))
        assert np.array_equal(first.fine.values, again.fine.values)
        assert [m.matrix.tolist() for m in again.symmetries] == [m.matrix.tolist() for m in first.symmetries]
        (stored,) = (tmp_path / "kept").glob("*.npz")
        stored.write_bytes(stored.read_bytes()[:1000])
        assert load_model(tmp_path / "b.stl", cache=tmp_path / "kept").diameter == first.diameter

    def test_missing_library_is_named_with_the_command(self, monkeypatch: pytest.MonkeyPatch) -> None:
        import builtins

        from scope import optional

        genuine = builtins.__import__

        def without(name: str, *rest: object) -> object:
            if name == "open3d":
                raise OSError("libusb-1.0.so.0: cannot open shared object file")
            return genuine(name, *rest)  # type: ignore[arg-type]

        monkeypatch.setattr(builtins, "__import__", without)
        with pytest.raises(MissingLibraryError, match=r"libusb-1\.0\.so\.0.*install"):
            optional.import_open3d()


class TestSegmentation:
    def test_rod_is_no_table(self) -> None:
        """All that is seen of a thin rod lies within a hundredth of its length of a plane."""
        rng = np.random.default_rng(0)
        angle, along = rng.uniform(0.3, np.pi - 0.3, 6000), rng.uniform(-100, 100, 6000)
        rod = np.column_stack([along, 2.5 * np.cos(angle), 400 - 2.5 * np.sin(angle)])
        (found,) = clusters(ScanCloud.from_points(rod), 200.1, 1000.0, width=5.0)
        assert len(found) > 5900

    def test_table_goes_and_parts_stay(self) -> None:
        rng = np.random.default_rng(0)
        table = np.column_stack([rng.uniform(-150, 150, (20_000, 2)), np.full(20_000, 430.0)])
        table[:, 2] += rng.normal(scale=0.05, size=len(table))
        lump = rng.normal(size=(4000, 3))
        lump = 20 * lump / np.linalg.norm(lump, axis=1, keepdims=True) + [0, 0, 400.0]
        other = lump + np.array([100.0, 0, 0])
        found = clusters(ScanCloud.from_points(np.concatenate([table, lump, other])), 70.0, 1600.0)
        assert len(found) == 2
        for rows in found:
            assert len(rows) == pytest.approx(4000, rel=0.01)

    def test_widest_extent_is_that_of_a_rod(self) -> None:
        along = np.linspace(0, 100, 5000)[:, None] * np.array([0.6, 0.0, 0.8])
        assert extent(along) == pytest.approx(99, rel=0.03)

    def test_plane_is_found_among_outliers(self) -> None:
        rng = np.random.default_rng(0)
        flat = rng.uniform(-50, 50, (3000, 3)) * [1, 1, 0] + [0, 0, 7]
        plane = largest_plane(np.concatenate([flat, rng.uniform(-50, 50, (2000, 3))]), 0.2, rng)
        assert plane is not None
        assert abs(plane.normal[2]) == pytest.approx(1, abs=1e-4)

    def test_thinning_keeps_one_point_a_cube(self) -> None:
        points = np.random.default_rng(0).uniform(0, 10, (5000, 3))
        kept = thin(points, 2.0)
        cells = np.unique(np.floor((points[kept] - points.min(axis=0)) / 2.0), axis=0)
        assert len(cells) == len(kept) == 125

    def test_normals_of_a_sphere_face_the_camera(self) -> None:
        rng = np.random.default_rng(0)
        points = rng.normal(size=(8000, 3))
        points = 20 * points / np.linalg.norm(points, axis=1, keepdims=True)
        points = points[points[:, 2] < -4]
        camera = np.tile([0.0, 0, -400], (len(points), 1))
        normals = normals_of(points, points, camera, radius=2.0)
        known = normals.any(axis=1)
        assert known.mean() > 0.9
        assert ((normals * points)[known].sum(axis=1) / 20).min() > 0.95


def test_expected_surface_is_what_the_simulator_sees() -> None:
    """Samples said to be visible have simulated points nearby, and those well within shadow are not expected."""
    made = parts.bracket()
    known = prepare_model(made.vertices, made.faces)
    pose = parts.random_pose(made, np.random.default_rng(4))
    cloud = parts.scan(made, pose, np.random.default_rng(4), scanner=parts.Scanner(points=20_000))
    visibility = visibility_of(cloud, np.zeros((0, 3)), voxel=2.0)
    assert visibility is not None
    assert visibility.sheet is not None
    surface = Surface(made.vertices, made.faces)
    wanted = visibility.expected(surface, pose, known.samples, known.normals, np.zeros((0, 3)))
    near = visibility.covered(pose.apply(known.samples))
    assert wanted.sum() > 1000
    assert near[wanted].mean() > 0.995
    out = known.normals @ pose.rotation.T
    facing = (out @ [0.0, 0, -1] > 0.45) & (out @ [0.0, -0.39, -0.92] > 0.45)
    assert (facing & near).sum() > 500
    assert wanted[facing & near].mean() > 0.8


def test_sight_that_grazes_an_edge_blocks_nothing() -> None:
    """Lines of sight along a wall, 0.05 mm inside it, are a matter of the pose; 1 mm inside it the part stands before them."""
    block = parts.box_part(np.array([0.0, 0, 0]), np.array([50.0, 40, 22]))
    points = np.array([[49.95, 20, 8], [49.0, 20, 8], [25, 20, 0], [25, 20, 22], [0.02, 39.98, 8]])
    camera = points + np.array([0.0, 0, 300])
    view = View(points, np.zeros((5, 3)), camera, None)
    blocked = lines_blocked(Surface(block.vertices, block.faces), Pose.identity(), view, 0.7)
    assert blocked.tolist() == [False, True, True, False, False]


def evidence(points: np.ndarray, samples: np.ndarray) -> Likelihood:
    return Likelihood(Pose.identity(), points, samples, 1.0, 0.0, 1.0, 10)


class TestDecision:
    def test_unanimous_points_decide_and_a_tie_does_not(self) -> None:
        good, none = np.zeros(1000), np.zeros(10)
        bad = good.copy()
        bad[:6] = 8.0
        assert margin(evidence(good, none), evidence(bad, none)) == (48.0, True)
        bad[3:] = 0.0
        assert not margin(evidence(good, none), evidence(bad, none))[1]

    def test_gain_with_much_against_it_does_not_decide(self) -> None:
        a, b = np.zeros(1000), np.zeros(1000)
        b[:100], a[100:170] = 8.0, 8.0
        gain, sure = margin(evidence(a, np.zeros(1)), evidence(b, np.zeros(1)))
        assert gain == 240.0
        assert not sure

    def test_turn_about_an_axis_of_revolution_is_the_same_answer(self) -> None:
        made = trimesh.creation.cylinder(radius=15, height=60, sections=128)
        known = prepare_model(np.asarray(made.vertices), np.asarray(made.faces))
        assert known.axis is not None
        turned = Pose.from_rotation_vector(1.234 * known.axis.direction, np.zeros(3))
        assert same_answer(known, Pose.identity(), turned, turn=0.02, shift=0.2)
        assert not same_answer(known, Pose.identity(), Pose(np.eye(3), np.array([0, 0, 2.0])), turn=0.02, shift=0.2)


@pytest.mark.long
def test_covariance_is_that_of_repeats() -> None:
    """Noise and calibration redrawn 24 times: the scatter lies within what 24 repeats allow of the claim, each way."""
    made = parts.casting()
    scanner = parts.Scanner(points=3000, calibration=np.diag([0.02, 2e-4, 2e-4]) ** 2)
    pose = parts.random_pose(made, np.random.default_rng(8))
    middle, radius = pose.apply(casting().centre), casting().diameter / 2
    scale = np.array([1, 1, 1, radius, radius, radius])
    moves, claims = [], []
    for k in range(24):
        found = estimate_pose(
            parts.scan(made, pose, np.random.default_rng(900 + k), scanner=scanner),
            casting(),
            initial=pose,
            options=PoseOptions(starts=64, candidates=2),
        )
        assert found.cloud_from_model is not None
        assert found.covariance is not None
        step = found.cloud_from_model @ pose.inverse
        turn = 0.5 * np.array([step.rotation[2, 1] - step.rotation[1, 2], step.rotation[0, 2] - step.rotation[2, 0], step.rotation[1, 0] - step.rotation[0, 1]])  # fmt: skip
        moves.append(np.concatenate([step.apply(middle) - middle, turn]) * scale)
        at = about(middle - found.cloud_from_model.translation)
        claims.append(at @ found.covariance @ at.T * np.outer(scale, scale))
    value, vector = np.linalg.eigh(np.mean(claims, axis=0))
    ratio = np.sqrt(np.mean((np.array(moves) @ vector) ** 2, axis=0) / value)
    assert ratio.min() > 0.55  # +-3 standard errors of 24 repeats about 1
    assert ratio.max() < 1.45


class TestFrames:
    @given(st.tuples(*[st.floats(-3.1, 3.1)] * 3))
    def test_angles_give_the_rotation_back(self, vector: tuple[float, float, float]) -> None:
        rotation = Pose.from_rotation_vector(vector, np.zeros(3)).rotation
        roll, pitch, yaw = roll_pitch_yaw(rotation)
        about_x, about_y, about_z = (
            Pose.from_rotation_vector(angle * axis, np.zeros(3)).rotation
            for angle, axis in zip((roll, pitch, yaw), np.eye(3), strict=True)
        )
        assert np.abs(about_z @ about_y @ about_x - rotation).max() < 1e-9

    def test_camera_and_robot_see_the_object_where_it_is_at_that_frame(self, tmp_path: Path) -> None:
        made = parts.casting()
        truth = parts.random_pose(made, np.random.default_rng(1))
        cloud = parts.scan(made, truth, np.random.default_rng(1), scanner=parts.Scanner(points=4000))
        found = estimate_pose(cloud, casting(), initial=truth)
        assert cloud.sensors is not None
        robot = Pose.from_rotation_vector([0.3, 0, 0], [100.0, 0, 50])
        placed = place(cloud, found, "last", robot)
        assert placed.camera_from_model is not None
        assert placed.robot_from_model is not None
        moved = -cloud.sensors.centre[-1]  # the camera moved by this, so the object moved against it
        assert placed.camera_from_model.translation == pytest.approx(truth.translation + moved, abs=0.05)
        assert np.abs((robot @ placed.camera_from_model).matrix - placed.robot_from_model.matrix).max() < 1e-9
        told = pose_result(placed)
        assert told["at"] == cloud.sensors.frame[-1]
        assert np.array(told["covariance"]).shape == (6, 6)
        write_deviation(tmp_path / "d.ply", cloud, found)
        assert len(ScanCloud.load(tmp_path / "d.ply")) == len(found.points)
        with pytest.raises(MeasurementError, match="frame 99999"):
            frame_of(cloud, "99999")

    @pytest.mark.parametrize(
        "text", ["[[1,0,0,0],[0,2,0,0],[0,0,1,0],[0,0,0,1]]", "[1, 2]", "{}", "no json", '[["a",0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]']
    )  # fmt: skip
    def test_transform_that_is_not_rigid_is_refused(self, tmp_path: Path, text: str) -> None:
        (tmp_path / "t.json").write_text(text)
        with pytest.raises(FileError, match=r"t\.json"):
            read_transform(tmp_path / "t.json")

    def test_transform_with_and_without_its_key(self, tmp_path: Path) -> None:
        pose = Pose.from_rotation_vector([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
        for content in (pose.matrix.tolist(), {"matrix": pose.matrix.tolist()}):
            (tmp_path / "t.json").write_text(json.dumps(content))
            assert np.abs(read_transform(tmp_path / "t.json").matrix - pose.matrix).max() < 1e-12
