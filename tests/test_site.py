"""The documents as a site: pages and pictures are those that the code makes, and a browser shows them all."""

from __future__ import annotations

import json
import os
import queue
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from commands import pneud
from generators import firmware, pictures
from generators.pages import FOLDER, MADE
from pages import ROOT, steps

WIDTHS = (375, 900, 1600)
CHECKED = ("index.html", "tutorial.html", "firmware.html")  # by axe-core, too
LOOKED_AT = (*CHECKED, "configuration.html", "gallery.html", "cli.html", "paper.html", "api.html")
SCHEMES = ("default", "slate")
PATIENCE_S = 240.0
View = tuple[int, str]  # width [px], scheme

# loads each page in a frame, and reports for each width and scheme what does not fit, and what axe-core finds
WATCH = """
<!doctype html><meta charset="utf-8"><body><script>
const pause = ms => new Promise(done => setTimeout(done, ms));
async function look(page, views) {
  const frame = document.createElement("iframe");
  frame.style = "border: 0; width: 900px; height: 900px";
  frame.src = page;
  document.body.append(frame);
  await new Promise(done => frame.addEventListener("load", done));
  const inside = frame.contentDocument;
  inside.head.insertAdjacentHTML("beforeend", "<style>* { transition: none !important }</style>");
  const empty = image => !image.complete || !image.naturalWidth;
  const broken = [...inside.images].filter(empty).map(image => image.src);
  const seen = [];
  for (const [width, scheme] of views) {
    frame.style.width = `${width}px`;
    inside.body.setAttribute("data-md-color-scheme", scheme);
    await pause(150);
    const violations = AXE ? await check(frame) : [];
    seen.push({ page, width, scheme, wide: inside.documentElement.scrollWidth, broken, violations });
  }
  frame.remove();
  return seen;
}
async function check(frame) {
  if (!frame.contentWindow.axe) {
    const script = frame.contentDocument.createElement("script");
    script.textContent = AXE;
    frame.contentDocument.head.append(script);
  }
  const all = await frame.contentWindow.axe.run(frame.contentDocument, { resultTypes: ["violations"] });
  return all.violations.filter(({ impact }) => ["serious", "critical"].includes(impact))
    .map(({ id, nodes }) => [id, nodes.length, nodes[0].html.slice(0, 200), (nodes[0].any[0] || {}).message]);
}
const tell = found => fetch("/found", { method: "POST", body: JSON.stringify(found) });
(async () => {
  const found = [];
  for (const page of PAGES) found.push(...await look(page, VIEWS));
  await tell(found);
})().catch(error => tell({ error: String(error) }));
</script>
"""


@pytest.mark.parametrize("name", MADE)
def test_a_page_is_what_the_code_makes(name: str) -> None:
    assert (FOLDER / name).read_text(encoding="utf-8") == MADE[name](), "make pages makes it anew"


def test_the_checksum_in_c_is_that_of_the_vectors(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler here")
    text = firmware.text()
    code = "".join(step.text for step in steps(FOLDER / "firmware.md") if step.kind == "c")
    frames = re.findall(r"^\| `(\w{3})` \| `((?:\w\w ){7}\w\w)` \|", text, re.MULTILINE)
    assert len(frames) == 8
    lines = []
    for identifier, data in frames:
        values = ", ".join(f"0x{byte}" for byte in data.split())
        lines.append(f"{{ uint8_t f[] = {{ {values} }}; wrong += pneud_crc(0x{identifier}, f, 7) != f[7]; }}")
    others = re.findall(r"^\| `(e2e-p0\d)` \| (?:both)? \| (.*) \|", text, re.MULTILINE)
    assert len(others) == 3
    ids = "static const uint8_t ids[] = { 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16 };"
    of = {"e2e-p01": "0x123, ", "e2e-p02": "ids, ", "e2e-p05": "0x1234, "}
    for name, shown in others:
        for data in re.findall(r"`([^`]+)`", shown):
            values = ", ".join(f"0x{byte}" for byte in data.split())
            found = "(f[0] | f[1] << 8)" if name == "e2e-p05" else "f[0]"
            call = f"{name.replace('-', '_')}({of[name]}f, 8)"
            lines.append(f"{{ uint8_t f[] = {{ {values} }}; wrong += {call} != {found}; }}")
    assert len(lines) == 17
    lines.insert(0, ids)
    (tmp_path / "t.c").write_text(
        f"{code}int main(void) {{ int wrong = 0; {' '.join(lines)} return wrong; }}"
    )
    subprocess.run([compiler, "-Wall", "-Werror", "-o", "t", "t.c"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "t"], check=False).returncode == 0


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 120


def test_pictures_are_few_and_fetch_nothing() -> None:
    files = [*FOLDER.glob("*.svg"), *(FOLDER / "pictures").iterdir()]
    assert sum(file.stat().st_size for file in files) < 1_000_000
    for file in files:
        assert file.stat().st_size < 200_000, file
        assert file.suffix != ".svg" or "url(http" not in file.read_text(encoding="utf-8").replace('"', ""), (
            file
        )
    shown = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "README.md", *FOLDER.glob("*.md")))
    assert [file.name for file in files if file.name not in shown] == []


