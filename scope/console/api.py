"""/api/v1 for a cell's controller, and the pictures and files that the pages show."""

from __future__ import annotations

import asyncio
import math
from typing import Annotated, Any, Literal

from fastapi import APIRouter, FastAPI, HTTPException, Query, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import FileResponse, JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.requests import Request

from calibration.errors import ScopeError
from scope.console.console import Console
from scope.console.jobs import Busy
from scope.history import records_csv
from scope.viewer import viewer_code

_JOB = Field(
    default="",
    max_length=64,
    pattern=r"^([A-Za-z0-9][A-Za-z0-9._-]*)?$",
    description="id; the same id never starts a second job",
)
Number = Annotated[float, Field(allow_inf_nan=False)]
SENT = {
    ".ply": "application/octet-stream",
    ".json": "application/json",
    ".html": "text/html",
    ".toml": "text/plain",
    ".png": "image/png",
    ".csv": "text/csv",
}


class _Asked(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class MotionAsked(_Asked):
    """[motion] of a scan; mm and degrees, in C."""

    kind: Literal["linear", "turntable", "fixed"]
    moves: Literal["object", "sensor"] = "object"
    direction: list[Number] | Literal["rig"] | None = None
    axis: Literal["rig"] | None = None
    axis_point: list[Number] | None = None
    axis_direction: list[Number] | None = None
    step: Number | None = None
    start: Number = 0.0
    positions: str | None = Field(default=None, max_length=100, description="CSV in the session folder, a row a frame")
    log: str | None = Field(default=None, max_length=100, description="CSV in the session folder, positions over time")
    delay: Number | None = None
    clock: Literal["first-frame", "camera", "system"] = "first-frame"


class ScanAsked(_Asked):
    """A scan."""

    job: str = _JOB
    motion: MotionAsked | None = Field(default=None, description="without it, that of the page Scan")
    frames: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    lasers: list[str] | None = Field(default=None, max_length=8, description="those that shine; all where left out")
    sequence: Literal["together", "cycle"] | None = None


class PoseAsked(_Asked):
    """Where a part is."""

    job: str = _JOB
    model: str = Field(max_length=100, description="file in the folder `models` of the session")
    scan: str = Field(default="", max_length=64, description="name of a scan; the newest where it is left out")
    region: str | None = Field(
        default=None, max_length=200, pattern=r"^box:[-+0-9.eE,]+$", description="box:x0,x1,y0,y1[,z0,z1], mm"
    )


def add_api(app: FastAPI, console: Console) -> None:
    """Add all routes that are no pages."""
    api = APIRouter(prefix="/api/v1", tags=["console"])

    @api.get("/status")
    def status() -> dict[str, Any]:
        """State ("ready", "scan", "calibration", "pose", ..., "error"), camera, rig and the job that runs."""
        return told(console.status())

    @api.post("/scan", status_code=202)
    def scan(asked: ScanAsked) -> dict[str, Any]:
        """Start a scan; ask for its end at /job/{job}."""
        motion = None if asked.motion is None else asked.motion.model_dump(exclude_none=True)
        wanted = {"motion": motion, "frames": asked.frames, "lasers": asked.lasers, "sequence": asked.sequence}
        return told(console.start_scan(wanted, asked.job).content)

    @api.post("/stop", status_code=202)
    def stop() -> dict[str, Any]:
        """Stop the job that runs; what it has is kept."""
        console.stop()
        return told(console.status())

    @api.get("/job/{job}")
    def job(job: str) -> dict[str, Any]:
        """State of a job ("running", "done", "failed"), how far it is, and its result."""
        found = console.jobs.get(job)
        if found is None:
            raise HTTPException(404, "no job has this id")
        return told(found.content)

    @api.get("/result")
    def result() -> dict[str, Any]:
        """The job that was started last."""
        found = console.jobs.last
        if found is None:
            raise HTTPException(404, "no job was started yet")
        return told(found.content)

    @api.post("/pose", status_code=202)
    def pose(asked: PoseAsked) -> dict[str, Any]:
        """Find a part in a scan; ask for the answer at /job/{job}."""
        return told(console.start_pose(asked.scan, asked.model, asked.job, region=asked.region).content)

    @api.get("/scan/{name}/{file}")
    def scan_file(name: str, file: Literal["cloud.ply", "report.html", "capture.toml"]) -> FileResponse:
        """Cloud, report or capture of a scan."""
        return sent(console, "scans", name, file)

    app.include_router(api)
    _add_pictures(app, console)

    @app.exception_handler(ScopeError)
    async def refused(_: Request, error: ScopeError) -> JSONResponse:
        return JSONResponse({"error": " ".join(str(error).split())}, 409 if isinstance(error, Busy) else 400)

    @app.exception_handler(RequestValidationError)
    async def malformed(_: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]  # without the input, which comes from anywhere
        return JSONResponse(
            {"error": f"{'.'.join(str(part) for part in first['loc'])[:100]}: {first['msg'][:200]}"}, 422
        )

    @app.exception_handler(RecursionError)
    async def nested(_: Request, __: RecursionError) -> JSONResponse:
        return JSONResponse({"error": "nested too deeply"}, 422)

    @app.exception_handler(ValueError)
    async def wrong(_: Request, error: ValueError) -> JSONResponse:
        return JSONResponse({"error": " ".join(str(error).split())[:300]}, 422)


def _add_pictures(app: FastAPI, console: Console) -> None:
    @app.get("/frame.jpg", include_in_schema=False)
    async def frame(after: Annotated[int, Query(ge=0)] = 0) -> Response:
        number, jpeg = await asyncio.to_thread(console.frame, after)
        if not jpeg:
            return Response(status_code=204)
        return Response(jpeg, media_type="image/jpeg", headers={"x-frame": str(number), "cache-control": "no-store"})

    @app.get("/growing.jpg", include_in_schema=False)
    async def growing(side: Literal["top", "side"] = "top") -> Response:
        jpeg = await asyncio.to_thread(console.growing, side)
        return (
            Response(jpeg, media_type="image/jpeg", headers={"cache-control": "no-store"})
            if jpeg
            else Response(status_code=204)
        )

    @app.get("/history.csv", include_in_schema=False)
    def history() -> Response:
        headers = {"content-disposition": 'attachment; filename="history.csv"'}
        return Response(records_csv(console.history()[::-1]), media_type="text/csv", headers=headers)

    @app.get("/files/{name}", include_in_schema=False)
    def session_file(name: Literal["calibration.html", "rig.json", "calibration.toml"]) -> FileResponse:
        return sent(console, name)

    @app.get("/files/scans/{name}/{file}", include_in_schema=False)
    def file_of_scan(name: str, file: str) -> FileResponse:
        return sent(console, "scans", name, file)

    @app.get("/cloud/{name}.bin", include_in_schema=False)
    async def cloud(name: str) -> Response:
        data = await asyncio.to_thread(console.cloud_bytes, name)
        return Response(data, media_type="application/octet-stream", headers={"cache-control": "no-store"})

    @app.get("/viewer.js", include_in_schema=False)
    def viewer() -> Response:
        return Response(viewer_code(), media_type="text/javascript", headers={"cache-control": "max-age=3600"})


# pages made of files: their own scripts only, nothing from elsewhere and nothing sent anywhere
SEALED = "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src data: blob:; worker-src blob:; frame-ancestors 'self'"


def sent(console: Console, *parts: str) -> FileResponse:
    """A file of the session, by its ending; others are not sent."""
    path = console.file(*parts)
    kind = SENT.get(path.suffix.lower())
    if kind is None or path.name.startswith("."):
        raise HTTPException(404, "this kind of file is not sent")
    headers = {"content-security-policy": SEALED, "cache-control": "no-store"}
    return FileResponse(
        path,
        media_type=kind,
        headers=headers,
        filename=path.name,
        content_disposition_type="inline" if kind.startswith("text/html") else "attachment",
    )


def told(content: dict[str, Any]) -> dict[str, Any]:
    """What JSON has: NaN and infinities become null."""
    return {str(key): _plain(value) for key, value in content.items()}


def _plain(value: Any) -> Any:
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, dict):
        return told(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
