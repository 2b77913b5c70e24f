"""capture.toml and a rig to a cloud: the stages of ranging joined."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibration.camera import centre_of
from calibration.errors import FileError, ScopeError
from calibration.geometry import Array, quaternion_from_rotation
from calibration.reason import Reason
from calibration.rig import Rig
from calibration.sheet import Laser
from ranging.background import Channel, clipping_level, mean_image, saturation_level, to_gray
from ranging.errors import RangingError
from ranging.motion import Fixed, Linear, Motion
from ranging.stripe import Stripe, StripeOptions, extract
from ranging.surface import CONTEXT, REACH, Lattice, MeasuredProfile, Timeframe, refine
from ranging.triangulation import triangulate
from scope.cloud import ScanCloud, Sensors, filtered
from scope.scanning.agreement import Agreement, agreements
from scope.scanning.overlap import with_turn_trouble
from scope.scanning.setup import ScanOptions, channel_of, check_size, lasers_of, motion_of, separated_by_colour
from scope.scanning.statistics import Chunk, Footprint, Scan, ScanStatistics
from scope.session import (
    AHEAD,
    Capture,
    Frame,
    Image,
    Source,
    frames_in_memory,
    in_order,
    open_source,
    read_alike,
    read_capture,
    shape_text,
)

CHUNK = 24  # frames ranged at once; fewer where they are large
FIRST = 2  # the same, of the first, so that points are seen at once
CROSSING = 4.0  # widths (one sigma) of both stripes between their middles, within which they disturb each other
SAMPLE = 3  # frames that tell the channel and the noise of the camera
Tick = Callable[[int, int], None]
_REMEDIES = {  # by the reason that most lines have
    "outside_calibration": "bring the object into the calibrated volume, calibrate further, or give --extrapolate",
    "saturated": "expose shorter, or close the iris",
    "two_peaks": "keep reflections away, or choose one of several peaks with --which",
    "uncertain": "give a larger --max-sigma, or expose longer",
    "too_wide": "focus camera and laser: a stripe may be 6 px wide (one sigma)",
}


def _no_tick(_done: int, _total: int) -> None:
    return None


def scan(capture: str | Path, rig: Rig | str | Path, *, options: ScanOptions | None = None) -> ScanCloud:
    """Range every frame of a capture; see `run_scan` for the cloud with its bookkeeping."""
    return run_scan(capture, rig, options=options).cloud


def run_scan(
    capture: str | Path,
    rig: Rig | str | Path,
    *,
    options: ScanOptions | None = None,
    on_frame: Tick = _no_tick,
    done: list[Chunk] | None = None,
    on_chunk: Callable[[Chunk], None] | None = None,
) -> Scan:
    """Range every frame of a capture.

    Parameters
    ----------
    capture, rig : path, and Rig or path
        The capture file and the calibrated rig.
    options : ScanOptions
        Defaults range within the calibrated volume and reject nothing by sigma.
    on_frame : callable
        Called with (done, total) after each frame; total is 0 where nobody knows it.
    done : list of Chunk, optional
        Chunks of an interrupted scan, those that were ``settled``: ranging goes on after their last frame.
    on_chunk : callable, optional
        Called with each new chunk, so that what was found can be kept.

    Returns
    -------
    Scan
        Incomplete where the source broke off or the user interrupted; what was found until then is kept.

    Raises
    ------
    FileError, RangingError
        Files that do not fit the rig, or no stripe in any frame.
    """
    started = time.perf_counter()
    plan = Plan.of(
        read_capture(Path(capture)), rig if isinstance(rig, Rig) else Rig.load(rig), options or ScanOptions()
    )
    statistics, parts = ScanStatistics(), []
    for chunk in done or []:
        statistics.add(chunk)
        parts.append(chunk.cloud)
    try:
        for chunk in plan.chunks(statistics.frames, on_frame):
            statistics.add(chunk)
            parts.append(chunk.cloud)
            if on_chunk is not None:
                on_chunk(chunk)
        why = plan.source.trouble
    except KeyboardInterrupt:
        why = plan.interrupted(statistics)
    return with_turn_trouble(plan.finish(joined(parts), statistics, why, time.perf_counter() - started), plan.motion)


@dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """One laser's stripe on one frame, and the images that show it."""

    laser: int
    stripe: Stripe
    image: Image
    dark: Image | None


