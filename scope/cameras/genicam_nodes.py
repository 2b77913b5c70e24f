"""What the drivers of GenICam cameras share: numbers of frames that wrap around, and the nodes of a laser's line."""

from __future__ import annotations

from dataclasses import dataclass

_WRAP = 65535  # GigE Vision 1.x counts blocks from 1 to 65535 and then from 1 again; 0 is never used


@dataclass(slots=True)
class FrameIds:
    """Numbers from 0 of frames by the ids that a camera gives them, and how many are missing between."""

    count: int = 0  # frames so far
    missing: int = 0  # ids that never came
    _last: int = 0
    _number: int = -1
    _began: float = 0.0

    def next(self, identity: int, seconds: float) -> tuple[int, float]:
        """Number from 0, and time from the first frame, s, of the next frame."""
        if self.count == 0:
            self._began, gap = seconds, 1
        else:
            gap = identity - self._last
            if gap <= 0 and self._last <= _WRAP:
                gap += _WRAP
            if gap <= 0:
                gap = 1  # the camera counts anew
        self.missing += gap - 1
        self.count, self._last, self._number = self.count + 1, identity, self._number + gap
        return self._number, seconds - self._began


def laser_nodes(line: str | None, *, on: bool) -> list[tuple[str, str | bool]]:
    """Nodes to set, in order, so that an output line is on or off.

    Source: GenICam Standard Features Naming Convention 2.7, Digital I/O Control.
    """
    if line is None:
        return []
    return [
        ("LineSelector", line),
        ("LineMode", "Output"),
        ("LineSource", "UserOutput1"),
        ("UserOutputSelector", "UserOutput1"),
        ("UserOutputValue", on),
    ]
