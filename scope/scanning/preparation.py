"""Before the first stage: how a capture, or frames in memory, and a rig fit, and what a few frames tell of the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.camera import centre_of
from calibration.errors import FileError
from calibration.geometry import Array
from calibration.rig import Rig
from calibration.sheet import Laser
from ranging.background import Channel, Image, choose_channel, clipping_level, mean_image, to_gray
from ranging.motion import Linear, Motion, Turntable
from ranging.robot import Robot
from ranging.stripe import Stripe, StripeOptions, best_channel
from scope.scanning.options import ScanOptions
from scope.scanning.setup import Asked, ScanSetup, require_size
from scope.scanning.stripes import find_stripes
from scope.scanning.table import table_motion
from scope.session import Capture, Frame, StageUse, read_alike

LOOK = 16  # first frames, over which those are spread that tell the channel and the noise of the camera
SAMPLE = 3  # such frames


def asked_by_capture(capture: Capture, rig: Rig) -> Asked:
    """What a capture file asks of a rig; ``FileError`` where it is of another camera, or asks for what the rig lacks."""
    if capture.camera_id and rig.camera_id and capture.camera_id != rig.camera_id:
        raise FileError(
            f"{capture.path}: camera_id {capture.camera_id!r}, the rig is of {rig.camera_id!r}; use the rig of this camera"
        )
    background: tuple[Image, ...] = ()
    lasers = lasers_of(str(capture.path), rig, capture.lasers)
    use = capture.motion
    table = table_motion(capture, rig, use) if isinstance(use, StageUse) and use.markers is not None else None
    motion = motion_of(capture, rig) if table is None else table.motion
    if capture.background_mode == "mean":
        background = tuple(read_alike(capture.background, "the background"))
    return Asked(
        str(capture.path), motion, lasers, capture.channel, capture.background_mode != "none", background,
        capture.sequence == "cycle", table,
    )  # fmt: skip


def set_up(asked: Asked, rig: Rig, options: ScanOptions, first: Sequence[Frame]) -> ScanSetup:
    """Choose channels and learn clipping and noise from the first frames of a scan.

    The frames looked at are spread over the first ``LOOK``, whatever the source, so that files, videos, cameras and arrays
    of the same frames give the same points.

    Raises
    ------
    FileError
        Frames or laser-off images of another size than the rig's, or two lasers that cannot be told apart.
    """
    sample = list(first[:: max(1, -(-len(first) // SAMPLE))])
    for frame in sample:
        require_size(frame.image, rig, f"{asked.owner}: {frame.name}")
    images = [frame.image for frame in sample]
    channels = tuple(channel_of(asked, laser, images) for laser in asked.lasers)
    if len(asked.lasers) > 1 and not asked.in_turn:
        channels = separated_by_colour(asked, channels)
    darks: tuple[Image | None, ...] = (None,) * len(asked.lasers)
    if asked.background:
        require_size(asked.background[0], rig, f"{asked.owner}: its images")
        darks = tuple(mean_image([to_gray(image, channel) for image in asked.background]) for channel in channels)
    # where the object moves, frames are compared with each other: a better judge than a frame's own lines
    stripe = replace(options.stripe, neighbours=options.stripe.neighbours and not isinstance(asked.motion, Linear))
    if stripe.saturation is None and images:
        stripe = replace(stripe, saturation=clipping_level(images))
    setup = ScanSetup(
        asked.owner, rig, options, asked.motion, asked.lasers, channels, darks, asked.in_turn, stripe, _centre(rig),
        images[0] if images else None, table=asked.table,
    )  # fmt: skip
    found = [find_stripes(setup, frame) for frame in sample]
    return replace(setup, stripe=with_noise(stripe, [each.stripe for frame in found for each in frame.lasers]))


def with_noise(asked: StripeOptions, found: Sequence[Stripe]) -> StripeOptions:
    """Stripe options with the median noise of a few frames: a camera has one, and looking for it in each costs time."""
    noise = [stripe.noise for stripe in found if stripe.noise is not None]
    if not noise:
        return asked
    gain = 1.0 / float(np.median([1.0 / each.gain_e for each in noise]))
    read = float(np.median([each.read_noise for each in noise]))
    return replace(
        asked, gain_e=asked.gain_e or gain, read_noise=read if asked.read_noise is None else asked.read_noise
    )


def lasers_of(owner: str, rig: Rig, names: Sequence[str] | None) -> tuple[Laser, ...]:
    """Lasers of the rig by name, all where none are named; ``FileError`` where one is not there, or the rig has none."""
    if not rig.lasers:
        raise FileError(f"{owner}: the rig has no laser; calibrate with laser images on its planes")
    for name in names or ():
        if name not in rig.lasers:
            raise FileError(f"{owner}: lasers names {name!r}; the rig has {', '.join(rig.lasers)}: correct it")
    return tuple(rig.lasers[name] for name in (rig.lasers if names is None else names))


def channel_of(asked: Asked, laser: Laser, sample: Sequence[Image]) -> Channel:
    """Channel in which a laser is read: what was asked for, what it was calibrated in, or what a few frames tell."""
    channel = asked.channel if asked.channel != "auto" else laser.channel.partition("-")[0]
    if asked.channel == "auto" and channel == "gray":  # calibrated without colours, which says nothing of these images
        channel = "auto"
    if not sample:
        return channel  # type: ignore[return-value]
    usual = choose_channel(sample, channel, laser_off=asked.laser_off)  # type: ignore[arg-type]
    if asked.laser_off or channel.endswith("-excess") or channel == "gray":
        return usual
    others = ("gray", "red", "green", "blue") if channel == "auto" or len(asked.lasers) == 1 else (channel,)
    return best_channel(sample, usual, others, along="rows" if laser.along == "rows" else "columns")  # type: ignore[arg-type]


def separated_by_colour(asked: Asked, channels: tuple[Channel, ...]) -> tuple[Channel, ...]:
    """Channels of lasers that shine at once: each colour's excess, so that one line does not show in the other's image."""
    colours = [channel.partition("-")[0] for channel in channels]
    if len(set(colours)) < len(colours) or {"gray", "auto"} & set(colours):
        told = ", ".join(
            f"{laser.name} is read in {colour}" for laser, colour in zip(asked.lasers, colours, strict=True)
        )
        raise FileError(
            f"{asked.owner}: {told}: lasers that shine together are told apart by colour; give each [laser.NAME] a channel "
            'of its own at calibration, scan one at a time (lasers), or take turns (sequence = "cycle")'
        )
    return tuple(f"{colour}-excess" for colour in colours)  # type: ignore[misc]


def motion_of(capture: Capture, rig: Rig) -> Motion:
    """Motion of a capture, by the stage of the rig where it asks for that; ``FileError`` where the rig has none."""
    use = capture.motion
    if isinstance(use, Robot) and use.rig_sha256 and rig.sha256 and use.rig_sha256 != rig.sha256:
        raise FileError(
            f"{capture.path}: its hand-eye.json is about the frame C of the rig {use.rig_sha256[:12]}, this rig is "
            f"{rig.sha256[:12]}: run scope hand-eye with this rig"
        )
    if not isinstance(use, StageUse):
        return use
    for stage in rig.stages:
        if stage.kind == use.kind:
            if use.kind == "linear":
                return Linear(stage.direction, positions=use.positions, sign=use.sign)
            return Turntable(stage.point, stage.direction, positions=use.positions, sign=use.sign)
    raise FileError(
        f"{capture.path}: motion asks for the rig's {use.kind} stage, and the rig has none; add a [[stage]] to "
        "calibration.toml, or give the direction or axis here"
    )


def _centre(rig: Rig) -> Array:
    """Point (3,) mm nearest to all sighting rays: the camera's centre in C."""
    width, height = rig.camera.size
    u, v = np.meshgrid(np.linspace(0.1, 0.9, 9) * width, np.linspace(0.1, 0.9, 9) * height)
    return centre_of(rig.camera.rays(np.stack([u.ravel(), v.ravel()], axis=1)))