@dataclass(frozen=True, slots=True, eq=False)
class _Sight:
    """One frame's points, by the index of the laser."""

    number: int
    seen: dict[int, MeasuredProfile] = field(default_factory=dict)
    timeframes: dict[int, Timeframe] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """How a capture is ranged with a rig."""

    capture: Capture
    rig: Rig
    options: ScanOptions
    lasers: tuple[Laser, ...]
    channels: tuple[Channel, ...]
    darks: tuple[Image | None, ...]  # mean background of each laser's channel
    stripe: StripeOptions  # with the noise of the camera, where some frames have told it
    motion: Motion
    source: Source
    centre: Array  # (3,) camera centre in C
    like: Image | None  # with whose depth and channels all frames must agree; None before any has come

    @classmethod
    def of(cls, capture: Capture, rig: Rig, options: ScanOptions) -> Plan:
        """Plan of a capture; ``FileError`` where its files do not fit the rig, ``RangingError`` for a camera without answer."""
        if capture.camera_id and rig.camera_id and capture.camera_id != rig.camera_id:
            raise FileError(
                f"{capture.path}: camera_id {capture.camera_id!r}, the rig is of {rig.camera_id!r}; use the rig of this camera"
            )
        lasers = lasers_of(capture, rig)
        motion = motion_of(capture, rig)
        source = open_source(capture)
        frames = source.sample(SAMPLE)
        sample = [frame.image for frame in frames]
        for frame in frames:
            check_size(frame.image, capture, rig, frame.name)
        has_dark = capture.background_mode != "none"
        channels = tuple(channel_of(capture, laser, sample, has_dark) for laser in lasers)
        if len(lasers) > 1 and capture.sequence == "together":
            channels = separated_by_colour(capture, lasers, channels)
        darks: tuple[Image | None, ...] = (None,) * len(lasers)
        if capture.background_mode == "mean":
            images = read_alike(capture.background, "the background")
            check_size(images[0], capture, rig)
            darks = tuple(mean_image([to_gray(image, channel) for image in images]) for channel in channels)
        width, height = rig.camera.size
        u, v = np.meshgrid(np.linspace(0.1, 0.9, 9) * width, np.linspace(0.1, 0.9, 9) * height)
        centre = centre_of(rig.camera.rays(np.stack([u.ravel(), v.ravel()], axis=1)))
        # where the object moves, frames are compared with each other: a better judge than a frame's own lines
        stripe = replace(options.stripe, neighbours=options.stripe.neighbours and not isinstance(motion, Linear))
        if stripe.saturation is None and sample:
            stripe = replace(stripe, saturation=clipping_level(sample))
        plan = cls(
            capture,
            rig,
            options,
            lasers,
            channels,
            darks,
            stripe,
            motion,
            source,
            centre,
            sample[0] if sample else None,
        )
        return replace(plan, stripe=plan._with_noise(frames))

    def _with_noise(self, frames: list[Frame]) -> StripeOptions:
        """Stripe options with the median noise of a few frames: a camera has one, and looking for it in each costs time."""
        asked = self.stripe
        known = [taken.stripe.noise for frame in frames for taken in self._extract(frame)[1]]
        noise = [found for found in known if found is not None]
        if not noise:
            return asked
        gain = 1.0 / float(np.median([1.0 / found.gain_e for found in noise]))
        read = float(np.median([found.read_noise for found in noise]))
        return replace(
            asked, gain_e=asked.gain_e or gain, read_noise=read if asked.read_noise is None else asked.read_noise
        )

    def chunks(self, first: int, on_frame: Tick) -> Iterator[Chunk]:
        """Ranged runs of frames, in order; what they end with depends on ``CONTEXT`` frames before and after each."""
        total = self.source.count or 0
        at = max(0, first - CONTEXT)  # position of the window's first frame
        fresh: list[tuple[int, list[_Taken]]] = []
        window: list[_Sight] = []
        begun, stopped = first, False
        run = frames_in_memory(self.like, CHUNK)
        try:
            for found in in_order(self.source, self._extract, first=at, ahead=frames_in_memory(self.like, AHEAD)):
                fresh.append(found)
                done = at + len(window) + len(fresh)
                if done > first:
                    on_frame(done, total)
                end = begun + (run if begun else FIRST)
                if done == end + CONTEXT:
                    window, fresh = window + self._see(fresh), []
                    yield self._chunk(window, at, begun, end)
                    begun, old = end, max(0, end - CONTEXT - at)
                    window, at = window[old:], at + old
                    for sight in window[: max(0, begun - REACH - at)]:
                        sight.timeframes.clear()
        except KeyboardInterrupt:
            stopped = True
        window = window + self._see(fresh)
        while begun < at + len(window):
            end = min(begun + (run if begun else FIRST), at + len(window))
            yield replace(self._chunk(window, at, begun, end), settled=False)
            begun = end
        if stopped:
            raise KeyboardInterrupt

    def _saturation(self, image: Image) -> float:
        asked = self.stripe.saturation
        return float(saturation_level(image.dtype) if asked is None else asked)

    def interrupted(self, statistics: ScanStatistics) -> str:
        """Why a scan that the user ended is incomplete; empty for a camera that was to run until then."""
        return "" if self.source.endless else f"interrupted after {statistics.frames} frames"

    def _extract(self, frame: Frame) -> tuple[int, list[_Taken]]:
        """Stripes of one frame, by laser; runs in a thread."""
        check_size(frame.image, self.capture, self.rig, frame.name)
        like = self.like
        if like is not None and (frame.image.dtype != like.dtype or frame.image.ndim != like.ndim):
            raise FileError(
                f"{self.capture.path}: {frame.name}: {shape_text(frame.image)}, others have {shape_text(like)}; all frames of "
                "a scan must agree: take them with the same settings"
            )
        shown = range(len(self.lasers))
        if self.capture.sequence == "cycle":
            shown = range(frame.number % len(self.lasers), frame.number % len(self.lasers) + 1)
        found = []
        for k in shown:
            image = to_gray(frame.image, self.channels[k])
            dark = self.darks[k] if frame.background is None else to_gray(frame.background, self.channels[k])
            along = self.lasers[k].along
            try:
                stripe = extract(image, along=along, options=self.stripe, background=dark)  # type: ignore[arg-type]
            except ScopeError as error:
                raise RangingError(f"{frame.name}: {error}") from error
            found.append(_Taken(k, stripe, image, dark))
        _uncross([taken.stripe for taken in found])
        return frame.number, found

    def _see(self, frames: list[tuple[int, list[_Taken]]]) -> list[_Sight]:
        """Triangulate frames, all at once for each laser."""
        sights = [_Sight(number) for number, _ in frames]
        for k, laser in enumerate(self.lasers):
            shown = [
                (sight, taken)
                for sight, (_, all_) in zip(sights, frames, strict=True)
                for taken in all_
                if taken.laser == k
            ]
            if not shown:
                continue
            pixels = np.concatenate([taken.stripe.pixels for _, taken in shown])
            sigma_px = np.concatenate([taken.stripe.sigma for _, taken in shown])
            across = 1 if laser.along == "rows" else 0
            found = triangulate(self.rig.camera, laser, pixels, sigma_px, across, extrapolate=self.options.extrapolate)
            begin = 0
            for sight, taken in shown:
                stripe = taken.stripe
                end = begin + len(stripe.position)
                pose = self.motion.cloud_from_c(sight.number)
                part = found.rows(begin, end)
                sight.seen[k] = MeasuredProfile.of(part, stripe, pose, self.centre)
                sight.timeframes[k] = Timeframe(
                    taken.image, taken.dark, laser.along, self._saturation(taken.image), pose,
                    part.slide @ pose.rotation.T, stripe.floor,
                )  # fmt: skip
                begin = end
        return sights

    def _chunk(self, window: list[_Sight], at: int, begun: int, end: int) -> Chunk:
        """Refine the frames from position ``begun`` to ``end`` of a window that begins at ``at``, and gather their points."""
        parts: list[ScanCloud] = []
        rejected: Counter[str] = Counter()
        stripes: dict[int, Footprint] = {}
        with_points: set[int] = set()
        for k in range(len(self.lasers)):
            shown = [(at + i, sight) for i, sight in enumerate(window) if k in sight.seen]
            first, last = (sum(1 for position, _ in shown if position < edge) for edge in (begun, end))
            if first == last:
                continue
            part, counts, stripe = self._refined(k, [sight for _, sight in shown], first, last)
            if stripe is not None:
                stripes[k] = stripe
            rejected += counts
            with_points |= set(np.unique(part.frame).tolist())
            parts.append(part)
        numbers = {sight.number for sight in window[begun - at : end - at]}
        return Chunk(begun, end - begun, joined(parts), rejected, len(numbers - with_points), stripes)

    def _refined(
        self, k: int, sights: list[_Sight], first: int, last: int
    ) -> tuple[ScanCloud, Counter[str], Footprint | None]:
        lattice = Lattice.of([sight.seen[k] for sight in sights])
        timeframes = [] if isinstance(self.motion, Fixed) else [sight.timeframes.get(k) for sight in sights]
        found = refine(lattice, first, last, timeframes, blur_px=self.rig.blur_px)
        reason = found.reason
        if self.options.max_sigma is not None:
            reason[(reason == Reason.RANGED) & ~(found.sigma <= self.options.max_sigma)] = Reason.UNCERTAIN
        keep = reason == Reason.RANGED
        lines = np.broadcast_to(np.arange(reason.shape[1], dtype=np.float64), reason.shape)
        pair = (lines, found.position) if self.lasers[k].along == "rows" else (found.position, lines)
        numbers = np.array([sight.number for sight in sights[first:last]], dtype=np.int32)
        counts = Counter(
            {
                Reason(int(code)).key: int(n)
                for code, n in zip(*np.unique(reason[~keep], return_counts=True), strict=True)
            }
        )
        cloud = ScanCloud(
            points=found.points[keep],
            intensity=lattice.peak[first:last][keep].astype(np.float32),
            sigma=found.sigma[keep].astype(np.float32),
            sigma_cal=lattice.sigma_cal[first:last][keep].astype(np.float32),
            pixels=np.stack(pair, axis=2)[keep].astype(np.float32),
            frame=np.broadcast_to(numbers[:, None], reason.shape)[keep],
            laser=np.full(int(keep.sum()), k, dtype=np.uint8),
        )
        known = np.isfinite(found.footprint)
        return cloud, counts, Footprint(found.footprint, found.corrected, len(cloud)) if known else None

    def refuse_nothing(self, statistics: ScanStatistics) -> None:
        """``RangingError`` where no frame gave a point."""
        if statistics.points:
            return
        if not statistics.frames:
            raise RangingError(f"{self.capture.path}: no frame came; check the camera or the video and scan again")
        reasons = ", ".join(f"{count} {reason}" for reason, count in statistics.rejected.most_common(3))
        most = statistics.rejected.most_common(1)[0][0] if statistics.rejected else ""
        raise RangingError(
            f"{self.capture.path}: no point in any of {statistics.frames} frames (lines without a point: {reasons}); "
            f"{_REMEDIES.get(most, 'check that the laser is on, `channel`, exposure and focus')}"
        )

    def described(self, cloud: ScanCloud, why: str, statistics: ScanStatistics) -> ScanCloud:
        """Cloud with all that is known of the scan but its sensors."""
        stripes = [statistics.stripes.get(k, Footprint(np.nan, 0.0, 0)) for k in range(len(self.lasers))]
        return replace(
            cloud,
            stripe_width=tuple(stripe.width for stripe in stripes),
            stripe_corrected=tuple(stripe.corrected for stripe in stripes),
            laser_names=tuple(laser.name for laser in self.lasers),
            rig_sha256=self.rig.sha256,
            verified=self.rig.verification.passed,
            complete=not why,
            camera_centre=self.centre,
        )

    def finish(self, cloud: ScanCloud, statistics: ScanStatistics, why: str, seconds: float) -> Scan:
        """Sensors, normals, filters and the agreement of lasers; ``RangingError`` where no frame gave a point."""
        self.refuse_nothing(statistics)
        numbers = np.unique(cloud.frame).tolist()
        cloud = replace(self.described(cloud, why, statistics), sensors=self.sensors(numbers))
        agreement = agreements(cloud)
        if self.options.normals:
            from scope.cloud import lattice_normals

            stored = cloud.points.astype(np.float32).astype(np.float64)  # as a resumed scan finds them
            cloud = replace(cloud, normals=lattice_normals(replace(cloud, points=stored)))
        cloud, removed = filtered(cloud, self.options.filters)
        return self.scan(
            lambda: cloud, statistics, why, seconds, points=len(cloud), filtered=removed, agreement=agreement
        )

    def scan(
        self, load: Callable[[], ScanCloud], statistics: ScanStatistics, why: str, seconds: float, *, points: int,
        filtered: Mapping[str, int] | None = None, agreement: tuple[Agreement, ...] = (),
    ) -> Scan:  # fmt: skip
        """Scan of a cloud that ``load`` gives."""
        return Scan(
            load, points, statistics.frames, statistics.empty, dict(statistics.rejected), seconds, why, statistics.sigma.value,
            statistics.sigma_cal.value, self.rig.verification.passed, filtered or {}, agreement,
        )  # fmt: skip

    def sensors(self, frames: list[int]) -> Sensors:
        """Where camera and lasers were in the frames of these numbers."""
        rows = [(n, k) for n in frames for k in range(len(self.lasers))]
        poses = {n: self.motion.cloud_from_c(n) for n in frames}
        return Sensors(
            frame=np.array([n for n, _ in rows], dtype=np.int32),
            laser=np.array([k for _, k in rows], dtype=np.uint8),
            centre=np.array([poses[n].apply(self.centre) for n, _ in rows]).reshape(-1, 3),
            rotation=np.array([quaternion_from_rotation(poses[n].rotation) for n, _ in rows]).reshape(-1, 4),
            laser_origin=np.array([poses[n].apply(self.lasers[k].origin) for n, k in rows]).reshape(-1, 3),
        )


