"""The compat suite and the tests on the releases of OpenCV that people have.

``nox`` runs the newest release of each line, ``nox -s compat tests`` the whole matrix, and
``nox -s compat_table`` writes what came out into docs/compat.md.
"""

from __future__ import annotations

from pathlib import Path

import nox

nox.options.tags = ["newest"]
nox.options.reuse_venv = "yes"

OUTCOMES = Path(".nox") / "compat"

#: Release of OpenCV, the numpy to run it with, Pythons. Wheels before 4.10 need numpy 1.
MATRIX = [
    ("4.8.1.78", "numpy==1.26.4", ("3.11", "3.12")),
    ("4.10.0.84", "numpy==2.0.2", ("3.11",)),
    ("4.12.0.88", "numpy<2.3", ("3.11",)),
    ("4.13.0.92", "numpy>=2", ("3.11",)),
    ("4.14.0.94", "numpy>=2", ("3.11", "3.12", "3.13")),
    ("5.0.0.93", "numpy>=2", ("3.11", "3.12", "3.13")),
]
NEWEST = ("4.14.0.94", "5.0.0.93")


def releases(*, pythons: slice = slice(None)):
    """Parametrize a session by Python and release; the newest releases run by default."""
    return nox.parametrize(
        ("python", "opencv", "numpy"),
        [
            nox.param(
                python,
                opencv,
                numpy,
                id=f"{opencv}, Python {python}",
                tags=["newest"] if opencv in NEWEST and python == "3.11" else [],
            )
            for opencv, numpy, versions in MATRIX
            for python in versions[pythons]
        ],
    )


def install(session: nox.Session, opencv: str, numpy: str, *others: str) -> None:
    """Install the package beside exactly this OpenCV."""
    session.install(
        f"opencv-contrib-python-headless=={opencv}",
        numpy,
        "scipy>=1.11",
        "scikit-learn>=1.6",
        "pytest>=8.3",
        "pytest-timeout>=2.3",
        "hypothesis>=6.100",
        *others,
    )
    session.install("--no-deps", ".")


@nox.session
@releases()
def compat(session: nox.Session, opencv: str, numpy: str) -> None:
    """Hold cv2 itself, then cv_densityf, against this cv2."""
    install(session, opencv, numpy)
    outcomes = OUTCOMES.absolute()
    outcomes.mkdir(parents=True, exist_ok=True)
    names = {"cv2": "cv2:findFundamentalMat", "ours": "cv_densityf:findFundamentalMat"}
    for short, name in names.items():
        target = outcomes / f"{opencv}-{session.python}-{short}.json"
        session.run(
            *("python", "-m", "pytest", "compat", "-q", f"--compat-json={target}"),
            *session.posargs,
            env={"COMPAT_IMPLEMENTATION": name},
            # A failing release belongs into the table; the session fails below.
            success_codes=[0, 1],
        )
        if '"failed": 0' not in target.read_text(encoding="utf-8"):
            session.error(f"{name} on OpenCV {opencv}: the compat suite failed")


@nox.session
@releases(pythons=slice(1))
def tests(session: nox.Session, opencv: str, numpy: str) -> None:
    """Run the tests that touch cv2."""
    install(session, opencv, numpy)
    files = ("points", "epipolar_masks", "cv2_api")
    session.run(
        *("python", "-m", "pytest", "-q"),
        *(f"tests/test_{name}.py" for name in files),
        *session.posargs,
    )


@nox.session
def clients(session: nox.Session) -> None:
    """Run machinevision-toolbox-python, which brings its own OpenCV wheels, on both functions."""
    session.install(
        "machinevision-toolbox-python>=2.4",
        "scikit-learn>=1.6",
        "pytest>=8.3",
        "pytest-timeout>=2.3",
        "hypothesis>=6.100",
    )
    session.install("--no-deps", ".")
    for name in ("cv2:findFundamentalMat", "cv_densityf:findFundamentalMat"):
        session.run(
            # Its warnings are not ours.
            *("python", "-m", "pytest", "-q", "-W", "default", "compat/test_machinevision.py"),
            *("compat/test_clients.py", *session.posargs),
            env={"COMPAT_IMPLEMENTATION": name},
        )


@nox.session
def compat_table(session: nox.Session) -> None:
    """Write the outcomes of the compat sessions into docs/compat.md."""
    found = sorted(str(path) for path in OUTCOMES.glob("*.json"))
    if not found:
        session.error("no outcomes yet; run `nox -s compat` first")
    session.run("python", "compat/table.py", "--into", "docs/compat.md", *found, external=True)
