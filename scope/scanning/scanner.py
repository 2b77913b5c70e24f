"""The scanner as an object: images in memory to profiles and clouds, with nothing written to disk."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from calibration.notebook import Picture, Shown, Summary
from calibration.rig import Rig
from ranging.background import Channel, Image
from ranging.errors import RangingError
from ranging.motion import Fixed, Motion
from ranging.profile import Profile
from ranging.triangulation import triangulate
from scope.cloud import ScanCloud
from scope.scanning.options import ScanOptions
from scope.scanning.preparation import LOOK, SAMPLE, lasers_of, set_up
from scope.scanning.run import gathered, runs, trusted
from scope.scanning.setup import Asked, ScanSetup
from scope.scanning.statistics import Scan
from scope.scanning.stripes import find_stripes
from scope.session import Frame, ImageInMemory, Iterated

Frames = Iterable[Image | tuple[Image, Image]]


class Scanner(Shown):
    """A calibrated rig that takes images.

    Parameters
    ----------
    rig : Rig or path
        As calibrated.
    options : ScanOptions, optional
        As for `scope.scan`.
    laser : str, optional
        Name of the laser that shines. Without it, scans use all lasers of the rig, and profiles need a rig of one.
    channel : str, optional
        In which the laser is read; "auto" takes the one that it was calibrated in.

    Raises
    ------
    FileError
        A rig that cannot be read, has no laser, or none of that name.
    """

    def __init__(
        self, rig: Rig | str | Path, *, options: ScanOptions | None = None, laser: str | None = None, channel: Channel = "auto"
    ) -> None:  # fmt: skip
        self.rig = rig if isinstance(rig, Rig) else Rig.load(rig)
        self.options = options or ScanOptions()
        self._lasers = lasers_of("scanner", self.rig, None if laser is None else (laser,))
        self._channel = channel
        self._setup: ScanSetup | None = None
        self._first: list[Frame] = []  # images that told the noise of the camera

    def profile(self, image: Image, background: Image | None = None) -> Profile:
        """Range one image: the live path.

        The noise of the camera and the channel are learnt from the first images and then kept. A profile stands alone: what
        only frames beside each other tell, slopes across the sheet and edges from frame to frame, is for `scan`.

        Parameters
        ----------
        image : (rows, columns) or (rows, columns, 3), uint8 or uint16
            As the camera gives it; colours in the order blue, green, red, as OpenCV's.
        background : like the image, optional
            With the laser off, to be subtracted.

        Returns
        -------
        Profile
            Points in C, one row a line of the image.

        Raises
        ------
        ValueError
            No image, or a rig of several lasers and none named.
        FileError
            An image of another size than the rig's, or of another depth than those before.
        """
        if len(self._lasers) != 1:
            names = ", ".join(laser.name for laser in self._lasers)
            raise ValueError(f"the rig has the lasers {names}: name the one that shines, Scanner(rig, laser=...)")
        frame = Frame(
            0, "image", _image(image, "image"), None if background is None else _image(background, "background")
        )
        setup = self._ready(frame)
        found = find_stripes(setup, frame).lasers[0]
        stripe, laser = found.stripe, self._lasers[0]
        across = 1 if laser.along == "rows" else 0
        points = triangulate(
            self.rig.camera, laser, stripe.pixels, stripe.sigma, across, extrapolate=self.options.extrapolate
        )
        return Profile.of(points, stripe, laser.name)

    def scan(
        self,
        frames: Frames,
        motion: Motion,
        *,
        background: Sequence[Image] = (),
        sequence: Literal["together", "cycle"] = "together",
    ) -> ScanCloud:
        """Range frames as they come: the same points as `scope.scan` gives of the same frames.

        Parameters
        ----------
        frames : iterable of images, or of pairs (image, laser-off image)
            Each as for `profile`. They are asked for one after the other and few are held.
        motion : Linear, Turntable, Poses or Fixed
            Of frame 0, 1, ...
        background : images, optional
            With the laser off, whose mean is subtracted from all frames.
        sequence : "together" or "cycle"
            Whether several lasers shine at once or take turns.

        Raises
        ------
        ValueError, FileError, RangingError
            Something that is no image, frames that do not fit the rig or each other, no point in any frame, or a scan that
            contradicts its motion (`run_scan` gives that one too, with what is wrong with it).
        """
        return trusted(self.run_scan(frames, motion, background=background, sequence=sequence))

    def run_scan(
        self,
        frames: Frames,
        motion: Motion,
        *,
        background: Sequence[Image] = (),
        sequence: Literal["together", "cycle"] = "together",
        on_frame: Callable[[int, int], None] = lambda _done, _total: None,
    ) -> Scan:
        """As `scan`, with counts of what was left out and why; ``on_frame`` is called with (done, total or 0)."""
        setup, source = self._open(frames, motion, background, sequence)
        return gathered(setup, source, on_frame=on_frame)

    def stream(self, frames: Frames, motion: Motion, *, background: Sequence[Image] = ()) -> Iterator[ScanCloud]:
        """As `scan`, a run of frames at a time, as soon as the frames that have a say in it are there."""
        setup, source = self._open(frames, motion, background, "together")
        for chunk in runs(setup, source):
            yield chunk.cloud

    def _open(
        self, frames: Frames, motion: Motion, background: Sequence[Image], sequence: Literal["together", "cycle"]
    ) -> tuple[ScanSetup, Iterated]:
        darks = tuple(_image(image, "background") for image in background)
        source = Iterated.of(_checked(frames))
        first = source.first(LOOK)
        if not first:
            raise RangingError("no frame came: give images (rows, columns) or (rows, columns, 3), one at least")
        laser_off = bool(darks) or first[0].background is not None
        asked = Asked("scan", motion, self._lasers, self._channel, laser_off, darks, sequence == "cycle")
        return set_up(asked, self.rig, self.options, first), source

    def _ready(self, frame: Frame) -> ScanSetup:
        """Setup for profiles, learnt again until enough images have been seen."""
        if self._setup is None or len(self._first) < SAMPLE:
            if self._setup is not None:
                self._setup.require_alike(frame.image, frame.name)
            asked = Asked("profile", Fixed(), self._lasers, self._channel, frame.background is not None)
            first = [*self._first, replace(frame, image=frame.image.copy())]
            self._setup = set_up(asked, self.rig, self.options, first)
            self._first = first
        return self._setup

    def summary(self) -> Summary:
        """Rig and lasers."""
        width, height = self.rig.camera.size
        return Summary(f"Scanner {width} x {height} px", (("lasers", ", ".join(laser.name for laser in self._lasers)),))

    def picture(self) -> tuple[Picture | None, str]:
        """The rig's sheets of light."""
        return self.rig.picture()


def _checked(frames: Frames) -> Iterator[Image | tuple[Image, Image]]:
    for k, frame in enumerate(frames):
        if isinstance(frame, tuple):
            if len(frame) != 2:
                raise ValueError(
                    f"frame {k} is a tuple of {len(frame)}: give an image, or a pair (image, laser-off image)"
                )
            yield _image(frame[0], f"frame {k}"), _image(frame[1], f"frame {k}, laser off")
        else:
            yield _image(frame, f"frame {k}")


def _image(value: Image, name: str) -> Image:
    """An image as the camera gives it; ``ValueError`` with what is wanted for anything else."""
    return ImageInMemory(name, value).pixels
