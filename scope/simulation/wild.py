"""Sessions that nobody prepared: a printed board in a lit room, a cheap colour camera, a laser that is on in every image.

A session is drawn from a seed (`draw_wild`) and written as people record it (`write_wild`). The pictures come from a
pinhole with radial distortion and a plane of light; nothing here is shared with the code that is judged by them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calibration.geometry import Array, Bools
from scope.simulation.wild_table import (
    DICTIONARY,
    MARKER,
    PLACES,
    look_at_table,
    place_table,
    positions,
    truth_of,
)

_ROWS, _COLUMNS, _PITCH = 6, 8, 20.0  # inner corners; mm
_WIDTH, _HEIGHT = 640, 480
_WALL = 900.0  # mm: what stands behind the board
_MARKED = 12  # positions at which the empty table is seen
_DIM = 0.15  # of the room's light, while the table turns
_CALIBRATION = """format = 1
units = "mm"

[target]
kind = "chessboard"
rows = {rows}
columns = {columns}
pitch = {pitch}

[[views]]
images = "board/*.jpg"

[[views]]
images = "laser/*.jpg"
laser = "same"
"""
_STAGE = """
[[stage]]
kind = "turntable"
images = "markers/*.jpg"
positions = [{positions}]

[stage.target]
kind = "markers"
dictionary = "{dictionary}"
marker = {marker}
places = [
{places}]
"""
_CAPTURE = """format = 1
units = "mm"
images = "turn/*.jpg"

[motion]
kind = "turntable"
moves = "object"
axis = "rig"
step = {step}
"""


@dataclass(frozen=True, slots=True, eq=False)
class WildScene:
    """What a wild session really is."""

    focal: float  # px
    centre: Array  # (2,) px
    radial: float  # k1
    normal: Array  # (3,) unit normal of the sheet of light, C
    offset: float  # mm: points of the sheet have normal @ x = offset
    colour: int  # of the laser: 0 blue, 1 green, 2 red
    width: float  # mm on the board, one sigma across the sheet
    power: float  # grey levels at the peak
    speckle: float  # relative, one sigma before the lens
    paper: float  # grey levels of white paper at the centre; above 255 it clips
    gradient: Array  # (2,) relative change of the room's light over the picture
    margin: float  # mm of plate beyond the outermost squares
    blur: float  # px, one sigma
    noise: float  # grey levels
    quality: int  # of the JPEG
    bayer: bool
    dust: int  # specks on a board
    hands: int  # skin-coloured blobs beside it
    boards: int  # views without laser
    lasers: int  # views with it
    blurred: int  # of the lasers' views: shaken
    missing: int  # of the lasers' views: without a board
    frames: int = 0  # of a full turn of a turntable with markers, that a block and a ball stand on; 0: no turntable

    @property
    def images(self) -> int:
        """Pictures in all."""
        return self.boards + self.lasers + (_MARKED + self.frames if self.frames else 0)


def draw_wild(rng: np.random.Generator) -> WildScene:
    """Draw a session: each nuisance over the range that cheap hardware and untrained hands give."""
    angle = np.radians(rng.uniform(20.0, 40.0)) * rng.choice([-1.0, 1.0])
    normal = np.array([np.cos(angle), rng.normal(0.0, 0.03), np.sin(angle)])
    normal /= np.linalg.norm(normal)
    return WildScene(
        focal=rng.uniform(600.0, 850.0),
        centre=np.array([319.5, 239.5]) + rng.normal(0.0, 6.0, 2),
        radial=rng.uniform(-0.2, 0.1),
        normal=normal,
        offset=float(normal[2] * rng.uniform(420.0, 500.0)),
        colour=int(rng.choice([1, 2])),
        width=float(np.exp(rng.uniform(np.log(0.4), np.log(2.5)))),
        power=rng.uniform(80.0, 300.0),
        speckle=rng.uniform(0.0, 0.4),
        paper=rng.uniform(90.0, 270.0),
        gradient=rng.uniform(-0.4, 0.4, 2),
        margin=rng.uniform(0.0, 25.0),
        blur=rng.uniform(0.6, 1.2),
        noise=rng.uniform(1.0, 3.0),
        quality=int(rng.integers(70, 97)),
        bayer=bool(rng.random() < 0.7),
        dust=int(rng.integers(0, 8)),
        hands=int(rng.integers(0, 3)),
        boards=10,
        lasers=14,
        blurred=int(rng.integers(0, 3)),
        missing=int(rng.integers(0, 3)),
    )


def write_wild(
    scene: WildScene,
    folder: str | Path,
    rng: np.random.Generator,
    *,
    on_image: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Write calibration.toml, board/*.jpg and laser/*.jpg of a session into a folder; returns the truth.

    With ``frames`` also markers/*.jpg, turn/*.jpg and capture.toml. Lengths of the truth in mm, in C. ``on_image`` is called
    with (pictures written, pictures in all) after each.
    """
    folder = Path(folder)
    rays = _sight(scene)
    done = 0

    def save(kind: str, k: int, image: Array) -> None:
        nonlocal done
        (folder / kind).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / kind / f"im{k:02d}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, scene.quality])
        done += 1
        if on_image is not None:
            on_image(done, scene.images)

    for kind, count in (("board", scene.boards), ("laser", scene.lasers)):
        for k in range(count):
            lit = kind == "laser"
            pose = None if lit and k < scene.missing else _pose(scene, rng, lit)
            shaken = lit and scene.missing <= k < scene.missing + scene.blurred
            save(kind, k, _picture(scene, rays, pose, lit, 4.0 if shaken else 0.0, rng))
    truth: dict[str, Any] = {
        "K": [[scene.focal, 0.0, float(scene.centre[0])], [0.0, scene.focal, float(scene.centre[1])], [0.0, 0.0, 1.0]],
        "dist": [scene.radial, 0.0, 0.0, 0.0, 0.0],
        "laser": {"normal": scene.normal.tolist(), "offset": scene.offset},
    }
    text = _CALIBRATION.format(rows=_ROWS, columns=_COLUMNS, pitch=_PITCH)
    if scene.frames:
        table = place_table(scene.normal, scene.offset, rng)
        wall = cv2.resize(rng.uniform(0.2, 0.45, (4, 5, 1)), (_WIDTH, _HEIGHT), interpolation=cv2.INTER_CUBIC)
        wall = wall[..., None] * [0.75, 0.9, 1.0]
        source = scene.normal * scene.offset - 40.0 * np.cross(scene.normal, [0.0, 1.0, 0.0])
        for k, degrees in positions(_MARKED):
            seen = look_at_table(table, degrees, rays, source, things=False)
            save("markers", k, _exposed(scene, rays, _before(wall, seen), 1.0, 0.0, rng))
        for k, degrees in positions(scene.frames):
            seen = look_at_table(table, degrees, rays, source, things=True)
            save("turn", k, _exposed(scene, rays, _before(wall, seen), _DIM, 0.0, rng))
        places = "".join(f"  {{ id = {number}, x = {x}, y = {y} }},\n" for number, x, y in PLACES)
        text += _STAGE.format(
            positions=", ".join(f"{a:g}" for _, a in positions(_MARKED)),
            dictionary=DICTIONARY,
            marker=MARKER,
            places=places,
        )
        capture = _CAPTURE.format(step=f"{360.0 / scene.frames:.10g}")
        (folder / "capture.toml").write_text(capture, encoding="utf-8")
        truth["turntable"] = truth_of(table)
    (folder / "calibration.toml").write_text(text, encoding="utf-8")
    return truth


