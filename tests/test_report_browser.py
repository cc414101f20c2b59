"""The report in a real browser: it draws every figure, and zoom and cursor are shared."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from mangled import simulated
from pneud.bench import chart
from pneud.bench.tables import in_words
from pneud.log.files.reader import read_log
from pneud.report.figures import FIGURES, TIMED
from pneud.report.gather import gather
from pneud.report.page import page
from pneud.study import comparison_page, paper_page
from pneud.study.comparison import LAWS
from test_bench import report
from test_campaign import campaign as campaign  # noqa: PLC0414  (a fixture)
from test_compare import table_of
from test_reproduction import reproduction

pytestmark = pytest.mark.slow

SHOWN = sum(any(curve.column not in TIMED for curve in f.series) for f in FIGURES)  # of simulated time
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
QUIET = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars"),
]

# collects errors, then drags across the second plot and moves the cursor over the fourth one
PROBE = """
<script>
const errors = [];
addEventListener("error", e => errors.push(e.message));
</script>"""
DRAG = """
<script>
addEventListener("load", () => setTimeout(() => {
  const overs = [...document.querySelectorAll(".plot .u-over")];
  const event = (over, kind, share, extra) => {
    const box = over.getBoundingClientRect();
    const where = { clientX: box.left + share * box.width, clientY: box.top + box.height / 2, bubbles: true };
    const event = new MouseEvent(kind, { ...where, button: 0, movementX: 9, view: window });
    (extra || over).dispatchEvent(event);
  };
  event(overs[1], "mouseenter", 0.5); event(overs[1], "mousemove", 0.5);
  event(overs[1], "mousedown", 0.5); event(overs[1], "mousemove", 0.75);
  event(overs[1], "mouseup", 0.75, document);
  setTimeout(() => {
    event(overs[3], "mouseenter", 0.5); event(overs[3], "mousemove", 0.5);
    setTimeout(() => {
      const times = [...document.querySelectorAll(".plot .u-legend .u-series:first-child .u-value")];
      const found = { errors, drawn: document.documentElement.dataset.drawn,
                      times: times.map(e => e.textContent).filter(t => t.endsWith(" s")) };
      const out = document.createElement("output"); out.id = "found"; out.textContent = JSON.stringify(found);
      document.body.append(out);
    }, 300);
  }, 300);
}, 300));
</script>"""

# tells of itself: colours in its canvases, width, and what axe-core (where it is) finds serious
TELL = """
<script>
addEventListener("load", () => setTimeout(async () => {
  const near = (data, i, [r, g, b]) =>
    Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 60 && data[i + 3] > 200;
  const canvases = [...document.querySelectorAll("canvas")].map(canvas => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let blue = 0, red = 0;
    for (let i = 0; i < data.length; i += 4) {
      blue += near(data, i, BLUE);
      red += near(data, i, RED);
    }
    return [blue, red];
  });
  const wide = document.documentElement.scrollWidth, paper = getComputedStyle(document.body).backgroundColor;
  const told = self.axe ? await axe.run(document, { resultTypes: ["violations"] }) : { violations: [] };
  const serious = told.violations.filter(v => ["serious", "critical"].includes(v.impact))
    .map(v => v.id + ": " + v.nodes.map(n => n.html.slice(0, 120)).slice(0, 3).join(" | "));
  const { drawn, closeups } = document.documentElement.dataset;
  parent.postMessage(JSON.stringify({ canvases, wide, paper, serious, drawn, closeups }), "*");
}, 700));
</script>"""
COLOURS = {False: ([0x00, 0x72, 0xB2], [0xD5, 0x5E, 0x00]), True: ([0x3E, 0xA6, 0xE6], [0xFF, 0x8B, 0x3D])}
FRAME = """<!doctype html><body style="margin:0">{frames}<script>
addEventListener("message", e => {{
  const out = document.createElement("output"); out.className = "found"; out.textContent = e.data;
  document.body.append(out);
}});</script>"""
INNER = '<iframe src="{n}.html" style="border:0;width:{width}px;height:900px"></iframe>'


def axe_core() -> str:
    """The source of axe-core; empty where it is not there."""
    for folder in filter(None, os.environ.get("NODE_PATH", "").split(os.pathsep)):
        if (path := Path(folder, "axe-core", "axe.min.js")).is_file():
            return path.read_text(encoding="utf-8")
    return ""


def tell(folder: Path, texts: Sequence[str], width: int, dark: bool) -> list[dict[str, Any]]:
    """What pages tell of themselves in frames of a width, which may be that of a telephone."""
    blue, red = COLOURS[dark]
    script = TELL.replace("BLUE", json.dumps(blue)).replace("RED", json.dumps(red))
    for n, text in enumerate(texts):
        inner = text.replace("</body>", f"<script>{axe_core()}</script>{script}</body>")
        (folder / f"{n}.html").write_text(inner)
    frames = "".join(INNER.format(n=n, width=width) for n in range(len(texts)))
    (folder / "outer.html").write_text(FRAME.format(frames=frames))
    theme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    options = (theme, "--virtual-time-budget=9000", f"--window-size={max(width, 600)},900", "--dump-dom")
    done = browse(folder, *options, f"file://{folder}/outer.html")
    found = re.findall(r'<output class="found">(.*?)</output>', done.stdout)
    assert len(found) == len(texts)
    return [json.loads(html.unescape(one)) for one in found]


def browse(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    if BROWSER is None:
        pytest.skip("no Chromium here: apt install chromium")
    return subprocess.run(
        [BROWSER, *QUIET, f"--user-data-dir={folder / 'profile'}", *options],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("logs")
    simulated(folder / "one.mcap", 3.0, seed=1)
    simulated(folder / "two.mcap", 2.0, seed=2)
    return page([gather(read_log(folder / f"{name}.mcap")) for name in ("one", "two")])


def test_zoom_and_cursor_are_shared(text: str, tmp_path: Path) -> None:
    probed = text.replace("<header>", f"{PROBE}<header>").replace("</body>", f"{DRAG}</body>")
    (tmp_path / "r.html").write_text(probed)
    done = browse(tmp_path, "--virtual-time-budget=6000", "--dump-dom", f"file://{tmp_path}/r.html")
    (found,) = re.findall(r'<output id="found">(.*?)</output>', done.stdout)
    state: dict[str, Any] = json.loads(html.unescape(found))
    assert state["errors"] == []
    plots = SHOWN + 1  # and the timeline
    assert int(state["drawn"]) >= plots + 1 + 6  # and the phase plot, and maps
    assert len(state["times"]) == plots
    times = [float(t.removesuffix(" s")) for t in state["times"]]
    # the middle of what was dragged over lies at five eighths of all the time
    (one, two) = re.findall(r"<td class=w>([\d.]+) s</td>", text)
    middle = 0.625 * max(float(one), float(two))
    assert all(abs(t - middle) < 0.2 for t in times), (times, middle)


SEEN = [(width, dark) for width in (375, 900, 1600) for dark in (False, True)]


@pytest.mark.parametrize(("width", "dark"), SEEN)
def test_every_figure_shows_its_lines(text: str, tmp_path: Path, width: int, dark: bool) -> None:
    """Both runs' colours are in every canvas, nothing is wider than the window, the page suits the system."""
    (state,) = tell(tmp_path, [text], width, dark)
    planes = int(state["drawn"]) - SHOWN - 2
    assert planes >= 6
    assert len(state["canvases"]) == SHOWN + 2 + planes
    figures = state["canvases"][1:]  # behind the timeline
    assert all(blue > 20 for blue, _ in figures), figures
    assert sum(red > 20 for _, red in figures) >= len(figures) - 2, figures
    assert state["wide"] <= width
    assert state["paper"] == ("rgb(20, 24, 29)" if dark else "rgb(255, 255, 255)")
    assert state["serious"] == []


