"""Run a program as python runs it, with cv2 patched: ``python -m cv_densityf run``."""

from __future__ import annotations

import argparse
import atexit
import builtins
import os
import pkgutil
import sys
from importlib.machinery import SourceFileLoader, SourcelessFileLoader
from io import BytesIO

# What the interpreter itself calls for -m and for folders; the public functions of runpy put
# another __main__ back before threads and exit handlers of the program have come to their end.
from runpy import _run_module_as_main  # type: ignore[attr-defined]
from types import ModuleType
from typing import Any

from cv_densityf._arguments import DENSITIES
from cv_densityf.patching import call_sites, patch_cv2

CANNOT_OPEN = 2


def add_run(commands: argparse._SubParsersAction[Any]) -> None:
    """Add the sub-command ``run``, whose ``run(options)`` is `run_script`."""
    parser = commands.add_parser(
        "run",
        help="run a program unmodified, with cv2.findFundamentalMat patched",
        description="Run a Python program as python does, with cv2.findFundamentalMat replaced. "
        "What follows the program's name is for the program, and its exit code is ours.",
        usage="%(prog)s [--report] [--density NAME] (SCRIPT | -m MODULE) [ARGUMENT ...]",
    )
    parser.add_argument(
        "--report", action="store_true", help="list the calls on standard error at exit"
    )
    parser.add_argument(
        "--density",
        choices=DENSITIES,
        default="contrast",
        help="how the dense matches are chosen (%(default)s)",
    )
    parser.add_argument("-m", dest="module", action="store_true", help="as in python -m")
    parser.add_argument(
        "program",
        nargs=argparse.REMAINDER,
        help="a file, or a folder or zip with a __main__.py, or a module; then its arguments",
    )
    parser.set_defaults(run=run_script, error=parser.error)


def run_script(options: argparse.Namespace) -> int:
    """Patch cv2 and run the program; what it raises, SystemExit included, goes to the caller.

    The process is the program's from then on: its ``sys.argv``, ``sys.path`` and ``__main__`` stay.
    """
    if not options.program:
        options.error("give a script, or -m and a module")
    patch_cv2(density=options.density)
    if options.report:
        # Exit handlers run last in, first out: this one sees the calls of the program's own.
        atexit.register(_print_report)
    main = ModuleType("__main__")
    vars(main)["__builtins__"] = builtins
    if sys.version_info < (3, 14):  # which makes it when it is asked for
        vars(main)["__annotations__"] = {}
    sys.modules["__main__"] = main
    try:
        if options.module:
            return _run_module(*options.program)
        return _run_path(main, *options.program)
    except BaseException as error:
        _hide_our_frames(error)
        raise


def _run_module(name: str, *arguments: str) -> int:
    if not sys.flags.safe_path:
        sys.path[0] = os.getcwd()
    sys.argv = ["-m", *arguments]  # the first one becomes the module's path
    _run_module_as_main(name)
    return 0


def _run_path(main: ModuleType, script: str, *arguments: str) -> int:
    sys.argv = [script, *arguments]
    if pkgutil.get_importer(script) is not None:  # a folder or a zip file
        if not sys.flags.safe_path:
            del sys.path[0]
        sys.path.insert(0, os.path.abspath(script))
        _run_module_as_main("__main__", False)
        return 0
    path = os.path.abspath(script)
    try:
        with open(path, "rb") as file:
            source = file.read()
    except OSError as error:
        reason = f"[Errno {error.errno}] {error.strerror}"
        print(f"cv-densityf: can't open file {path!r}: {reason}", file=sys.stderr)
        return CANNOT_OPEN
    if not sys.flags.safe_path:  # python -P and -I put nothing in front
        sys.path[0] = os.path.dirname(os.path.realpath(path))
    compiled = pkgutil.read_code(BytesIO(source))
    loader = SourceFileLoader if compiled is None else SourcelessFileLoader
    vars(main).update(__file__=path, __cached__=None, __loader__=loader("__main__", path))
    exec(compiled or compile(source, path, "exec", dont_inherit=True), vars(main))
    return 0


def _hide_our_frames(error: BaseException) -> None:
    """Let ``sys.excepthook``, the program's own if it has set one, see the program's frames only.

    Raising adds the frames of all callers again, so they can only be cut in the hook.
    """
    hook, trace = sys.excepthook, error.__traceback__
    while trace is not None and trace.tb_frame.f_globals is globals():
        trace = trace.tb_next

    def show(kind: type[BaseException], error: BaseException, _: Any) -> None:
        hook(kind, error.with_traceback(trace), trace)

    sys.excepthook = show


def _print_report() -> None:
    if sys.__stderr__ is not None:
        print(_report(), file=sys.__stderr__)


def _report() -> str:
    sites = call_sites()
    if not sites:
        return (
            "cv-densityf: cv2.findFundamentalMat was not called through the patch in this process; "
            "what worker processes called is not counted"
        )
    names = ("calls", "cv2's own", "errors", "no model", "matches", "inliers", "ms a call")
    lines = ["cv-densityf: calls of cv2.findFundamentalMat, and their matches"]
    lines.append("".join(f"{name:>10}" for name in names) + "  line")
    for s in sites:
        row = (s.calls, s.passed_on, s.errors, s.no_model, s.matches, s.inliers)
        numbers = "".join(f"{n:>10}" for n in row) + f"{1e3 * s.seconds / s.calls:>10.1f}"
        lines.append(f"{numbers}  {s.filename}:{s.line}")
    return "\n".join(lines)
