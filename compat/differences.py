"""Where an implementation's outcome is not cv2's, and which of that is known."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from compat import implementation, versions
from compat.cases import CASES, Case
from compat.outcomes import Form, Outcome

KNOWN_FILE = Path(__file__).with_name("known_differences.txt")


def differences(case: Case, ours: Outcome, cv2s: Outcome) -> dict[str, str]:
    """Name each aspect in which the outcomes differ, and say how."""
    found: dict[str, str] = {}
    if ours.kind in ("crash", "timeout"):
        if cv2s.kind != ours.kind:
            found[ours.kind] = ours.detail
        return found
    if cv2s.kind in ("crash", "timeout"):
        return found  # any answer is better
    if cv2s.kind == "error" or ours.kind == "error":
        if cv2s.kind != ours.kind:
            if not case.unstable:
                found["outcome"] = (
                    f"raises {_raised(ours)}, where cv2 answers"
                    if ours.kind == "error"
                    else f"answers, where cv2 raises {_raised(cv2s)}"
                )
        elif (ours.code, ours.func) != (cv2s.code, cv2s.func):
            found["error"] = f"raises {_raised(ours)}, where cv2 raises {_raised(cv2s)}"
        return found
    if ours.points_changed:
        found["points"] = "the point arrays were written to"
    if not case.unstable and (ours.F is None) != (cv2s.F is None):
        found["F"] = f"F is {_presence(ours.F)}, where cv2 has {_presence(cv2s.F)}"
    elif ours.F is not None and cv2s.F is not None and not _same_form(case, ours, cv2s):
        found["F"] = f"F: {_contrast(ours.F_form, cv2s.F_form)}"
    elif case.direct and ours.F is not None and cv2s.F is not None:
        scale = np.abs(np.nan_to_num(cv2s.F)).max()
        if not np.allclose(ours.F, cv2s.F, rtol=1e-6, atol=1e-9 * scale, equal_nan=True):
            found["F"] = "F is another solution of an exact problem than cv2's"
    if case.rule in ("ransac", "lmeds") and ours.F is not None and cv2s.F is not None:
        # F is only defined up to scale, but programs have come to rely on it.
        one = [abs(F[2, 2] - 1) < 1e-9 for F in (ours.F, cv2s.F)]
        if one[1] and not one[0]:
            found["scale"] = "F[2, 2] is not 1, as cv2's is"
    luck = case.unstable and (ours.F is None) != (cv2s.F is None)
    if ours.mask_form != cv2s.mask_form and not luck:
        found["mask"] = f"mask: {_contrast(ours.mask_form, cv2s.mask_form)}"
    if ours.mask_is_given != cv2s.mask_is_given:
        found["mask="] = (
            "the array given as mask= is what is returned; cv2 returns another"
            if ours.mask_is_given
            else "the array given as mask= is not what is returned; cv2 returns it"
        )
    elif ours.given_mask_changed != cv2s.given_mask_changed:
        found["mask="] = (
            "the array given as mask= was written to; cv2 leaves it alone"
            if ours.given_mask_changed
            else "the array given as mask= was not written to; cv2 writes to it"
        )
    return found


def _presence(F: np.ndarray | None) -> str:
    return "None" if F is None else "a matrix"


def _raised(outcome: Outcome) -> str:
    first_line = outcome.detail.partition("\n")[0]
    return f"{outcome.code} in {outcome.func!r}" if outcome.func else f"{first_line:.100}"


def _contrast(ours: Form | None, cv2s: Form | None) -> str:
    """Name the properties that differ, and only those."""
    if ours is None or cv2s is None:
        one, two = (
            "None" if form is None else f"{form.dtype} {form.shape}" for form in (ours, cv2s)
        )
        return f"{one}, cv2's {two}"
    return ", ".join(
        f"{field.name} {one}, cv2's {two}"
        for field in fields(Form)
        if (one := getattr(ours, field.name)) != (two := getattr(cv2s, field.name))
    )


def _same_form(case: Case, ours: Outcome, cv2s: Outcome) -> bool:
    if case.unstable and ours.F_form and cv2s.F_form:
        return ours.F_form.dtype == cv2s.F_form.dtype
    return ours.F_form == cv2s.F_form


@dataclass(frozen=True)
class Known:
    """A line of ``known_differences.txt``."""

    pattern: str
    aspect: str
    condition: str
    issue: str
    reason: str

    def covers(self, id_: str, aspect: str) -> bool:
        return aspect == self.aspect and fnmatch.fnmatchcase(id_, self.pattern)

    def __str__(self) -> str:
        return f"{self.pattern} | {self.aspect} | {self.condition}"


def read_known(text: str) -> list[Known]:
    """Read lines of ``case pattern | aspect | OpenCV | OpenCV issue | reason``."""
    known = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            parts = [part.strip() for part in line.split("|")]
            if len(parts) != 5 or not all(parts):
                raise ValueError(f"line {number} of the known differences has not 5 fields")
            known.append(Known(*parts))
    return known


def load_known() -> list[Known]:
    """Known differences of the default implementation; any other has none."""
    if implementation.NAME != implementation.DEFAULT:
        return []
    return read_known(KNOWN_FILE.read_text(encoding="utf-8"))


def matching_ids(known: Known) -> list[str]:
    return fnmatch.filter(CASES, known.pattern)


def is_known(known: list[Known], id_: str, aspect: str) -> Known | None:
    """Find the line that covers a difference on this release."""
    for line in known:
        if line.covers(id_, aspect) and versions.applies(line.condition):
            return line
    return None
