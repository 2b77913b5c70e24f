"""What a scan may be asked for, and how a capture and a rig fit: lasers, channels, sizes, motion."""

from __future__ import annotations

from dataclasses import dataclass, field

from calibration.errors import FileError
from calibration.rig import Rig
from calibration.sheet import Laser
from ranging.background import Channel, choose_channel
from ranging.motion import Linear, Motion, Turntable
from ranging.stripe import Method, StripeOptions, Which, best_channel
from scope.cloud import FilterOptions
from scope.session import Capture, Image, StageUse, shape_text


@dataclass(frozen=True, slots=True, eq=False)
class ScanOptions:
    """What a scan may be asked for."""

    stripe: StripeOptions = field(default_factory=StripeOptions)
    extrapolate: float = 0.0  # mm outside the calibrated volume that are still ranged
    max_sigma: float | None = None  # mm; points less certain than this are rejected
    normals: bool = False
    filters: FilterOptions = field(default_factory=FilterOptions)


def scan_options(
    *,
    method: Method = "auto",
    which: Which = "strongest",
    normals: bool = False,
    max_sigma: float | None = None,
    extrapolate: float = 0.0,
    isolated: int | None = None,
    max_incidence: float | None = None,
    voxel: float | None = None,
) -> ScanOptions:
    """Options of a scan as the command line gives them."""
    return ScanOptions(
        StripeOptions(method=method, which=which), extrapolate=extrapolate, max_sigma=max_sigma, normals=normals,
        filters=FilterOptions(isolated=isolated, max_incidence=max_incidence, voxel=voxel),
    )  # fmt: skip


def lasers_of(capture: Capture, rig: Rig) -> tuple[Laser, ...]:
    """Lasers of the rig that a capture shows; ``FileError`` where it names another, or the rig has none."""
    if not rig.lasers:
        raise FileError(f"{capture.path}: the rig has no laser; calibrate with laser images on its planes")
    wanted = capture.lasers if capture.lasers is not None else tuple(rig.lasers)
    for name in wanted:
        if name not in rig.lasers:
            raise FileError(f"{capture.path}: lasers names {name!r}; the rig has {', '.join(rig.lasers)}: correct it")
    return tuple(rig.lasers[name] for name in wanted)


def channel_of(capture: Capture, laser: Laser, sample: list[Image], has_dark: bool) -> Channel:
    """Channel in which a laser is read: what was asked for, what it was calibrated in, or what a few frames tell."""
    asked = capture.channel if capture.channel != "auto" else laser.channel.partition("-")[0]
    if capture.channel == "auto" and asked == "gray":  # calibrated without colours, which says nothing of these images
        asked = "auto"
    if not sample or asked.endswith("-excess"):
        return asked  # type: ignore[return-value]
    usual = choose_channel(sample, asked, laser_off=has_dark)  # type: ignore[arg-type]
    others = ("gray", "red", "green", "blue") if asked == "auto" else (asked,) if asked != "gray" else ()
    return best_channel(sample, usual, others, along="rows" if laser.along == "rows" else "columns")  # type: ignore[arg-type]


def separated_by_colour(
    capture: Capture, lasers: tuple[Laser, ...], channels: tuple[Channel, ...]
) -> tuple[Channel, ...]:
    """Channels of lasers that shine at once: each colour's excess, so that one line does not show in the other's image."""
    colours = [channel.partition("-")[0] for channel in channels]
    if len(set(colours)) < len(colours) or {"gray", "auto"} & set(colours):
        told = ", ".join(f"{laser.name} is read in {colour}" for laser, colour in zip(lasers, colours, strict=True))
        raise FileError(
            f"{capture.path}: {told}: lasers that shine together are told apart by colour; give each [laser.NAME] a channel "
            'of its own at calibration, scan one at a time (lasers), or take turns (sequence = "cycle")'
        )
    return tuple(f"{colour}-excess" for colour in colours)  # type: ignore[misc]


def check_size(image: Image, capture: Capture, rig: Rig, name: str = "its images") -> None:
    """Refuse with ``FileError`` an image of another size than the rig was calibrated at."""
    width, height = rig.camera.size
    if image.shape[:2] != (height, width):
        raise FileError(
            f"{capture.path}: {name}: {shape_text(image)}; the rig was calibrated at {width} x {height} px: use the camera "
            "settings of the calibration, or the rig of this camera"
        )


def motion_of(capture: Capture, rig: Rig) -> Motion:
    """Motion of a capture, by the stage of the rig where it asks for that; ``FileError`` where the rig has none."""
    use = capture.motion
    if not isinstance(use, StageUse):
        return use
    for stage in rig.stages:
        if stage.kind == use.kind:
            if use.kind == "linear":
                return Linear(stage.direction, use.positions, use.sign)
            return Turntable(stage.point, stage.direction, use.positions, use.sign)
    raise FileError(
        f"{capture.path}: motion asks for the rig's {use.kind} stage, and the rig has none; add a [[stage]] to "
        "calibration.toml, or give the direction or axis here"
    )
