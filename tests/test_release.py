"""What people install: one version said everywhere, public names that hold, and a wheel that explores on its own.

The tests of the wheel are marked ``release`` and run by ``make package``.
"""

from __future__ import annotations

import importlib
import inspect
import os
import re
import resource
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("slam", "mecanum_env", "agents", "training")
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
VERSION = PYPROJECT["project"]["version"]


def files(root: Path) -> set[str]:
    """Return the names of the packages' files below a folder, caches left out."""
    found = (path.relative_to(root) for package in PACKAGES for path in (root / package).rglob("*"))
    return {str(p) for p in found if (root / p).is_file() and p.suffix not in (".pyc", ".nbi", ".nbc")}


@pytest.mark.parametrize(
    ("file", "said"),
    [
        ("CITATION.cff", r"^version: (.+)$"),
        ("README.md", r"^  version = \{(.+)\},$"),
        ("CHANGELOG.md", r"^## \[(\d.+?)\]"),
    ],
)
def test_one_version_is_said_everywhere(file: str, said: str) -> None:
    found = re.search(said, (ROOT / file).read_text("utf-8"), re.MULTILINE)
    assert found is not None and found[1] == VERSION


def test_what_an_index_shows_holds_outside_of_the_repository() -> None:
    page = (ROOT / PYPROJECT["project"]["readme"]).read_text("utf-8")
    targets = re.findall(r"\]\(([^)]+)\)", page)
    assert all(target.startswith("https://") for target in targets), targets


@pytest.mark.parametrize("package", PACKAGES)
def test_public_names_are_there_and_on_the_page_of_the_reference(package: str) -> None:
    module = importlib.import_module(package)
    page = (ROOT / "docs" / "reference" / "api.md").read_text("utf-8")
    assert f"::: {package}\n" in page
    for name in module.__all__:
        if name == "ExploreVecEnv":
            pytest.importorskip("stable_baselines3", reason="needs the extra `train`")
        value = getattr(module, name)
        assert not (inspect.isclass(value) or inspect.isroutine(value)) or inspect.getdoc(value), name
    with pytest.raises(AttributeError, match="no_such_name"):
        module.no_such_name  # noqa: B018


def test_importing_the_environments_is_quick() -> None:
    def once() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-c", "import mecanum_env"], cwd=ROOT, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    assert min(once() for _ in range(3)) < 0.7  # processor time [s]: others may hold the processor up


# ---- the wheel -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, made of the source archive, both looked at by twine."""
    for tool in ("build", "twine"):
        pytest.importorskip(tool, reason="needs the extra `release`")
    out = tmp_path_factory.mktemp("dist")
    source = tmp_path_factory.mktemp("source") / "mecanum-slam"
    left_out = shutil.ignore_patterns(".*", "__pycache__", "out", "build", "results", "*.egg-info")
    shutil.copytree(ROOT, source, ignore=left_out)
    run(sys.executable, "-m", "build", "--outdir", str(out), str(source))
    made = sorted(out.iterdir())
    assert [path.suffix for path in made] == [".whl", ".gz"]
    run(sys.executable, "-m", "twine", "check", "--strict", *map(str, made))
    return made[0]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of an environment that has the wheel, and what it depends on, but not this checkout.

    Of what is installed here the libraries are taken as they are; Numba's kernels, too, where they are compiled:
    it goes by the source's date.
    """
    folder = tmp_path_factory.mktemp("installed")
    run(sys.executable, "-m", "venv", "--without-pip", str(folder))
    python = folder / "bin" / "python"
    site = Path(run(str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    run(sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-index", str(wheel))
    libraries = [path for path in sys.path if path.endswith("site-packages")]
    (site / "libraries.pth").write_text("\n".join(libraries), "utf-8")
    for name in files(site):
        shutil.copystat(ROOT / name, site / name)
        cache = (ROOT / name).parent / "__pycache__"
        for kernel in cache.glob(f"{Path(name).stem}.*.nb?") if name.endswith(".py") else ():
            (site / name).parent.joinpath("__pycache__").mkdir(exist_ok=True)
            shutil.copy2(kernel, (site / name).parent / "__pycache__")
    return python


def run(*command: str, cwd: Path | None = None) -> str:
    """Run a command without this checkout on the path; return what it prints."""
    variables = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    done = subprocess.run(command, cwd=cwd, env=variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.release
def test_the_wheel_has_every_file_of_the_packages(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        metadata = archive.read(f"mecanum_slam-{VERSION}.dist-info/METADATA").decode()
    assert names == files(ROOT)
    assert {f"{package}/py.typed" for package in PACKAGES} <= names
    assert "Project-URL: " in metadata and "Typing :: Typed" in metadata


@pytest.mark.release
def test_the_wheel_explores_on_its_own(installed: Path, tmp_path: Path) -> None:
    mecanum = installed.with_name("mecanum")
    assert run(str(mecanum), "--version").strip() == f"mecanum-slam {VERSION}"
    program = "import slam, training; print(slam.__file__, training.__file__)"
    where = run(str(installed), "-c", program, cwd=tmp_path)
    assert where.count(str(installed.parents[1])) == 2 and str(ROOT) not in where
    run(str(mecanum), "explore", "--agent", "ppo-frontier", "--out", "here", cwd=tmp_path)
    assert (tmp_path / "here" / "metrics.json").is_file()
    page = (tmp_path / "here" / "report.html").read_text("utf-8")
    assert "<script>" in page and "</html>" in page
    run(str(mecanum), "doctor", cwd=tmp_path)
    policies = "import agents; [agents.make(name) for name in ('learned-tour', 'ppo', 'ppo-frontier')]"
    run(str(installed), "-c", policies, cwd=tmp_path)
