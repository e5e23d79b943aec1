"""What the README promises can be pasted."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cv_densityf.datasets import two_view_scene

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str, text: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def test_quick_start_is_two_lines():
    section = README.split("## Quick start\n")[1].split("\n## ")[0]
    (block,) = blocks("sh", section)
    assert section.count("```") == 2
    assert block.splitlines() == [
        "python -m pip install '.[demo]' && cv-densityf demo",
        "python -m pip install -e '.[test]' && python -m pytest",
    ]


@pytest.mark.parametrize("code", blocks("python"))
def test_python_runs(code):
    scene = two_view_scene()
    names = {"points1": scene.points1, "points2": scene.points2, "X": scene.X}
    exec(code, names)
    assert "F" in names or names["found"]
