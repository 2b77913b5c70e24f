"""Windows is not tested here; what only POSIX knows is kept out by looking for it (README says so)."""

from __future__ import annotations

import ast
import re
import subprocess
from pathlib import Path, PureWindowsPath

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(path for room in ("scope", "calibration", "ranging", "cli") for path in (ROOT / room).rglob("*.py"))
MODULES = {"fcntl", "pwd", "grp", "resource", "termios", "tty", "pty", "posix", "syslog", "curses", "crypt"}
CALLS = {
    "os": {"fork", "forkpty", "getuid", "geteuid", "getgid", "getpgid", "setsid", "setpgid", "killpg", "mkfifo", "chown", "fchown", "fchmod",
           "nice", "uname", "statvfs", "getloadavg", "openpty", "wait3", "WNOHANG", "O_DIRECTORY", "O_NOFOLLOW", "sched_getaffinity"},
    "signal": {"SIGKILL", "SIGHUP", "SIGALRM", "SIGUSR1", "SIGUSR2", "SIGQUIT", "SIGCHLD", "SIGPIPE", "setitimer", "alarm", "pthread_kill", "pause"},
}  # fmt: skip
PLACES = re.compile(r"^/(dev|tmp|proc|sys|etc|usr|var|home)\b")
ALLOWED = {"scope/cameras/v4l2.py"}  # lists cameras of Linux, and none where there is no such folder


def only_posix(source: str) -> list[str]:
    """What a source asks of the system that Windows does not have."""
    found = []
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names=names):
                found += [name.name for name in names if name.name.split(".")[0] in MODULES]
            case ast.ImportFrom(module=str(module), names=names, level=0):
                found += [module] if module.split(".")[0] in MODULES else []
                found += [f"{module}.{name.name}" for name in names if name.name in CALLS.get(module, set())]
            case ast.Attribute(value=ast.Name(id=owner), attr=name) if name in CALLS.get(owner, set()):
                found.append(f"{owner}.{name}")
            case ast.Attribute(attr="add_signal_handler"):
                found.append("add_signal_handler")
            case ast.keyword(arg="shell", value=ast.Constant(value=True)):
                found.append("shell=True")
            case ast.Constant(value=str(text)) if PLACES.match(text):
                found.append(text)
    return found


def test_no_path_lock_or_signal_that_only_posix_knows() -> None:
    told = {str(path.relative_to(ROOT)): only_posix(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert {name: what for name, what in told.items() if what and name not in ALLOWED} == {}


def test_what_only_posix_knows_is_seen() -> None:
    bad = 'import fcntl\nfrom os import fork\nos.killpg(1, signal.SIGKILL)\nopen("/tmp/x")\nrun(x, shell=True)\nimport importlib.resources\n'
    assert sorted(only_posix(bad)) == ["/tmp/x", "fcntl", "os.fork", "os.killpg", "shell=True", "signal.SIGKILL"]  # noqa: S108


def test_every_file_has_a_name_that_windows_takes() -> None:
    names = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    bad = [name for name in names if re.search(r'[<>:"|?*\\]|[. ]$', name) or PureWindowsPath(name).is_reserved()]
    assert bad == []
    folded = [name.lower() for name in names]
    assert len(set(folded)) == len(folded)


def test_readme_says_that_windows_is_untested() -> None:
    assert re.search(r"Windows[^.]*untested", (ROOT / "README.md").read_text(encoding="utf-8"))
