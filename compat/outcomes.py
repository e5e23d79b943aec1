"""What came of each call: made in a child process, where a crash or a hang costs one case."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from compat import implementation
from compat.cases import CASES, Case

#: Seconds that one call may take.
TIME_LIMIT = 25.0

Task = Callable[[Any, str], Any]


@dataclass(frozen=True)
class Form:
    """What a caller can see of an array without looking at the numbers."""

    type: str
    shape: tuple[int, ...]
    dtype: str
    contiguous: bool
    own_data: bool
    writeable: bool


@dataclass(frozen=True, eq=False)
class Outcome:
    """An answer, an error, or what else became of the child process."""

    kind: str  # "answer", "error", "crash", "timeout"
    detail: str = ""
    code: int = 0
    func: str = ""
    F: np.ndarray | None = None
    F_form: Form | None = None
    mask: np.ndarray | None = None
    mask_form: Form | None = None
    mask_is_given: bool = False
    given_mask_changed: bool = False
    points_changed: bool = False


def _array(value: Any) -> Any:
    return value.get() if isinstance(value, cv2.UMat) else value


def _form(value: Any) -> Form | None:
    if value is None:
        return None
    array = _array(value)
    if not isinstance(array, np.ndarray):
        return Form(type(value).__name__, (), "", False, False, False)
    own = isinstance(value, cv2.UMat) or array.flags.owndata
    return Form(
        type(value).__name__,
        array.shape,
        str(array.dtype),
        array.flags.c_contiguous,
        own,
        array.flags.writeable,
    )


def _copy(value: Any) -> Any:
    array = _array(value)
    return array.copy() if isinstance(array, np.ndarray) else None


def _equal(one: Any, two: Any) -> bool:
    return one is None or one.tobytes() == two.tobytes()


def observe(function: Any, case: Case) -> Outcome:
    """Make one call and describe what came of it."""
    args, kwargs = case.build()
    given = kwargs.get("mask", args[-1] if len(args) > 5 else None)
    inputs = [*args[:2], kwargs.get("points1"), kwargs.get("points2")]
    before = [_copy(value) for value in (*inputs, given)]
    try:
        answer = function(*args, **kwargs)
    except cv2.error as error:
        return Outcome("error", str(error), error.code or 0, error.func or "")
    except Exception as error:
        return Outcome("error", f"{type(error).__name__}: {error}")
    if type(answer) is not tuple or len(answer) != 2:
        return Outcome("error", f"nothing, but returns no tuple (F, mask): {type(answer).__name__}")
    F, mask = answer
    same = [_equal(old, _array(new)) for old, new in zip(before, (*inputs, given), strict=True)]
    return Outcome(
        "answer",
        F=_copy(F),
        F_form=_form(F),
        mask=_copy(mask),
        mask_form=_form(mask),
        mask_is_given=mask is not None and mask is given,
        given_mask_changed=not same[-1],
        points_changed=not all(same[:-1]),
    )


def _observe_case(function: Any, id_: str) -> Outcome:
    return observe(function, CASES[id_])


def _child(task: Task, name: str, ids: list[str], pipe: Any) -> None:
    function = implementation.load(name)
    for id_ in ids:
        pipe.send(task(function, id_))


def in_children(task: Task, name: str, ids: Iterable[str]) -> dict[str, Any]:
    """Do one task after another in a child process, and go on in a new one after a crash or a hang.

    ``task(function, id_)`` is a function of a module; its results travel between the processes.
    """
    waiting = list(ids)
    found: dict[str, Any] = {}
    context = multiprocessing.get_context("spawn")
    while waiting:
        ours, theirs = context.Pipe(duplex=False)
        child = context.Process(target=_child, args=(task, name, waiting, theirs), daemon=True)
        child.start()
        theirs.close()
        try:
            while waiting:
                # The first answer waits for the imports too.
                if not ours.poll(TIME_LIMIT):
                    found[waiting.pop(0)] = Outcome("timeout", f"longer than {TIME_LIMIT:.0f} s")
                    break
                try:
                    outcome = ours.recv()
                except EOFError:
                    child.join()
                    found[waiting.pop(0)] = Outcome(
                        "crash", f"the process died, exit code {child.exitcode}"
                    )
                    break
                found[waiting.pop(0)] = outcome
        finally:
            child.kill()
            child.join()
            ours.close()
    return found


def in_both(task: Task, ids: Iterable[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Do the tasks with the implementation under test and with cv2, side by side."""
    ids = list(ids)
    with ThreadPoolExecutor(2) as pool:
        names = (implementation.NAME, "cv2:findFundamentalMat")
        ours, cv2s = pool.map(lambda name: in_children(task, name, ids), names)
    return ours, cv2s


def observe_both(ids: Iterable[str]) -> tuple[dict[str, Outcome], dict[str, Outcome]]:
    """Outcomes of the calls of the table, the implementation's under test and cv2's."""
    return in_both(_observe_case, ids)
