"""What the README promises can be pasted."""

from __future__ import annotations

import re
from pathlib import Path

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


def test_first_python_block_runs_as_it_stands_and_the_others_continue(capsys):
    names: dict[str, object] = {}
    first, *others = blocks("python")
    exec(first, names)
    error = re.search(r"error ([\d.]+) px", capsys.readouterr().out)
    assert float(error[1]) < 0.3
    for code in others:
        exec(code, names)
    assert names["inliers"].shape[1] == 4
    assert names["found"]
