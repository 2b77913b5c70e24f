"""What all pages share: head, navigation, state, and small pieces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any

from nicegui import ui

from calibration.errors import ScopeError
from scope.console.console import Console

PAGES = (
    ("Live", "/"),
    ("Calibrate", "/calibrate"),
    ("Scan", "/scan"),
    ("Measure", "/measure"),
    ("History", "/history"),
)
_STYLE = """
:root{--good:#1f8a4c;--warn:#a86a00;--bad:#c0342c;--line:#d5dae1;--soft:#f4f6f8;--text:#1c2430;--muted:#55606e;--page:#fff;--link:#1f5fa8}
body.body--dark{--good:#4cc27d;--warn:#e0a53a;--bad:#ff7b72;--line:#343d49;--soft:#1b2129;--text:#e4e9f0;--muted:#a3adba;--page:#12161c;--link:#7db4f0}
body{color:var(--text);background:var(--page);font:15px/1.5 system-ui,sans-serif}
.nicegui-content{padding:0}
.bar{position:sticky;top:0;z-index:10;display:flex;flex-wrap:wrap;align-items:center;gap:.2rem .9rem;width:100%;padding:.5rem 1rem;border-bottom:1px solid var(--line);background:var(--page)}
.bar b{font-size:1.05rem;letter-spacing:.03em}.bar nav{display:flex;flex-wrap:wrap;gap:.1rem}
.bar a{color:var(--text);text-decoration:none;padding:.3rem .6rem;border-radius:6px}.bar a:hover{background:var(--soft)}
.bar a[aria-current=page]{background:var(--link);color:var(--page);font-weight:600}
.state{margin-left:auto;color:var(--muted);font-size:.9rem}
.page{width:100%;max-width:82rem;margin:0 auto;padding:.8rem 1rem 2rem;gap:.8rem}
.two{display:grid;grid-template-columns:minmax(0,1fr);gap:1rem;width:100%}
@media(min-width:64rem){.two{grid-template-columns:minmax(0,1.9fr) minmax(18rem,1fr)}}
.box{border:1px solid var(--line);border-radius:8px;padding:.8rem 1rem;width:100%;min-width:0;overflow-x:clip}
.head{font-size:1.05rem;font-weight:650;margin:0 0 .4rem;line-height:1.3}
.seen{width:100%;height:auto;display:block;background:#10151c;border-radius:8px;min-height:8rem;cursor:crosshair}
.seen:focus-visible,.bar a:focus-visible,button:focus-visible{outline:3px solid var(--link);outline-offset:2px}
.told{border-left:5px solid var(--line);padding:.4rem .8rem;background:var(--soft);border-radius:3px;width:100%;overflow-wrap:anywhere}
.told.good{border-color:var(--good)}.told.warn{border-color:var(--warn)}.told.bad{border-color:var(--bad)}
.figures{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}.figures td,.figures th{padding:.2rem .4rem;border-bottom:1px solid var(--line);text-align:right;vertical-align:top}.figures td.words,.figures th.words{text-align:left}
.figures td:first-child,.figures th:first-child{text-align:left;color:var(--muted);font-weight:400}.figures th{font-weight:600}
.lamp{display:inline-block;width:.9rem;height:.9rem;border-radius:50%;border:2px solid var(--muted);flex:none}
.lamp.good{background:var(--good);border-color:var(--good)}.lamp.taken{background:linear-gradient(90deg,var(--good) 50%,transparent 50%);border-color:var(--good)}
.lamp.poor{background:var(--bad);border-color:var(--bad)}.lamp.skipped{border-style:dashed}
.muted{color:var(--muted);font-size:.9rem}.wide{overflow-x:auto;width:100%}
scope-cloud{display:block;width:100%}.left .figures{min-width:52rem}
.viewer{width:100%;height:min(70vh,40rem);border:1px solid var(--line);border-radius:8px;background:#10151c}
.step{display:flex;flex-wrap:wrap;gap:.4rem .8rem;align-items:center;width:100%;padding:.5rem 0;border-bottom:1px solid var(--line)}
.step .what{flex:1 1 14rem;min-width:0;overflow-wrap:anywhere}
.chips{display:flex;flex-wrap:wrap;gap:.2rem .5rem}.chip{font-size:.82rem}.chip.good{color:var(--good)}.chip.bad{color:var(--bad);font-weight:600}
.fields{display:flex;flex-wrap:wrap;gap:.6rem .8rem;align-items:flex-start;width:100%;margin:.3rem 0}.fields>.q-btn,.fields>.q-btn-group{min-height:40px}.step .q-btn{min-width:3.6rem;min-height:34px}.q-btn-group .q-btn{padding:4px 10px}.fields>.q-checkbox{min-height:40px}
.q-uploader__list,.q-uploader__subtitle{display:none}.q-uploader{max-height:none}.left td,.left th{text-align:left!important}
.growing{height:15rem;object-fit:contain}.box>.told{margin-top:.5rem}.page a:not(.q-btn){color:var(--link)}
body.body--dark .q-btn--flat,body.body--dark .q-btn--outline{color:var(--link)!important}
@media(max-width:30rem){.bar nav{gap:0}.bar nav a{padding:.3rem .4rem;font-size:.93rem}.state{margin-left:0;width:100%;font-size:.82rem}.page{padding:.8rem .7rem 2rem}}
"""
_LIVE = """
<script>
(() => {
  let after = 0;
  const pause = ms => new Promise(done => setTimeout(done, ms));
  const next = async () => {
    const image = document.getElementById("live");
    if (!image || document.hidden) { await pause(200); return next(); }
    try {
      const answer = await fetch("/frame.jpg?after=" + after, {cache: "no-store"});
      if (answer.status === 200) {
        after = Number(answer.headers.get("x-frame"));
        const old = image.src, address = URL.createObjectURL(await answer.blob());
        image.onload = () => { if (old.startsWith("blob:")) URL.revokeObjectURL(old); image.dataset.frame = after; };
        image.src = address;
      } else { await pause(300); }
    } catch (error) { await pause(1000); }
    await pause(5);
    return setTimeout(next, 0);
  };
  next();
})();
</script>
"""


@contextmanager
def framed(console: Console, name: str) -> Iterator[None]:
    """A page with its head; what is made inside stands in its body."""
    ui.page_title(f"{name} - SCOPE")
    ui.add_css(_STYLE)
    ui.colors(primary="#1f5fa8", positive="#1f8a4c", negative="#c0342c", warning="#a86a00")
    with ui.element("header").classes("bar"):
        ui.html("<b>SCOPE</b>", sanitize=False)
        with ui.element("nav").props('aria-label="pages"'):
            for title, place in PAGES:
                link = ui.link(title, place)
                if title == name:
                    link.props('aria-current="page"')
        state = ui.label().classes("state").props('role="status"')
    with ui.column().classes("page"):
        trouble = ui.label().classes("told bad").props('role="alert"')
        yield

    def refresh() -> None:
        status = console.station.status
        job = console.jobs.running
        size = status.get("size")
        parts = [str(status.get("model", "no camera"))]
        if size:
            parts.append(f"{size[0]} x {size[1]} px")
        parts.append(f"{status['rate']:.0f} frames/s")
        if status.get("dropped"):
            parts.append(f"{status['dropped']} lost")
        if job is not None:
            parts.append(f"{job.kind} {job.done}" + (f" of {job.total}" if job.total else ""))
        state.set_text(" · ".join(parts))
        trouble.set_text(status["trouble"])
        trouble.set_visibility(bool(status["trouble"]))

    refresh()
    ui.timer(0.7, refresh)


EMPTY = "data:image/gif;base64,R0lGODlhAQABAIAAAAAAAP///yH5BAEAAAAALAAAAAABAAEAAAIBRAA7"  # until there is one


def live_image() -> Any:
    """The camera's image, asked for again as soon as it has come."""
    image = (
        ui.element("img").classes("seen").props(f'id="live" alt="live image of the camera" tabindex="0" src="{EMPTY}"')
    )
    ui.add_body_html(_LIVE)
    return image


def cloud_viewer(name: str, *, region: bool = False) -> Any:
    """The viewer of the reports with the cloud of a scan; the page has its script in the head."""
    return ui.element("scope-cloud").props(
        f'src="/cloud/{name}.bin" label="cloud of {name}"{" region" if region else ""}'
    )


def figures(rows: dict[str, str] | Sequence[tuple[str, ...]], head: tuple[str, ...] = ()) -> str:
    """Rows as an HTML table; every cell is escaped."""
    lines: Sequence[tuple[str, ...]] = list(rows.items()) if isinstance(rows, dict) else rows
    worded = [bool(lines) and _is_words(str(cell)) for cell in lines[0]] if lines else []
    top = "".join(
        f"<th{' class=words' if said else ''}>{escape(cell)}</th>" for cell, said in zip(head, worded, strict=False)
    )
    top = f"<tr>{top}</tr>" if top else ""
    body = "".join("<tr>" + "".join(_cell(str(cell)) for cell in row) + "</tr>" for row in lines)
    return f'<div class="wide"><table class="figures">{top}{body}</table></div>'


def _is_words(text: str) -> bool:
    return len(text) > 24 or (text[:1].isalpha() and " " in text)


def _cell(text: str) -> str:
    return f"<td{' class=words' if _is_words(text) else ''}>{escape(text)}</td>"


def table(content: str = "") -> Any:
    """Element for the text of `figures`."""
    return ui.html(content, sanitize=False).classes("w-full")


@contextmanager
def box(title: str = "") -> Iterator[Any]:
    """A bordered part of a page."""
    with ui.element("section").classes("box") as part:
        if title:
            ui.label(title).props('role="heading" aria-level="2"').classes("head")
        yield part


def told(text: str, level: str = "") -> Any:
    """A line in a box: good, warn, bad or plain."""
    return ui.label(text).classes(f"told {level}")


def say(work: Callable[[], Any]) -> Any:
    """Run work; what is refused is told on the page. None where it was."""
    try:
        return work()
    except (ScopeError, ValueError) as error:
        _warn(error)
        return None


def chart(kind: str, x: str, y: str, *, height: str = "13rem") -> Any:
    """A small plot whose series are set as they come."""
    axis = {
        "nameLocation": "middle",
        "nameTextStyle": {"color": "#8793a3"},
        "axisLabel": {"color": "#8793a3"},
        "splitLine": {"lineStyle": {"color": "#8793a333"}},
    }
    return ui.echart(
        {
            "animation": False,
            "grid": {"left": 56, "right": 12, "top": 12, "bottom": 40},
            "xAxis": {"type": "value", "name": x, "nameGap": 24, "scale": True, **axis},
            "yAxis": {
                "type": "log" if kind == "bar" else "value",
                "min": 1 if kind == "bar" else None,
                "name": y,
                "nameGap": 42,
                "scale": kind != "bar",
                **axis,
            },
            "series": [
                {
                    "type": kind,
                    "data": [],
                    "symbolSize": 3,
                    "barWidth": "99%",
                    "itemStyle": {"color": "#3d8fd1"},
                    "markLine": {"symbol": "none", "data": []},
                }
            ],
        }
    ).style(f"height:{height};width:100%")


@contextmanager
def refused() -> Iterator[None]:
    """Tell on the page what work that is waited for was refused for."""
    try:
        yield
    except (ScopeError, ValueError) as error:
        _warn(error)


def _warn(error: Exception) -> None:
    ui.notify(" ".join(str(error).split()), type="negative", multi_line=True, close_button="close", timeout=12000)
