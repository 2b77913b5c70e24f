"""The console as a process: a camera at its rate with a page open, broken off at random moments, and called by the hostile.

python -m benchmarks.console live --rate 30        a real-time camera of rendered frames: every frame kept and ranged, a page open in Chromium
python -m benchmarks.console kill --times 20       browser closed, process killed, disk full, camera gone, while calibrating and scanning
python -m benchmarks.console hostile               300 requests and more, and markup in every name
python -m benchmarks.console first                 from the command to the first picture
"""

from __future__ import annotations

import argparse
import http.client
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from benchmarks.cameras import ROOT, SLOW, free_port
from benchmarks.small_session import design_text

# The console with a camera that may be unplugged (a file `gone` beside the session), or that exposes by the clock.
GONE = """
import sys
from pathlib import Path
from scope.cameras.simulated import SimulatedCamera
from scope.errors import CameraError
read, plug = SimulatedCamera.read, Path(sys.argv.pop(1))
def gone(self):
    if plug.exists():
        raise CameraError("camera simulated: gave no frame for 5 s; check cable, power and trigger")
    return read(self)
SimulatedCamera.read = gone
from cli.main import main
main()
"""
CLOCKED = """
import sys
from pathlib import Path
import scope.console.station as station
from benchmarks.cameras import RealTime
from scope.session import image_files, read_image
folder, rate = sys.argv.pop(1), float(sys.argv.pop(1))
images = [read_image(path) for path in image_files(Path(folder))]
station.open_camera = lambda settings, again=False: RealTime(images, rate, 10**9)
from cli.main import main
main()
"""


def load() -> str:
    """How busy the machine is besides."""
    return f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"