@pytest.mark.parametrize(("width", "dark"), SEEN)
def test_one_log_with_a_fault_is_shown_close_up(tmp_path: Path, width: int, dark: bool) -> None:
    run = gather(read_log(Path(__file__).parent / "golden" / "supply-lost.mcap"))
    (state,) = tell(tmp_path, [page([run])], width, dark)
    assert state["closeups"] == "1"
    assert state["wide"] <= width
    assert state["serious"] == []


@pytest.mark.parametrize(("width", "dark"), SEEN)
def test_the_other_pages_suit_every_window(
    campaign: ModuleType, tmp_path: Path, width: int, dark: bool
) -> None:
    """Benchmark, campaign, paper and comparison."""
    measured = report()
    case: dict[str, Any] = {
        "name": "hose-burst", "description": "x " * 40, "reaction": "centre", "met": False, "faults": ["f"],
        "problems": ["31 mm of travel"], "centred_ms": 1.25, "ticks": 3, "travel_mm": 31.0,
    }  # fmt: skip
    texts = [
        chart.page(measured, in_words(measured)),
        campaign.page("unixcan", [case], {"bus-off": "takes a CAN interface"}, 9.0),
        paper_page.page(reproduction(), []),
        comparison_page.page(table_of(LAWS)),
    ]
    for state in tell(tmp_path, texts, width, dark):
        assert state["wide"] <= width
        assert state["paper"] == ("rgb(20, 24, 29)" if dark else "rgb(255, 255, 255)")
        assert state["serious"] == []


