"""The report in a real browser: it draws every figure, and zoom and cursor are shared."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from mangled import simulated
from pneud.log.files.reader import read_log
from pneud.report.figures import FIGURES
from pneud.report.gather import gather
from pneud.report.page import page

pytestmark = pytest.mark.slow

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

LOOK = """
<script>
addEventListener("load", () => setTimeout(() => {
  const near = (data, i, [r, g, b]) =>
    Math.abs(data[i] - r) + Math.abs(data[i + 1] - g) + Math.abs(data[i + 2] - b) < 60 && data[i + 3] > 200;
  const canvases = [...document.querySelectorAll("canvas")].map(canvas => {
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let blue = 0, red = 0;
    for (let i = 0; i < data.length; i += 4) {
      blue += near(data, i, [0x00, 0x72, 0xb2]);
      red += near(data, i, [0xd5, 0x5e, 0x00]);
    }
    return [blue, red];
  });
  const out = document.createElement("output");
  out.id = "found";
  out.textContent = JSON.stringify({ canvases, wide: document.documentElement.scrollWidth });
  document.body.append(out);
}, 500));
</script>"""


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
    plots = len(FIGURES) + 1  # and the timeline
    assert int(state["drawn"]) == plots + 1  # and the phase plot
    assert len(state["times"]) == plots
    times = [float(t.removesuffix(" s")) for t in state["times"]]
    # the middle of what was dragged over lies at five eighths of all the time
    (one, two) = re.findall(r"([\d.]+) s at 1000 Hz", text)
    middle = 0.625 * max(float(one), float(two))
    assert all(abs(t - middle) < 0.2 for t in times), (times, middle)


@pytest.mark.parametrize("width", [1300, 520])
def test_every_figure_shows_its_lines(text: str, tmp_path: Path, width: int) -> None:
    """Both runs' colours are in every canvas, and nothing is wider than the window."""
    (tmp_path / "r.html").write_text(text.replace("</body>", f"{LOOK}</body>"))
    options = ("--virtual-time-budget=4000", f"--window-size={width},900", "--dump-dom")
    done = browse(tmp_path, *options, f"file://{tmp_path}/r.html")
    (found,) = re.findall(r'<output id="found">(.*?)</output>', done.stdout)
    state: dict[str, Any] = json.loads(html.unescape(found))
    assert len(state["canvases"]) == len(FIGURES) + 2
    figures = state["canvases"][1:]  # behind the timeline
    assert all(blue > 20 for blue, _ in figures), figures
    assert sum(red > 20 for _, red in figures) >= len(FIGURES) - 1, figures
    assert state["wide"] <= width


def test_it_prints(text: str, tmp_path: Path) -> None:
    (tmp_path / "r.html").write_text(text)
    browse(tmp_path, f"--print-to-pdf={tmp_path / 'r.pdf'}", f"file://{tmp_path}/r.html")
    pages = len(re.findall(rb"/Type\s*/Page\b", (tmp_path / "r.pdf").read_bytes()))
    assert 5 <= pages <= 40
