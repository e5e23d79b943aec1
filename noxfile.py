"""The releases of OpenCV that people have, the package as people get it, and its oldest versions.

``nox`` runs the compat suite and the tests on the newest release of each line of OpenCV,
``nox -s compat tests`` on the whole matrix, and ``nox -s compat_table`` writes what came out into
docs/compat.md. Before a release also ``nox -s package lowest types``. Install ``nox[uv]`` for it;
Pythons that are not there are skipped.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from itertools import chain
from pathlib import Path, PurePosixPath

import nox
from packaging.requirements import Requirement
from packaging.version import Version

nox.options.tags = ["newest"]
nox.options.reuse_venv = "yes"

PROJECT = nox.project.load_toml("pyproject.toml")
PYTHONS = nox.project.python_versions(PROJECT)
OUTCOMES = Path(".nox") / "compat"
TEST_TOOLS = ("hypothesis", "pytest", "pytest-timeout")

#: Release of OpenCV, the numpy to run it with, Pythons. Wheels before 4.10 need numpy 1.
MATRIX = [
    ("4.8.1.78", "numpy==1.26.4", ("3.11", "3.12")),
    ("4.9.0.80", "numpy==1.26.4", ("3.11",)),
    ("4.10.0.84", "numpy==2.0.2", ("3.11",)),
    ("4.11.0.86", "numpy>=2", ("3.11",)),
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


def install(session: nox.Session, opencv: str, numpy: str) -> None:
    """Install the package beside exactly this OpenCV."""
    session.install(f"opencv-contrib-python-headless=={opencv}", numpy, *TEST_TOOLS, ".")


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
        target.unlink(missing_ok=True)  # a run that writes none must not leave an older one
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
    """Run the tests of what calls this cv2: draws, trees, masks, pipeline and the function."""
    install(session, opencv, numpy)
    files = ("points", "epipolar_masks", "prefilter", "consensus", "estimate", "cv2_api")
    session.run(
        *("python", "-m", "pytest", "-q"),
        *(f"tests/test_{name}.py" for name in files),
        *session.posargs,
    )


@nox.session
def clients(session: nox.Session) -> None:
    """Run machinevision-toolbox-python, which brings its own OpenCV wheels, on both functions."""
    session.install("machinevision-toolbox-python>=2.4", "scikit-learn", *TEST_TOOLS)
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


@nox.session(python=PYTHONS)
def package(session: nox.Session) -> None:
    """Build, look inside, install each archive where nothing else is, run what arrived."""
    session.install("build", "twine")
    scratch = Path(session.create_tmp()).absolute()
    shutil.rmtree(scratch)
    scratch.mkdir()
    session.run("python", "-m", "build", "--outdir", str(scratch / "dist"))
    (wheel,) = (scratch / "dist").glob("*.whl")
    (sdist,) = (scratch / "dist").glob("*.tar.gz")
    session.run("twine", "check", "--strict", str(wheel), str(sdist))
    shutil.unpack_archive(sdist, scratch)
    unpacked = scratch / sdist.name.removesuffix(".tar.gz")
    check_sdist(session, unpacked)
    check_wheel(session, wheel)

    smoke = str(Path("tests/smoke.py").absolute())
    for archive in (wheel, sdist):
        environment = scratch / f"installed-{archive.suffix[1:]}"
        session.run("python", "-m", "venv", str(environment))
        bin_ = environment / ("Scripts" if os.name == "nt" else "bin")
        with session.chdir(scratch):
            for extra in ("", "[demo]"):
                session.run(
                    *(str(bin_ / "python"), "-m", "pip", "install", "--quiet"),
                    f"cv-densityf{extra} @ {archive.absolute().as_uri()}",
                    external=True,
                )
                session.run(str(bin_ / "python"), "-I", smoke, external=True)
                session.run(str(bin_ / "cv-densityf"), "version", external=True)
            session.run(str(bin_ / "cv-densityf"), "demo", external=True)

    session.install(f"{unpacked}[test]")
    with session.chdir(unpacked):
        session.run("python", "-m", "pytest", "-q", *session.posargs)


def check_sdist(session: nox.Session, unpacked: Path) -> None:
    """Refuse to pack less or more than the repository."""
    packed = {path.relative_to(unpacked) for path in unpacked.rglob("*") if path.is_file()}
    listed = session.run("git", "ls-files", external=True, silent=True)
    tracked = {Path(line) for line in str(listed).splitlines()}
    compare(session, "the sdist", packed, tracked | {Path("PKG-INFO")})


def check_wheel(session: nox.Session, wheel: Path) -> None:
    """Refuse to pack less or more than the modules of the package."""
    folder, _ = wheel.name.split("-py3-", 1)
    info = PurePosixPath(f"{folder}.dist-info")
    with zipfile.ZipFile(wheel) as archive:
        packed = {PurePosixPath(name) for name in archive.namelist()}
    modules = {PurePosixPath(path.as_posix()) for path in Path("cv_densityf").rglob("*.py")}
    about = ("METADATA", "RECORD", "WHEEL", "entry_points.txt", "licenses/LICENSE")
    wanted = {*modules, PurePosixPath("cv_densityf/py.typed"), *(info / name for name in about)}
    compare(session, "the wheel", packed, wanted)


def compare(session: nox.Session, name: str, packed: set, wanted: set) -> None:
    """End the session unless both are equal."""
    for what, paths in (("lacks", wanted - packed), ("should not hold", packed - wanted)):
        if paths:
            session.error(f"{name} {what} {', '.join(sorted(map(str, paths)))}")


@nox.session(python=PYTHONS[0], venv_backend="uv")
def lowest(session: nox.Session) -> None:
    """Run all tests on the lowest versions that pyproject.toml allows."""
    extras = sorted(PROJECT["project"]["optional-dependencies"].keys() - {"docs"})
    session.install(
        *("--resolution=lowest-direct", "--upgrade", "--reinstall-package=cv-densityf"),
        f".[{','.join(extras)}]",
    )
    check_floors(session, extras)
    # Old libraries complain about each other.
    leave = [f"-Wdefault::{name}" for name in ("DeprecationWarning", "FutureWarning")]
    for suite in ((), ("compat",)):
        session.run("python", "-m", "pytest", "-q", *leave, *suite, *session.posargs)


def check_floors(session: nox.Session, extras: list[str]) -> None:
    """Refuse floors that are not what is installed: nobody would have run the tests on them."""
    listed = session.run("uv", "pip", "list", "--quiet", "--format=json", silent=True)
    installed = {item["name"]: Version(item["version"]) for item in json.loads(str(listed))}
    project = PROJECT["project"]
    optional = (project["optional-dependencies"][extra] for extra in extras)
    wrong = []
    for requirement in map(Requirement, chain(project["dependencies"], *optional)):
        applies = requirement.marker is None or requirement.marker.evaluate()
        if requirement.name != project["name"] and applies:
            (floor,) = requirement.specifier
            if installed[requirement.name] != Version(floor.version):
                wrong.append(f"{requirement} is {installed[requirement.name]}")
    if wrong:
        session.error(f"the lowest versions that go together are others: {', '.join(wrong)}")


@nox.session(python=PYTHONS[0])
def types(session: nox.Session) -> None:
    """Check the package with both type checkers, in their strictest and standard modes."""
    session.install(".[test]", "pyright")
    session.run("mypy", "--strict", "cv_densityf")
    session.run("pyright", "--project", "pyproject.toml")