def _sight(scene: WildScene) -> Array:
    """Directions (H, W, 3) of all pixels, z = 1: the distortion undone by fixed-point steps."""
    v, u = np.mgrid[0:_HEIGHT, 0:_WIDTH].astype(np.float64)
    x_d, y_d = (u - scene.centre[0]) / scene.focal, (v - scene.centre[1]) / scene.focal
    x, y = x_d, y_d
    for _ in range(12):
        stretch = 1.0 + scene.radial * (x * x + y * y)
        x, y = x_d / stretch, y_d / stretch
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def _pose(scene: WildScene, rng: np.random.Generator, lit: bool) -> tuple[Array, Array]:
    """Rotation and place of a board that is whole in view; a lit one has the sheet across its middle."""
    half = 0.5 * np.array([(_COLUMNS + 1) * _PITCH, (_ROWS + 1) * _PITCH])
    corners = np.array([[sx * half[0], sy * half[1], 0.0] for sx in (-1, 1) for sy in (-1, 1)])
    while True:
        turn = cv2.Rodrigues(np.radians(rng.normal(0.0, [18.0, 18.0, 8.0])))[0]
        middle = np.array([rng.uniform(-110, 110), rng.uniform(-80, 80), rng.uniform(380, 560)])
        if lit:
            middle[0] = (scene.offset - middle[1:] @ scene.normal[1:]) / scene.normal[0] + rng.uniform(-40, 40)
        place = corners @ turn.T + middle
        flat = place[:, :2] / place[:, 2:]
        flat *= 1.0 + scene.radial * (flat**2).sum(axis=1, keepdims=True)
        pixels = scene.focal * flat + scene.centre
        if (pixels > 12).all() and (pixels < [_WIDTH - 13, _HEIGHT - 13]).all():
            return turn, middle


