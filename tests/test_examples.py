"""The examples run, and the notebooks beside them are those scripts, executed."""

import ast
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"
SMALL = {"rl_user": "4", "mujoco_user": "2", "collective_user": "2"}


@pytest.mark.parametrize("name", SMALL)
def test_the_script_runs_and_leaves_its_picture(name: str, tmp_path: Path):
    environment = os.environ | {"MPLBACKEND": "agg"}
    command = [sys.executable, "-W", "error::UserWarning", str(EXAMPLES / f"{name}.py"), SMALL[name]]
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert len(result.stdout.splitlines()) >= 5


def cells_of(name: str) -> list[str]:
    """The cells that `execute.py` makes of a script."""
    spec = importlib.util.spec_from_file_location("execute", EXAMPLES / "execute.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return [cell["source"] for cell in module.notebook_of((EXAMPLES / f"{name}.py").read_text()).cells]


@pytest.mark.parametrize("name", SMALL)
def test_the_notebook_is_the_script_executed(name: str):
    path = EXAMPLES / f"{name}.ipynb"
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert [cell["source"] for cell in notebook.cells] == cells_of(name), "python examples/execute.py"
    assert notebook.metadata["kernelspec"]["name"] == "python3"
    assert path.stat().st_size < 300_000
    code = [cell for cell in notebook.cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    outputs = [output for cell in code for output in cell["outputs"]]
    kinds = {output["output_type"] for output in outputs}
    assert "error" not in kinds
    assert not any(output.get("name") == "stderr" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    for cell in code:
        ast.parse(cell["source"])
    text = [output.get("text", "") + output.get("data", {}).get("text/plain", "") for output in outputs]
    assert not re.search(r"(^|[\s\"'])/(home|root|tmp|usr|opt|Users|private)/", "\n".join(text))