def joined(parts: list[ScanCloud]) -> ScanCloud:
    """One cloud in scan order: by frame, then by laser, then along the stripe."""
    if not parts:
        return ScanCloud.from_points(np.zeros((0, 3)))
    whole = ScanCloud(
        points=np.concatenate([part.points for part in parts]),
        intensity=np.concatenate([part.intensity for part in parts]),
        sigma=np.concatenate([part.sigma for part in parts]),
        sigma_cal=np.concatenate([part.sigma_cal for part in parts]),
        pixels=np.concatenate([part.pixels for part in parts]),
        frame=np.concatenate([part.frame for part in parts]),
        laser=np.concatenate([part.laser for part in parts]),
    )
    if len(parts) == 1 or np.all(np.diff(whole.frame.astype(np.int64) * 256 + whole.laser) >= 0):
        return whole
    return whole.select(np.lexsort((whole.laser, whole.frame)))


def _uncross(found: list[Stripe]) -> None:
    """Strike out the lines on which two stripes cross: there each takes light away from the other."""
    for i, a in enumerate(found):
        for b in found[i + 1 :]:
            if a.along == b.along:
                close = np.abs(a.position - b.position) < CROSSING * (a.width + b.width)
                for stripe in (a, b):
                    stripe.position[close], stripe.reason[close] = np.nan, Reason.TWO_PEAKS