@pytest.mark.slow
def test_the_number_of_the_readme_is_what_its_command_prints() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    rms, most = re.findall(r"\*\*([\d.]+) mm RMS\*\* off, ([\d.]+) mm at most", text)[0]
    (command,) = (step.text for step in steps(ROOT / "README.md") if step.text.startswith("pneud sim"))
    done = pneud(*command.split()[1:])
    assert f"tracking error {rms} mm RMS, {most} mm max" in done.stdout
    assert f"{rms} mm RMS" in (FOLDER / "index.md").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("name", pictures.TERMINALS)
def test_a_terminal_shows_what_its_picture_does(name: str, tmp_path: Path) -> None:
    kept = (FOLDER / "pictures" / f"{name}.svg").read_text(encoding="utf-8")
    assert kept == pictures.terminal(name, tmp_path), "make pictures makes it anew"


@pytest.mark.slow
@pytest.mark.parametrize("name", pictures.PAGES)
def test_a_picture_of_a_page_can_be_made_anew(name: str, tmp_path: Path) -> None:
    if pictures.browser() is None:
        pytest.skip("no Chromium here: apt install chromium")
    pictures.drawn(pictures.PAGES[name], tmp_path, tmp_path / "picture.png")
    kept = (FOLDER / "pictures" / f"{name}.png").stat().st_size
    assert 0.7 * kept < (tmp_path / "picture.png").stat().st_size < 1.4 * kept, "make pictures makes it anew"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, as `make docs` builds it."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs"]
    if subprocess.run([*command, "--version"], capture_output=True, check=False).returncode:
        pytest.skip("no mkdocs here: pip install 'pneud[docs]'")
    done = subprocess.run(
        [*command, "build", "--strict", "-d", folder], cwd=ROOT, capture_output=True, text=True, check=False,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_the_site_is_whole_and_fetches_nothing(site: Path) -> None:
    pages = {path.stem for path in site.glob("*.html")} - {"404"}
    assert pages == {path.stem for path in FOLDER.glob("*.md")}
    fetched = re.compile(r'<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)="?((?:https?:)?//[^" >]+)')
    for path in site.rglob("*.html"):
        assert fetched.findall(path.read_text(encoding="utf-8")) == [], path
    for path in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?(https?:)?//", path.read_text(encoding="utf-8")), path


class Watcher(SimpleHTTPRequestHandler):
    """Serves the site and the page that looks at it, and takes what that has found."""

    def __init__(self, *args: Any, watch: str, found: queue.Queue[Any], **more: Any) -> None:
        self.watch, self.found = watch, found
        super().__init__(*args, **more)

    def do_GET(self) -> None:
        if self.path != "/watch":
            super().do_GET()
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(self.watch.encode())

    def do_POST(self) -> None:
        self.found.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        pass


def axe() -> str:
    """The source of axe-core."""
    for folder in filter(None, os.environ.get("NODE_PATH", "").split(":")):
        if (source := Path(folder) / "axe-core" / "axe.min.js").is_file():
            return source.read_text(encoding="utf-8")
    return ""


def looked(site: Path, pages: Iterable[str], views: list[View], profile: Path) -> Iterator[dict[str, Any]]:
    """What a browser has found on pages in some views; with axe-core where that is there."""
    browser = pictures.browser()
    if browser is None:
        pytest.skip("no Chromium here: apt install chromium")
    script = f"const PAGES = {json.dumps(pages)}, VIEWS = {json.dumps(views)}, AXE = {json.dumps(axe())};"
    watch = WATCH.replace("<script>", "<script>" + script.replace("</", "<\\/"), 1)
    found: queue.Queue[Any] = queue.Queue()
    handler = partial(Watcher, directory=str(site), watch=watch, found=found)
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        process = subprocess.Popen(
            [browser, *pictures.QUIET, f"--user-data-dir={profile}", "--window-size=1700,1000",
             "--remote-debugging-port=0", f"http://127.0.0.1:{server.server_port}/watch"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            answer = found.get(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.wait()
            server.shutdown()
    assert isinstance(answer, list), answer
    yield from answer


@pytest.mark.slow
def test_every_page_fits_into_every_window(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NODE_PATH", raising=False)
    for seen in looked(site, LOOKED_AT, [(w, s) for w in WIDTHS for s in SCHEMES], tmp_path):
        assert seen["wide"] <= seen["width"], seen
        assert seen["broken"] == [], seen


@pytest.mark.slow
def test_pages_can_be_read_by_all(site: Path, tmp_path: Path) -> None:
    if not axe():
        pytest.skip("no axe-core: npm install it somewhere and set NODE_PATH")
    for seen in looked(site, CHECKED, [(375, "default"), (1600, "slate"), (1600, "default")], tmp_path):
        assert seen["violations"] == [], seen