def started(
    session: Path, *words: str, program: str = "from cli.main import main; main()", before: tuple[str, ...] = ()
) -> tuple[subprocess.Popen[bytes], str, float]:
    """Console, its address, and s until the first picture."""
    port = free_port()
    began = time.perf_counter()
    command = [
        sys.executable,
        "-c",
        program,
        *before,
        "console",
        "--session",
        str(session),
        "--no-show",
        "--port",
        str(port),
        "-q",
        *words,
    ]
    process = subprocess.Popen(
        command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while time.perf_counter() - began < 240 and process.poll() is None:
        with suppress(OSError, http.client.HTTPException):
            connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
            connection.request("GET", "/frame.jpg", headers=_token(words))
            if connection.getresponse().status == 200:
                return process, f"http://127.0.0.1:{port}", time.perf_counter() - began
        time.sleep(0.05)
    raise SystemExit("the console does not start")


def _token(words: tuple[str, ...]) -> dict[str, str]:
    return {"Authorization": f"Bearer {words[words.index('--token') + 1]}"} if "--token" in words else {}


def asked(link: str, path: str, body: dict[str, Any] | None = None) -> Any:
    """JSON of an answer."""
    data = None if body is None else json.dumps(body).encode()
    request = urllib.request.Request(link + path, data, {"Content-Type": "application/json"})  # noqa: S310
    with urllib.request.urlopen(request, timeout=120) as answer:  # noqa: S310
        return json.load(answer)


@contextmanager
def chromium() -> Iterator[Any]:
    """Debian's Chromium by its driver."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or "chromium"
    for word in ("--headless=new", "--no-sandbox", "--window-size=1280,900"):
        options.add_argument(word)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        yield browser
    finally:
        browser.quit()


def designed(home: Path, columns: int, rows: int) -> Path:
    """The benchmark's rig in a file."""
    (home / "design.toml").write_text(design_text(size=(columns, rows), **SLOW), encoding="utf-8")
    return home / "design.toml"


def live(rate: float, frames: int, size: tuple[int, int]) -> None:
    """Frames kept as PNG and ranged while the page Live shows them; beside what the machine can render."""
    from scope.calibrating import calibrate
    from scope.simulation import simulate

    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        design = designed(home, *size)
        began = time.perf_counter()
        simulate(design, home / "s")
        rendered = time.perf_counter() - began
        session = home / "session"
        session.mkdir()
        calibrate(home / "s" / "calibration.toml").rig.save(session / "rig.json")
        process, link, _ = started(
            session, "--camera", "v4l2", program=CLOCKED, before=(str(home / "s" / "frames"), str(rate))
        )
        try:
            with chromium() as browser:
                browser.get(link)
                motion = {"kind": "linear", "moves": "object", "direction": [0.0, 1.0, 0.0], "step": 0.5}
                for job, count in (("warm", 40), ("run", frames)):
                    asked(link, "/api/v1/scan", {"job": job, "motion": motion, "frames": count})
                    shown = Counter[str]()
                    while (state := asked(link, f"/api/v1/job/{job}"))["state"] == "running":
                        with suppress(Exception):
                            shown[
                                str(browser.execute_script("return document.getElementById('live').dataset.frame"))
                            ] += 1
                        time.sleep(0.05)
                    if job == "run":
                        found = state
        finally:
            process.kill()
        result = found["result"]
        came = len(list((session / "scans" / "run" / "frames").iterdir()))
        print(f"console with a page, {size[0]} x {size[1]} at {rate:g}/s: {result.get('frames')} of {frames} frames ranged, {came} kept, dropped: "
              f"{result.get('why_incomplete') or found['message'] or 'none'}; the page showed {len(shown)} pictures; the machine renders {48 / rendered:.1f}/s (with the jig); {load()}")  # fmt: skip


# --- broken off ------------------------------------------------------------------------------------------------------

CAUSES = ("browser closed", "process killed", "disk full", "camera gone")


class Broken:
    """One session that is broken off, in a file system of its own of a few MB."""

    def __init__(self, home: Path, browser: Any, rng: random.Random) -> None:
        self.home, self.browser, self.rng = home, browser, rng
        self.disk = home / "disk"
        self.disk.mkdir()
        mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(self.disk)], check=False)
        self.own_disk = mounted.returncode == 0
        self.session = self.disk / "session"
        self.session.mkdir()

    def close(self) -> None:
        """Give the file system back."""
        if self.own_disk:
            subprocess.run(["umount", "-l", str(self.disk)], check=False)

    def strike(self, cause: str, process: subprocess.Popen[bytes]) -> None:
        """Let it happen."""
        if cause == "browser closed":
            self.browser.switch_to.new_window("tab")
            old, new = self.browser.window_handles[-2:]
            self.browser.switch_to.window(old)
            self.browser.close()
            self.browser.switch_to.window(new)
        elif cause == "process killed":
            process.send_signal(signal.SIGKILL)
            process.wait()
        elif cause == "disk full":
            with suppress(OSError), (self.disk / "filler").open("wb", buffering=0) as stream:
                while True:
                    stream.write(b"\0" * 4096)
        else:
            (self.home / "gone").touch()

    def mend(self) -> None:
        """As it was before."""
        (self.disk / "filler").unlink(missing_ok=True)
        (self.home / "gone").unlink(missing_ok=True)


