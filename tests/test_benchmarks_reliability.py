"""The measurements of reliability see what they are there to see."""

from __future__ import annotations

import mmap
import sys
from itertools import count

import cv2
import numpy as np
import pytest

from benchmarks import reliability
from benchmarks.__main__ import main
from cv_densityf import findFundamentalMat


def table(text):
    """Cells of the rows of the first table, by the first of each."""
    text = text[text.index("|") :].split("\n\n")[0]
    lines = text.splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    return {name: cells for name, *cells in rows}


def counts(text):
    return {name: int(cells[0].replace(",", "")) for name, cells in table(text).items()}


def test_random_calls_are_of_every_kind_and_the_same_again():
    cases = [reliability.random_case(seed) for seed in range(400)]
    about = " ".join(case.id for case in cases)
    for word in (
        "scene",
        "line in both",
        "not finite",
        "UMat",
        "mask",
        "n=7,",
        "UsacParams",
        "keyword",
    ):
        assert word in about
    assert {case.rule for case in cases} == {None, "usac", "ransac", "lmeds", "all"}
    for seed in range(20):
        one, two = (
            reliability.observe(findFundamentalMat, reliability.random_case(seed)) for _ in "12"
        )
        assert (one.kind, one.code, one.F_form) == (two.kind, two.code, two.F_form)


def test_calls_beside_cv2_add_up():
    found = counts(reliability.beside_cv2(150))
    assert found["calls"] == 150
    assert found["which cv2 answers"] + found["which cv2 refuses"] == 150
    assert min(found["which cv2 answers"], found["which cv2 refuses"]) > 10
    kinds = ["same kind of answer, or the same refusal", "any other difference"]
    kinds += [reliability._MORE, reliability._LESS, reliability._SOLVED, reliability._ZEROED]
    assert sum(found[kind] for kind in kinds) == 150
    assert found["any other difference"] == 0
    assert 0 < found["masks that can be worked out from F"] < 150
    assert found["masks that are so, bit for bit"] == found["masks that can be worked out from F"]


def broken(change):
    def function(*args, **kwargs):
        F, mask = findFundamentalMat(*args, **kwargs)
        return change(F, mask)

    return function


@pytest.mark.parametrize(
    ("change", "row"),
    [
        (lambda F, mask: (F, mask if mask is None else cv2.UMat(mask)), "any other difference"),
        (lambda F, mask: (F if F is None else F.astype("f4"), mask), "any other difference"),
        (lambda F, mask: (None, mask), reliability._LESS),
    ],
    ids=["mask of another type", "F of another precision", "never an F"],
)
def test_another_kind_of_answer_is_counted(monkeypatch, change, row):
    monkeypatch.setattr(reliability, "findFundamentalMat", broken(change))
    assert counts(reliability.beside_cv2(40))[row] > 10


def test_another_error_and_another_mask_are_counted(monkeypatch):
    def never(*args, **kwargs):
        raise ValueError("no")

    monkeypatch.setattr(reliability, "findFundamentalMat", never)
    assert counts(reliability.beside_cv2(30))["any other difference"] == 30

    def flipped(F, mask):
        if isinstance(mask, np.ndarray) and mask.size:
            mask.flat[0] ^= 1
        return F, mask

    monkeypatch.setattr(reliability, "findFundamentalMat", broken(flipped))
    text = reliability.beside_cv2(40)
    found = counts(text)
    # All but those in a UMat.
    assert (
        found["masks that are so, bit for bit"] < 5 < found["masks that can be worked out from F"]
    )
    assert "1 are not the rule's" in text


def test_what_differs_under_load_is_counted(monkeypatch):
    expected = [reliability._digest(job) for job in reliability._jobs()]
    calls, wrong = reliability._load(expected, 0.5, 4, 0)
    assert calls > 4
    assert wrong == 0
    random = count()
    monkeypatch.setattr(reliability, "_jobs", lambda: [lambda: next(random)] * len(expected))
    calls, wrong = reliability._load(expected, 0.05, 4, 0)
    assert calls == wrong > 0


def test_load_of_processes(monkeypatch):
    found = table(reliability.under_load(0.3, n_threads=2, n_processes=1))
    assert found["processes, of so many threads"] == ["1, 2"]
    assert int(found["calls"][0]) > 0
    assert found["answers that differ in a bit from the same call alone"] == ["0"]


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_leak_shows(monkeypatch):
    kept = []

    def leak():
        # Of the system itself: an array might go where earlier tests have left room.
        kept.append(mmap.mmap(-1, 800_000))
        kept[-1].write(b"1" * 800_000)

    monkeypatch.setattr(reliability, "_jobs", lambda: [leak])
    marks = [float(mb) for mb in table(reliability.memory(100))["memory of the process, MB"]]
    assert len(marks) == 6
    # 800 kB for each call after the fifth.
    assert marks[-1] - marks[0] == pytest.approx(95 * 0.8, rel=0.2)


def test_coordinates_are_mapped_there_and_back(monkeypatch):
    ours = "ours USAC_ACCURATE"
    monkeypatch.setattr(reliability, "ESTIMATORS", {ours: reliability.ESTIMATORS[ours]})
    found = table(reliability.coordinates(3))
    assert set(reliability.MAPS) | set(reliability.ADDED) < set(found)
    plain = float(found["as it is"][0])
    assert 0 < plain < 0.3
    for name in (*reliability.MAPS, "images swapped", "every match four times more"):
        assert float(found[name][0]) < plain + 0.1


def test_command(capsys):
    sizes = ["--calls", "5", "--seconds", "0", "--repeats", "50", "--scenes", "0"]
    assert main(["reliability", *sizes]) == 0
    text = capsys.readouterr().out
    assert table(text).keys() >= {"calls"}
    assert len(table(text.split("## Memory")[1])["memory of the process, MB"]) == 6
    assert "## Coordinates" not in text
    assert main(["reliability", "--calls", "-1"]) == 2
    assert "start at 0" in capsys.readouterr().err
