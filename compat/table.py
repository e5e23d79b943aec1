"""Turn the outcomes of several runs (``pytest compat --compat-json=FILE``) into one table."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

START, END = "<!-- table -->", "<!-- end of table -->"
HEADER = (
    "| OpenCV | numpy | Python | cv2 itself | ours: calls as cv2 | known differences | unexpected "
    "| checks that failed |\n|---|---|---|---|---|---|---|---|"
)


def row(cv2s: dict | None, ours: dict) -> str:
    """Describe one release; ``cv2s`` is the run of cv2 against itself, if there was one."""
    if cv2s is None:
        itself = "not run"
    else:
        itself = "holds" if cv2s["failed"] == 0 else f"{cv2s['failed']} checks fail"
    as_cv2 = ours["calls"] - ours["known"] - ours["unexpected"]
    return (
        f"| {ours['opencv']} | {ours['numpy']} | {ours['python']} | {itself} "
        f"| {as_cv2:,} of {ours['calls']:,} | {ours['known']} | {ours['unexpected']} "
        f"| {ours['failed']} of {ours['tests'] + ours['failed']:,} |"
    )


def table(records: list[dict]) -> str:
    """Build the Markdown table, oldest release first."""

    def key(record: dict) -> tuple:
        versions = (record[name].split(".") for name in ("opencv", "python"))
        return tuple(tuple(int(part) for part in version) for version in versions)

    cv2s = {key(r): r for r in records if r["implementation"].startswith("cv2:")}
    ours = sorted((r for r in records if not r["implementation"].startswith("cv2:")), key=key)
    return "\n".join([HEADER, *(row(cv2s.get(key(r)), r) for r in ours)])


def main() -> None:
    """Print the table, or put it between the marks of a document."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("outcomes", nargs="+", type=Path, metavar="FILE.json")
    parser.add_argument("--into", type=Path, metavar="FILE.md")
    options = parser.parse_args()
    text = table([json.loads(path.read_text(encoding="utf-8")) for path in options.outcomes])
    if options.into is None:
        print(text)
        return
    before, rest = options.into.read_text(encoding="utf-8").split(START)
    after = rest.split(END)[1]
    options.into.write_text(f"{before}{START}\n{text}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main()
