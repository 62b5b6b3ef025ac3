"""The wheel is whole: installed outside the checkout, the application runs without it."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("swarm_mjcf", "envs", "gnn", "rl", "repair", "swarmnet")


def pip(*arguments: str | Path) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *map(str, arguments)]
    subprocess.run(command, check=True, capture_output=True, text=True)


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel's content, built without network from a copy so that the checkout stays clean."""
    scratch = tmp_path_factory.mktemp("install")
    source, target = scratch / "source", scratch / "target"
    for package in PACKAGES:
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, source)
    pip("wheel", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", scratch, source)
    (wheel,) = scratch.glob("*.whl")
    pip("install", "--no-deps", "--no-index", "--target", target, wheel)
    return target


def run_outside_the_checkout(installed: Path, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    # -S keeps out the .pth of the editable install, which would stand in for whatever the wheel lacks;
    # the third-party packages then come from PYTHONPATH.
    paths = dict.fromkeys([str(installed), sysconfig.get_path("purelib"), sysconfig.get_path("platlib")])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-S", "-P", *map(str, arguments)]
    return subprocess.run(command, cwd=installed.parent, env=environment, capture_output=True, text=True)


def test_every_file_of_the_packages_is_in_the_wheel(installed: Path):
    for package in PACKAGES:
        for file in (ROOT / package).rglob("*"):
            if file.suffix in {".py", ".typed", ".html", ".css"}:
                assert (installed / file.relative_to(ROOT)).is_file(), "list its package in pyproject.toml"


def test_modules_come_from_the_wheel(installed: Path):
    imports = f"import {', '.join(PACKAGES)}; print(*({', '.join(f'{p}.__file__' for p in PACKAGES)},), sep='\\n')"
    result = run_outside_the_checkout(installed, "-c", imports)
    assert result.returncode == 0, result.stderr
    assert [Path(line).parent for line in result.stdout.splitlines()] == [installed / package for package in PACKAGES]


@pytest.mark.parametrize("front_door", [["-m", "swarmnet"], ["bin/swarmnet"]], ids=["module", "script"])
def test_doctor_runs(installed: Path, front_door: list[str]):
    arguments = [installed / part if "/" in part else part for part in front_door]
    result = run_outside_the_checkout(installed, *arguments, "doctor")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.strip()
