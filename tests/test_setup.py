"""tools/setup.sh finds a Python by running candidates, and makes .venv whole from whatever state it is in."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SH = shutil.which("sh") or "/bin/sh"

pytestmark = pytest.mark.skipif(os.name != "posix", reason="tools/setup.sh is for POSIX systems")

FAILING_SHIM = "echo 'shim: python3.12: command not found' >&2; exit 127"
OLD_PYTHON = """echo 'is Python 3.9' >&2; exit 1"""  # what the probe says there
WORKING = f'exec "{sys.executable}" "$@"'


def script(path: Path, body: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!{SH}\n{body}\n")
    path.chmod(0o755)
    return path


def find_python(*, path: Path, search: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    environment |= {"PATH": str(path), "SETUP_SEARCH": search, "HOME": str(path)}
    command = [SH, str(ROOT / "tools" / "setup.sh"), "--find-python"]
    return subprocess.run(command, env=environment, capture_output=True, text=True)


def is_this_python(result: subprocess.CompletedProcess[str]) -> bool:
    return result.returncode == 0 and Path(result.stdout.strip()).samefile(Path(sys.executable).resolve())


def test_a_shim_may_warn_before_it_answers(tmp_path: Path):
    script(tmp_path / "python3.12", f'echo "WARN missing: node" >&2\nexec {sys.executable} "$@"')
    assert is_this_python(find_python(path=tmp_path))


def test_a_failing_shim_and_an_old_python_are_passed_over(tmp_path: Path):
    script(tmp_path / "python3.12", FAILING_SHIM)
    script(tmp_path / "python3.13", OLD_PYTHON)
    script(tmp_path / "python3", WORKING)
    assert is_this_python(find_python(path=tmp_path))


def test_folders_beyond_path_are_searched(tmp_path: Path):
    script(tmp_path / "shims" / "python3.12", FAILING_SHIM)
    script(tmp_path / "with space" / "3.9.1" / "bin" / "python3", OLD_PYTHON)
    script(tmp_path / "with space" / "3.12.1" / "bin" / "python3", WORKING)
    assert is_this_python(find_python(path=tmp_path / "shims", search=f"/nowhere:{tmp_path}/with space/*/bin"))


def test_the_named_python_comes_first(tmp_path: Path):
    script(tmp_path / "python3.12", FAILING_SHIM)
    named = script(tmp_path / "elsewhere" / "mine", WORKING)
    result = find_python(path=tmp_path, PYTHON=str(named))
    assert is_this_python(result)
    assert result.stderr == ""


def test_without_any_it_says_what_was_tried_and_what_to_install(tmp_path: Path):
    shim = script(tmp_path / "python3.12", FAILING_SHIM)
    old = script(tmp_path / "python3", OLD_PYTHON)
    result = find_python(path=tmp_path, PYTHON="/nowhere/python")
    assert result.returncode == 2
    assert result.stdout == ""
    assert f"{shim}: shim: python3.12: command not found" in result.stderr
    assert f"{old}: is Python 3.9" in result.stderr
    assert "/nowhere/python" in result.stderr
    assert "apt install python3.12" in result.stderr


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout whose Python makes an environment that only notes what pip is asked for, in the file `pip-calls`."""
    root = tmp_path / "a checkout"
    shutil.copytree(ROOT / "tools", root / "tools")
    (root / "requirements.lock").write_text("numpy==2.0\n")
    (root / "pyproject.toml").write_text("")
    script(
        tmp_path / "fake-python",
        'case "$1 ${2:-}" in\n'
        f'"-c "*) echo "{tmp_path}/fake-python" ;;\n'
        '"-V "*) echo Python 3.12.0 ;;\n'
        '"-m venv") rm -rf .venv; mkdir -p .venv/bin; cp "$0" .venv/bin/python ;;\n'
        '"-m pip") echo "$*" >>pip-calls; if [ -f pip-fails ]; then cat pip-fails; exit 1; fi ;;\n'
        "esac",
    )
    return root


def set_up(checkout: Path) -> tuple[subprocess.CompletedProcess[str], list[str]]:
    """Runs the set-up; returns its result and the calls of pip that it made."""
    calls = checkout / "pip-calls"
    calls.unlink(missing_ok=True)
    environment = {**os.environ, "PYTHON": str(checkout.parent / "fake-python")}
    command = [SH, str(checkout / "tools" / "setup.sh")]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    return result, calls.read_text().splitlines() if calls.exists() else []


def test_the_second_set_up_is_silent_and_idle(checkout: Path):
    result, calls = set_up(checkout)
    assert result.returncode == 0, result.stderr
    assert ["requirements.lock" in call for call in calls] == [True, False]
    result, calls = set_up(checkout)
    assert (result.returncode, result.stdout, result.stderr, calls) == (0, "", "", [])


@pytest.mark.parametrize("damage", ["no stamp", "new lock", "no python", "moved"])
def test_an_incomplete_or_outdated_environment_is_rebuilt(checkout: Path, damage: str):
    set_up(checkout)
    match damage:
        case "no stamp":  # the state that an interrupted install leaves
            (checkout / ".venv" / "packages.stamp").unlink()
        case "new lock":
            (checkout / "requirements.lock").write_text("numpy==2.1\n")
        case "no python":  # the Python it was made with was removed
            (checkout / ".venv" / "bin" / "python").unlink()
        case "moved":  # the scripts in .venv name its folder
            checkout = checkout.rename(checkout.with_name("elsewhere"))
    left_over = checkout / ".venv" / "left-over"
    left_over.touch()
    result, calls = set_up(checkout)
    assert result.returncode == 0, result.stderr
    assert len(calls) == 2
    assert not left_over.exists()


def test_a_new_pyproject_only_reinstalls_the_project(checkout: Path):
    set_up(checkout)
    (checkout / "pyproject.toml").write_text("[project]\n")
    result, calls = set_up(checkout)
    assert result.returncode == 0, result.stderr
    assert [call.split()[-2:] for call in calls] == [["--editable", "."]]


@pytest.mark.parametrize(
    ("log", "cause"),
    [
        ("ERROR: Failed to establish a new connection: Temporary failure in name resolution", "could not be reached"),
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "disk is full"),
    ],
)
def test_a_failed_install_names_the_cause_and_is_resumed(checkout: Path, log: str, cause: str):
    (checkout / "pip-fails").write_text(log + "\n")
    result, _ = set_up(checkout)
    assert result.returncode == 1
    assert log in result.stderr
    assert cause in result.stderr

    (checkout / "pip-fails").unlink()
    result, calls = set_up(checkout)
    assert result.returncode == 0, result.stderr
    assert len(calls) == 2
