"""The pages: their examples run, and their links lead somewhere, with and without Sphinx."""

from __future__ import annotations

import ast
import doctest
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)")


def code_lines(text: str, language: str | None) -> str:
    """The lines inside fences of one language, or outside of all fences; blank lines elsewhere."""
    lines, inside = [], None
    for line in text.splitlines():
        fence = FENCE.match(line)
        if fence:
            inside = None if inside is not None else fence[1]
        lines.append("" if fence or inside != language else line)
    return "\n".join(lines) + "\n"


def slugs(text: str) -> set[str]:
    """Anchors of the headings, as Markdown hosts and MyST make them."""
    headings = re.findall(r"^#+ (.+)$", code_lines(text, None), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


WITH_EXAMPLES = [page for page in PAGES if ">>> " in page.read_text("utf-8")]


@pytest.mark.parametrize("page", WITH_EXAMPLES, ids=lambda page: page.name)
def test_examples_run(page):
    code = code_lines(page.read_text("utf-8"), "python")
    test = doctest.DocTestParser().get_doctest(code, {}, page.name, str(page), 0)
    assert len(test.examples) == page.read_text("utf-8").count("\n>>> ")
    report: list[str] = []
    flags = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    doctest.DocTestRunner(optionflags=flags).run(test, out=report.append)
    assert not report, "".join(report)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = code_lines(page.read_text("utf-8"), None)
    references = dict(re.findall(r"^\[([^\]]+)\]: (\S*)$", text, re.MULTILINE))
    assert set(re.findall(r"\[([^\]]+)\]\[\]", text)) == references.keys()
    for link in [*re.findall(r"\]\(([^)]*)\)", text), *references.values()]:
        if ":" in link:  # other sites are visited by sphinx's linkcheck
            assert re.fullmatch(r"https://[\w-]+(\.[\w-]+)+(/[\w./?=#-]*)?", link), link
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.is_file(), f"{link}: no such file"
        if anchor:
            assert anchor in slugs(target.read_text("utf-8")), f"{link}: no such heading"


def test_files_import_only_from_those_above_them():
    """As the table of the page for contributors says, which names every file."""
    package = ROOT / "cv_densityf"
    page = (ROOT / "docs" / "contributing.md").read_text("utf-8")
    listed = re.findall(r"^\| `(\w+)\.py` \|", page, re.MULTILINE)
    assert {*listed, "__init__"} == {path.stem for path in package.glob("*.py")}
    for place, name in enumerate(listed):
        tree = ast.parse((package / f"{name}.py").read_text("utf-8"))
        imported = {
            module
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("cv_densityf")
            for module in (node.module.split(".")[1:] or [each.name for each in node.names])
        }
        assert imported <= set(listed[:place]), name