def _picture(
    scene: WildScene, rays: Array, pose: tuple[Array, Array] | None, lit: bool, shake: float, rng: np.random.Generator
) -> Array:
    """One picture (H, W, 3), blue green red, uint8."""
    colour = cv2.resize(rng.uniform(0.15, 0.6, (6, 8, 3)), (_WIDTH, _HEIGHT), interpolation=cv2.INTER_CUBIC)
    colour *= [0.6, 0.8, 1.0]  # wood
    for _ in range(scene.hands):
        at = (int(rng.choice([rng.integers(0, 90), rng.integers(550, 640)])), int(rng.integers(0, 480)))
        cv2.ellipse(colour, at, (60, 35), float(rng.uniform(0, 180)), 0, 360, (0.35, 0.45, 0.8), -1)
    depth = np.full(rays.shape[:2], _WALL)
    if pose is not None:
        turn, middle = pose
        reach = (turn[:, 2] @ middle) / (rays @ turn[:, 2])
        flat = (rays * reach[..., None] - middle) @ turn[:, :2]
        board, on = _board(flat, scene, float(middle[2] / scene.focal), rng)
        colour = np.where(on[..., None], board[..., None], colour)
        depth = np.where(on, reach, depth)
    facing = np.full(depth.shape, 1.0 if lit else 0.0)
    return _exposed(scene, rays, (depth, colour, facing), 1.0, shake, rng)


def _before(wall: Array, seen: tuple[Array, Array, Array, Bools]) -> tuple[Array, Array, Array]:
    """Depth, colour and cosine to the laser of a table before the wall."""
    reach, colour, facing, on = seen
    return np.where(on, reach, _WALL), np.where(on[..., None], colour, wall), np.where(on, facing, 0.5)


def _exposed(
    scene: WildScene,
    rays: Array,
    surface: tuple[Array, Array, Array],
    room: float,
    shake: float,
    rng: np.random.Generator,
) -> Array:
    """The picture (H, W, 3), uint8, of depths (H, W) mm, colours (H, W, 3) and cosines to the laser (H, W).

    ``room`` is the part of the room's light that is on, ``shake`` its blur in px.
    """
    depth, colour, facing = surface
    v, u = np.mgrid[-0.5 : 0.5 : _HEIGHT * 1j, -0.5 : 0.5 : _WIDTH * 1j]
    light = colour * (room * scene.paper * (1.0 + scene.gradient[0] * u + scene.gradient[1] * v))[..., None]
    if facing.any():
        off = (rays @ scene.normal) * depth - scene.offset
        grain = rng.gamma(1 / max(scene.speckle, 0.02) ** 2, max(scene.speckle, 0.02) ** 2, off.shape)
        stripe = scene.power * np.exp(-0.5 * (off / scene.width) ** 2) * grain * facing
        tint = np.full(3, 0.08)
        tint[scene.colour] = 1.0
        light += (stripe[..., None] * tint) * (0.25 + 0.75 * colour)
    light = cv2.GaussianBlur(light, (0, 0), float(np.hypot(scene.blur, shake)))
    light += rng.normal(0.0, 1.0, light.shape) * np.sqrt(scene.noise**2 + 0.03 * np.maximum(light, 0.0))
    image = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    if scene.bayer:
        raw = image[:, :, 1].copy()
        raw[0::2, 0::2], raw[1::2, 1::2] = image[0::2, 0::2, 2], image[1::2, 1::2, 0]
        image = np.asarray(cv2.cvtColor(raw, cv2.COLOR_BayerRGGB2BGR))
    return np.asarray(image)


def _board(flat: Array, scene: WildScene, pixel: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
    """Reflectance (H, W) of the board at points of its plane (mm from its middle), edges as wide as a pixel; where it is."""
    squares = np.array([_COLUMNS + 1, _ROWS + 1])
    phase = flat / _PITCH + squares / 2
    nearest = np.rint(phase)
    side = np.clip((phase - nearest) * _PITCH / (0.5 * pixel), -1.0, 1.0) * (1.0 - 2.0 * (nearest % 2))
    checker = 0.5 - 0.5 * side[..., 0] * side[..., 1]
    inside = (np.abs(phase - squares / 2) < squares / 2).all(axis=-1)
    value = np.where(inside, 0.06 + 0.94 * checker, 1.0)
    for _ in range(scene.dust):
        at = rng.uniform(-0.5, 0.5, 2) * squares * _PITCH
        value = np.where(((flat - at) ** 2).sum(axis=-1) < rng.uniform(0.4, 2.0) ** 2, 0.4, value)
    on = (np.abs(flat) < squares * _PITCH / 2 + max(scene.margin, 0.0)).all(axis=-1)
    return np.asarray(value), np.asarray(on)
