"""Writes the notebooks beside this file anew: each script's cells, executed. `python examples/execute.py [name ...]`"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

HERE = Path(__file__).parent
SCRIPTS = ("rl_user", "mujoco_user", "collective_user")


def notebook_of(script: str) -> nbformat.NotebookNode:
    """Cells of a script: `# %% [markdown]` begins text, `# %%` code."""
    cells = []
    for part in ("\n" + script).split("\n# %%")[1:]:
        head, _, body = part.partition("\n")
        if head.strip() == "[markdown]":
            lines = (line.removeprefix("#").removeprefix(" ") for line in body.strip().splitlines())
            cells.append(new_markdown_cell("\n".join(lines)))
        else:
            cells.append(new_code_cell(body.strip()))
    for number, cell in enumerate(cells):
        cell["id"] = f"cell-{number}"  # the same cells give the same file
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel, "language_info": {"name": "python"}})


def execute(name: str) -> Path:
    """Runs the cells of one script in a kernel of its own, in an empty folder, and saves them with what they gave."""
    notebook = notebook_of((HERE / f"{name}.py").read_text())
    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": folder}}, record_timing=False)
        client.execute()
    path = HERE / f"{name}.ipynb"
    notebook.metadata["language_info"] = {"name": "python"}
    part = path.with_suffix(".part")
    nbformat.write(notebook, part)
    part.replace(path)
    return path


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for chosen in sys.argv[1:] or SCRIPTS:
        print(execute(chosen).name, flush=True)
