"""The documents do not lie: their code runs, and the results page is what the committed results say."""

import json
import re
from pathlib import Path

import pytest

from swarmnet.results import _command, render_page

ROOT = Path(__file__).parent.parent


def test_the_guides_code_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/guide.md").read_text(), re.DOTALL)
    assert len(blocks) >= 5
    scope: dict = {}
    for block in blocks:
        exec(compile(block, "docs/guide.md", "exec"), scope)
    assert "(64, 21, 5, 2)" in capsys.readouterr().out
    assert (tmp_path / "scene.xml").exists()
    assert scope["recording"].position.shape == (64, 21, 5, 2)
    assert scope["scores"].nll.shape == (5,)
    assert all(0 < share < 1 for share in scope["scores"].coverage_90)


def test_the_code_of_the_interfaces_page_runs(capsys: pytest.CaptureFixture) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/interfaces.md").read_text(), re.DOTALL)
    assert len(blocks) >= 6
    scope: dict = {}
    for block in blocks:
        exec(compile(block, "docs/interfaces.md", "exec"), scope)
    said = capsys.readouterr().out
    assert f"(8, 4, {len(scope['core'].observation.labels)}) (8,) (8, 4)" in said
    assert f"(4, {len(scope['core'].observation.labels)}) [" in said


def test_the_results_page_is_rendered_from_the_committed_results() -> None:
    assert (ROOT / "docs/results.md").read_text() == render_page(ROOT / "docs/results")


def test_committed_results_name_no_folder_of_a_machine() -> None:
    for path in sorted((ROOT / "docs/results").glob("*.json")):
        assert not re.search(r"(?<![\w.])/\w+/", json.loads(path.read_text())["command"]), path


def test_a_command_says_paths_from_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = _command(["bench", "x", "--run", str(tmp_path / "runs" / "a"), "--data", "/elsewhere/b", "--json", "c.json"])
    assert said == "swarmnet bench x --run runs/a --data b"


def test_commands_that_the_documents_name_exist() -> None:
    from gnn.config import PRESETS
    from swarmnet.cli import _MODULES

    known = {kind.__name__.lower() for kind in _MODULES}
    known |= {name.split("-")[0] for name in PRESETS}  # rows of tables: "swarmnet best"
    for path in (ROOT / "README.md", ROOT / "docs/guide.md", ROOT / "docs/interfaces.md", ROOT / "docs/results.md"):
        named = set(re.findall(r"(?<![\w/])swarmnet ([a-z]+)", path.read_text()))
        assert named <= known, path
