"""The documents name what is there: files, functions, commands with their options, targets of make."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
import typer

from pneud.cli import Named, app, verbs

ROOT = Path(__file__).parent.parent
DOCUMENTS = sorted(
    (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("hil/**/*.md"), *ROOT.glob("src/**/*.md"))
)
IDS = [str(path.relative_to(ROOT)) for path in DOCUMENTS]
TOP = ("configs", "docs", "examples", "hil", "src", "systemd", "tests", ".ci")
# under one of these a path in a document may stand as well, since the room is clear there
SHORT = ("src", "src/pneud", "src/pneud/control")
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))


def codes(text: str) -> Iterator[str]:
    """What stands between backticks, and lines of code."""
    yield from re.findall(
        r"`([^`\n]+(?:\n[^`\n]+)?)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    )
    yield from re.findall(r"^ {4}(\S.*)$", text, re.MULTILINE)


def paths(text: str) -> Iterator[str]:
    """Files and folders that a document names."""
    place = rf"({'|'.join(map(re.escape, TOP))})(/[\w.@*-]+)*/?"
    source = r"[\w-]+(/[\w.-]+)+\.(py|c|h)"
    yield from (code for code in codes(text) if re.fullmatch(f"{place}|{source}", code))


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_files_that_a_document_names_are_there(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    lacking = {
        name
        for name in paths(text)
        if "NAME" not in name
        and not any(list(ROOT.glob(f"{base}/{name}".lstrip("/"))) for base in ("", *SHORT))
    }
    assert not lacking


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_links_of_a_document_lead_somewhere(document: Path) -> None:
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", document.read_text(encoding="utf-8")):
        name, _, place = link.partition("#")
        target = document.parent / name if name else document
        assert target.exists(), link
        if place:
            titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert place in [re.sub(r"[^\w -]", "", t.lower()).replace(" ", "-") for t in titles], link


@cache
def options(verb: str) -> set[str]:
    """Options of a verb, and of the verbs that it has; of the daemon without one."""
    main = typer.main.get_command(app)
    context = typer.Context(main)
    if not verb:
        return {opt for p in main.params for opt in (*p.opts, *p.secondary_opts)} | {"--help", "-h"}
    named = main.get_command(context, verb)  # type: ignore[attr-defined]
    assert isinstance(named, Named)
    found = typer.main.get_command(named._load())
    inner = list(getattr(found, "commands", {}).values())
    return {opt for c in (found, *inner) for p in c.params for opt in (*p.opts, *p.secondary_opts)} | {
        "--help"
    }


def commands(text: str) -> Iterator[list[str]]:
    """Words behind `pneud`, where a document shows a command."""
    for code in codes(text):
        plain = re.sub(r"#.*|ARGS=\S*|\[|\]", " ", code)
        for part in re.split(r"[|;&]", plain):
            words = part.split()
            if words and words[0] == "sudo":
                words = words[1:]
            if words and words[0] == "pneud":
                yield words[1:]


@pytest.mark.parametrize("document", DOCUMENTS, ids=IDS)
def test_commands_of_a_document_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    for words in commands(text):
        verb = words[0] if words and re.fullmatch(r"[a-z-]+", words[0]) and words[0][0] != "-" else ""
        assert not verb or verb in verbs(), words
        wanted = {w.partition("=")[0] for w in words if re.match(r"--?[a-z]", w)}
        assert wanted <= options(verb), words
    for target in re.findall(r"(?:`|^ {4})make ([a-z][a-z-]*)", text, re.MULTILINE):
        assert target in TARGETS, target
    for module in re.findall(r"python3? -m (p(?:neud|ure2c)[\w.]*)", text):
        assert (ROOT / "src" / module.replace(".", "/")).with_suffix(".py").is_file(), module


def names_in(folder: Path) -> set[str]:
    """All functions, classes and constants of Python below a folder, and the modules."""
    found: set[str] = set()
    for path in folder.rglob("*.py"):
        found |= {path.stem, path.parent.name}
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found.add(node.name)
            elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                found.add(node.id)
    return found


def test_a_tick_goes_through_functions_that_exist() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    way = text.partition("## A tick's way")[2].partition("## Recipes")[0]
    named = {part for code in codes(way) if re.fullmatch(r"[\w.]+", code) for part in code.split(".")}
    assert len(named) > 40
    assert named <= names_in(ROOT / "src" / "pneud")


def test_every_room_stands_in_the_architecture() -> None:
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    package = ROOT / "src" / "pneud"
    rooms = [p for p in package.iterdir() if (p / "__init__.py").is_file() or p.suffix == ".py"]
    for room in rooms:
        assert room.stem == "__init__" or f"`src/pneud/{room.name}`" in text, room
