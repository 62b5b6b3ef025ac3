"""The arrows between the packages hold, and breaking one is noticed."""

import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("swarm_mjcf", "envs", "gnn", "rl", "repair", "swarmnet")


def lint_imports(tree: Path) -> subprocess.CompletedProcess[str]:
    # As the installed script does. It puts the current folder first on sys.path: a copy is judged by its own modules.
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    command = [sys.executable, "-c", code, "--no-cache"]
    return subprocess.run(command, cwd=tree, capture_output=True, text=True)


@pytest.fixture
def copy_of_tree(tmp_path: Path) -> Path:
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def test_the_tree_keeps_every_contract():
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout + result.stderr
    assert " 0 broken" in result.stdout


@pytest.mark.parametrize(
    ("module", "bad_import", "contract"),
    [
        ("swarm_mjcf/spec.py", "gnn", "Each package imports only those to its left"),
        ("rl/__init__.py", "repair", "Each package imports only those to its left"),
        ("swarm_mjcf/spec.py", "jax.numpy", "swarm_mjcf knows nothing of learning, JAX or data files"),
        ("envs/config.py", "flax.linen", "envs knows nothing of networks"),
        ("gnn/config.py", "mujoco.mjx", "gnn knows nothing of physics engines"),
        ("rl/__init__.py", "cvxpy", "rl knows nothing of physics engines or solvers"),
        ("repair/__init__.py", "mujoco", "repair knows nothing of physics engines"),
    ],
)
def test_a_bad_import_breaks_its_contract_by_name(copy_of_tree: Path, module: str, bad_import: str, contract: str):
    with (copy_of_tree / module).open("a") as file:
        file.write(f"\nimport {bad_import}\n")

    result = lint_imports(copy_of_tree)

    assert result.returncode == 1, result.stdout + result.stderr
    assert f"{contract} BROKEN" in " ".join(result.stdout.split())
    assert " 1 broken" in result.stdout


@pytest.mark.parametrize("module", ["swarm_mjcf.spec", "envs.config", "gnn.config", "swarmnet.config"])
def test_configs_import_only_the_standard_library_and_each_other(module: str):
    """So that every `--help` is fast."""
    code = f"""
        import sys
        before = set(sys.modules)
        import {module}
        roots = {{name.partition(".")[0] for name in set(sys.modules) - before}}
        print(*sorted(roots - set(sys.stdlib_module_names) - {set(PACKAGES)}))
    """
    result = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=True)
    assert result.stdout.split() == []