def kill(times: int, seed: int) -> None:
    """Each of the four at random moments of taking stand-offs and of scanning; then the folder is used by the commands' functions."""
    from scope.calibrating import calibrate
    from scope.simulation import simulate

    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        home = Path(name)
        design = designed(home, 640, 480)
        simulate(design, home / "s")
        calibrate(home / "s" / "calibration.toml").rig.save(home / "rig.json")
        usable: Counter[str] = Counter()
        of: Counter[str] = Counter()
        worst = 0
        for k in range(times):
            cause, phase = CAUSES[k % 4], ("scanning", "calibrating")[(k // 4) % 2]
            place = home / f"run{k}"
            place.mkdir()
            broken = Broken(place, browser, rng)
            if cause == "disk full" and not broken.own_disk:
                print("no file system of its own can be mounted here: a full disk is left out")
                continue
            of[cause] += 1
            try:
                process, link, _ = started(
                    broken.session, "--simulate", str(design), program=GONE, before=(str(place / "gone"),)
                )
                try:
                    told = (_scanned if phase == "scanning" else _taken)(broken, process, link, cause, home)
                finally:
                    process.kill()
                    process.wait()
                broken.mend()
                lost = (_scan_used if phase == "scanning" else _steps_used)(broken, told, design)
                usable[cause] += 1
                worst = max(worst, lost)
                print(f"{k + 1}: {cause}, {phase}: {lost} frames lost; {load()}", flush=True)
            except Exception as error:  # noqa: BLE001  (a session that cannot be used is what is counted)
                print(f"{k + 1}: {cause}, {phase}: NOT USABLE: {type(error).__name__}: {str(error)[:300]}", flush=True)
            finally:
                broken.close()
        print(
            f"broken off {sum(of.values())} times: usable {dict(usable)} of {dict(of)}; at most {worst} frames lost; {load()}"
        )


def _scanned(broken: Broken, process: subprocess.Popen[bytes], link: str, cause: str, home: Path) -> int:
    """Strike while it scans; how many frames the camera had given then."""
    shutil.copyfile(home / "rig.json", broken.session / "rig.json")
    broken.browser.get(link + "/scan")
    before = asked(link, "/api/v1/status")["camera"]["frames"]
    asked(link, "/api/v1/scan", {"job": "cut"})
    frames = broken.session / "scans" / "cut" / "frames"
    until, end = broken.rng.randint(1, 40), time.monotonic() + 240
    while time.monotonic() < end and len(list(frames.glob("*.png"))) < until:
        time.sleep(0.01)
    time.sleep(broken.rng.uniform(0.0, 0.3))
    broken.strike(cause, process)
    there = len(list(frames.glob("*.png")))
    if cause == "process killed":
        return there
    while time.monotonic() < end and asked(link, "/api/v1/job/cut")["state"] == "running":
        time.sleep(0.1)
    del before
    return 48 if cause == "browser closed" else there


def _scan_used(broken: Broken, told: int, design: Path) -> int:
    from scope.cloud import ScanCloud
    from scope.scanning import run_scan

    del design
    place = broken.session / "scans" / "cut"
    found = run_scan(place / "capture.toml", broken.session / "rig.json")
    numbers = sorted(int(path.stem) for path in (place / "frames").glob("*.png"))
    if numbers != list(range(len(numbers))) or found.frames != len(numbers):
        raise RuntimeError(f"frames {numbers}, {found.frames} ranged")
    if (place / "cloud.ply").is_file() and not len(ScanCloud.load(place / "cloud.ply")):
        raise RuntimeError("an empty cloud")
    return max(0, told - found.frames)


BUTTONS = "return [...document.querySelectorAll('button')].filter(b => b.innerText.trim() === arguments[0])"


def _taken(broken: Broken, process: subprocess.Popen[bytes], link: str, cause: str, home: Path) -> int:
    """Strike while stand-offs are taken; how many were told to be taken before."""
    del home
    browser = broken.browser
    browser.get(link + "/calibrate")
    done = broken.rng.randint(0, 2)
    for k in range(done + 1):
        end, again = time.monotonic() + 300, 0.0
        while len(browser.execute_script(BUTTONS, "take")) != 4 - k:
            if k and time.monotonic() > again:  # a click before the page's socket is open goes nowhere
                browser.execute_script(f"{BUTTONS}[0].click()", "take")
                again = time.monotonic() + 30.0
            if time.monotonic() > end:
                raise RuntimeError(f"no button: {browser.execute_script('return document.body.innerText')[:300]}")
            time.sleep(0.1)
    browser.execute_script(f"{BUTTONS}[0].click()", "take")
    time.sleep(broken.rng.uniform(0.0, 4.0))
    broken.strike(cause, process)
    if cause == "browser closed":
        time.sleep(15.0)  # what was asked for is still done
    elif cause != "process killed":
        time.sleep(8.0)
    return done


def _steps_used(broken: Broken, told: int, design: Path) -> int:
    """What is there is whole; what is missing is taken by the command's function, and calibrates."""
    from scope.calibrating import calibrate, take_missing
    from scope.session import read_image

    for path in broken.session.rglob("*.png"):
        read_image(path)
    whole = 0
    for plane in tomllib.loads((broken.session / "calibration.toml").read_text(encoding="utf-8"))["plane"]:
        counts = [len(list(broken.session.glob(plane[key]))) for key in ("images", "laser")]
        if any(count not in (0, 3) for count in counts):
            raise RuntimeError(f"{plane['name']}: {counts} images, neither none nor all")
        whole += counts == [3, 3]
    file = broken.session / "calibration.toml"
    file.write_text(
        f'{file.read_text(encoding="utf-8")}\n[camera]\ndriver = "simulated"\nid = "{design}"\n', encoding="utf-8"
    )
    take_missing(file, lambda _: True, lambda _: None)
    if not calibrate(file).passed:
        raise RuntimeError("does not pass")
    return max(0, told - whole)


# --- the hostile -----------------------------------------------------------------------------------------------------

TOKEN = "a-token-of-more-than-sixteen-characters"  # noqa: S105
MARK = "<img src=x onerror=document.title='hit'>"


def hostile_requests(host: str) -> Iterator[tuple[str, str, str, dict[str, str], bytes | None]]:
    """What is wrong, method, path, headers, body."""
    known = {"Authorization": f"Bearer {TOKEN}"}
    reads = ("/", "/scan", "/frame.jpg", "/growing.jpg", "/files/rig.json", "/files/calibration.toml", "/history.csv", "/viewer.js", "/api/v1/status",
             "/api/v1/result", "/api/v1/openapi.json", "/cloud/a.bin", "/_nicegui_ws/socket.io/?EIO=4&transport=polling")  # fmt: skip
    scan = json.dumps({"frames": 2}).encode()
    for name in ("evil.example", f"{host}.evil.example", "10.1.2.3", "localhost.evil.example:80", "evil@example"):
        yield from (("other Host", "GET", path, {**known, "Host": name}, None) for path in reads)
        yield "other Host", "POST", "/api/v1/scan", {**known, "Host": name}, scan
    for origin in ("https://evil.example", "null", "http://127.0.0.1:1", "file://", f"http://{host}.evil.example"):
        yield from (("other origin", "GET", path, {**known, "Origin": origin}, None) for path in reads)
        for path in ("/api/v1/scan", "/api/v1/stop", "/api/v1/pose"):
            yield "other origin", "POST", path, {**known, "Origin": origin}, scan
    for site, path in itertools.product(("cross-site", "same-site"), reads):
        yield "embedded elsewhere", "GET", path, {**known, "Sec-Fetch-Site": site, "Sec-Fetch-Mode": "no-cors"}, None
    for given in ({}, {"Authorization": f"Bearer {TOKEN[:-1]}"}, {"Authorization": f"Basic {TOKEN}"}, {"Cookie": "scope_token="},
                  {"Cookie": f"scope_token={TOKEN}x"}):  # fmt: skip
        yield from (("no token", "GET", path, given, None) for path in reads)
        yield "no token", "POST", "/api/v1/scan", given, scan
    tricks = (
        "..",
        "%2e%2e",
        "..%2f..%2fetc%2fpasswd",
        "%2e%2e%2frig.json",
        "..%5c..%5crig.json",
        "%00",
        ".live.toml",
        "-o",
        "a" * 5000,
        "%3Cscript%3E",
    )
    for root, trick in itertools.product(
        ("/files/", "/files/scans/", "/files/scans/a/", "/cloud/", "/api/v1/scan/", "/api/v1/job/"), tricks
    ):
        yield "path", "GET", f"{root}{trick}", known, None
    for size in (100_000, 1_000_000, 70_000_000):
        yield "huge body", "POST", "/api/v1/scan", {**known, "Content-Type": "application/json"}, b" " * size
    for body in (b"[" * 30000, b'{"job": "%s"}' % MARK.encode(), b'{"frames": 1e99}', b'{"motion": {"kind": "linear", "step": NaN}}', b'{"x": 1}',
                 b'{"motion": {"kind": "linear", "direction": [0, 1, 0], "log": "../../etc/passwd", "delay": 0}}', b"\xff\xfe", b"null"):  # fmt: skip
        for path in ("/api/v1/scan", "/api/v1/pose"):
            yield "body", "POST", path, {**known, "Content-Type": "application/json"}, body
    for model in ("../../etc/passwd", "/etc/passwd", MARK, "..\\x.stl", "a\0.stl"):
        yield (
            "name",
            "POST",
            "/api/v1/pose",
            {**known, "Content-Type": "application/json"},
            json.dumps({"model": model}).encode(),
        )


def hostile() -> None:
    """Against a real console with a token; then markup in every name, looked at in Chromium."""
    from scope.calibrating import calibrate
    from scope.simulation import simulate

    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        design = designed(home, 640, 480)
        session = home / "session"
        simulate(design, home / "s")
        calibrate(home / "s" / "calibration.toml").rig.save(home / "rig.json")
        _marked_session(session, home)
        process, link, _ = started(session, "--simulate", str(design), "--token", TOKEN)
        host = link.removeprefix("http://")
        try:
            before = _fingerprint(session)
            sent: Counter[str] = Counter()
            answered = []
            for why, method, path, headers, body in hostile_requests(host):
                status, got = _called(host, method, path, headers, body)
                sent[why] += 1
                if status < 400 and status != 0:
                    answered.append((why, method, path[:60], status, got[:60]))
            same = _fingerprint(session) == before
            print(f"hostile: {sum(sent.values())} requests ({', '.join(f'{n} {w}' for w, n in sent.items())}): {len(answered)} answered, "
                  f"the folder {'as before' if same else 'CHANGED'} {answered[:5]}")  # fmt: skip
            hits = 0
            with chromium() as browser:
                browser.get(f"{link}/?token={TOKEN}")
                for page in ("/", "/calibrate", "/scan", "/measure", "/history"):
                    browser.get(link + page)
                    time.sleep(3.0)
                    hits += browser.title == "hit" or bool(
                        browser.execute_script("return document.querySelector(\"img[src='x']\")")
                    )
            print(
                f"markup in names of planes, lasers, models, scans and records: {hits} of 5 pages took it for markup; {load()}"
            )
        finally:
            process.kill()


def _marked_session(session: Path, home: Path) -> None:
    """Every name that a file can bring is markup."""
    from scope.history import Journal, Record

    session.mkdir()
    text = (home / "s" / "calibration.toml").read_text(encoding="utf-8")
    for k, plane in enumerate(tomllib.loads(text)["plane"]):
        text = text.replace(f'name = "{plane["name"]}"', f'name = "{MARK}{k}"')
    (session / "calibration.toml").write_text(text, encoding="utf-8")
    shutil.copyfile(home / "rig.json", session / "rig.json")
    for folder, file in (
        ("models", f"{MARK}.stl"),
        (f"scans/{MARK}", "cloud.ply"),
        (f"scans/{MARK}2/frames", "000000.png"),
    ):
        (session / folder.replace("/onerror", "")).mkdir(parents=True, exist_ok=True)
        (session / folder / file).write_bytes(b"")
    Journal(session / "history.db").add(
        Record(MARK, True, {MARK: 1.0, "heldout_mm": 0.1}, rig=MARK, camera=MARK, file=MARK, who=MARK)
    )


def _fingerprint(session: Path) -> dict[str, int]:
    return {str(path): path.stat().st_size for path in session.rglob("*") if path.is_file()}


def _called(host: str, method: str, path: str, headers: dict[str, str], body: bytes | None) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(host, timeout=20)
    try:
        connection.putrequest(method, path, skip_host="Host" in headers)
        for name, value in headers.items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders()
        if body is not None:
            with suppress(OSError):
                connection.send(body)
        answer = connection.getresponse()
        return answer.status, answer.read()
    except (OSError, http.client.HTTPException, ValueError):
        return 0, b""  # cut off
    finally:
        connection.close()


def first(times: int) -> None:
    """From the command to the first picture, the program's start included, beside `scope --help`."""
    design = ROOT / "examples" / "window-design.toml"
    took, helped = [], []
    for _ in range(times):
        with tempfile.TemporaryDirectory() as name:
            process, _, seconds = started(Path(name) / "session", "--simulate", str(design))
            process.kill()
            process.wait()
        took.append(seconds)
        began = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", "from cli.main import main; main()", "--help"],
            stdout=subprocess.DEVNULL,
            check=True,
            cwd=ROOT,
        )
        helped.append(time.perf_counter() - began)
    print(
        f"first picture {sorted(took)[len(took) // 2]:.1f} s after the command (least {min(took):.1f}); scope --help {min(helped):.1f} s; {load()}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["live", "kill", "hostile", "first"])
    parser.add_argument("--frames", type=int, default=900)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--size", type=int, nargs=2, default=(1280, 960))
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    match given.what:
        case "live":
            live(given.rate, given.frames, tuple(given.size))
        case "kill":
            kill(given.times, given.seed)
        case "hostile":
            hostile()
        case "first":
            first(min(given.times, 3))


if __name__ == "__main__":
    main()