def test_axe_core_is_there() -> None:
    if not axe_core():
        pytest.skip("no axe-core: npm install axe-core@4 somewhere and set NODE_PATH")


def test_every_tick_is_drawn_where_one_looks_closely(tmp_path: Path) -> None:
    simulated(tmp_path / "long.mcap", 12.0, seed=3)
    run = gather(read_log(tmp_path / "long.mcap"), buckets=1024, closeup=1_000_000)
    look = """
<script>
addEventListener("load", () => setTimeout(() => {
  document.querySelector("button[data-from]").dataset.from = 6;
  document.querySelector("button[data-from]").dataset.to = 6.1;
  document.querySelector("button[data-from]").click();
  setTimeout(() => {
    const out = document.createElement("output");
    out.id = "found"; out.textContent = document.getElementById("resolution").textContent;
    document.body.append(out);
  }, 1500);
}, 500));
</script>"""
    (tmp_path / "r.html").write_text(page([run]).replace("</body>", f"{look}</body>"))
    done = browse(tmp_path, "--virtual-time-budget=8000", "--dump-dom", f"file://{tmp_path}/r.html")
    (found,) = re.findall(r'<output id="found">(.*?)</output>', done.stdout)
    assert found.startswith("Shown: every tick.")
    assert "Every tick is kept of 12" in found


def test_figures_are_saved_by_a_button(text: str, tmp_path: Path) -> None:
    save = """
<script>
addEventListener("load", () => setTimeout(async () => {
  const blobs = [];
  URL.createObjectURL = blob => { blobs.push(blob); return "#"; };
  for (const home of ["#plot-error", "#plane-spectrum", "#phase"])
    for (const button of document.querySelectorAll(home + " h3 button")) button.click();
  document.querySelector("#s-motions .wide + button").click();
  await new Promise(done => setTimeout(done, 1500));
  const out = document.createElement("output");
  out.id = "found";
  const told = b => b.type === "text/csv" ? b.text() : `${b.type} ${b.size}`;
  out.textContent = JSON.stringify(await Promise.all(blobs.map(told)));
  document.body.append(out);
}, 500));
</script>"""
    (tmp_path / "r.html").write_text(text.replace("</body>", f"{save}</body>"))
    done = browse(tmp_path, "--virtual-time-budget=8000", "--dump-dom", f"file://{tmp_path}/r.html")
    (found,) = re.findall(r'<output id="found">(.*?)</output>', done.stdout, re.DOTALL)
    saved = json.loads(html.unescape(found))
    tables = [one for one in saved if not one.startswith("image/png ")]
    assert [int(one.split()[1]) > 5000 for one in saved if one not in tables] == [True] * 3
    firsts = sorted(table.partition("\n")[0] for table in tables)
    assert firsts[0].startswith("line,Hz")
    assert firsts[1].startswith("log,motion,from [s],took [s]")
    assert firsts[2] == "log,position error [mm],velocity error [mm/s]"
    assert firsts[3] == "t [s],one: reference − position [mm],two: reference − position [mm]"
    assert all(len(table.splitlines()) > 2 for table in tables)


def test_it_prints(text: str, tmp_path: Path) -> None:
    (tmp_path / "r.html").write_text(text)
    browse(tmp_path, f"--print-to-pdf={tmp_path / 'r.pdf'}", f"file://{tmp_path}/r.html")
    pages = len(re.findall(rb"/Type\s*/Page\b", (tmp_path / "r.pdf").read_bytes()))
    assert 5 <= pages <= 40
