"""Training metrics as JSON lines and for TensorBoard; on resume, rows after the checkpoint are dropped."""

import json
from pathlib import Path

from tensorboardX import SummaryWriter

from swarm_mjcf.whole import WholeFile


class Metrics:
    """Appends rows `{"step": ..., name: value}` to `folder/metrics.jsonl` and to TensorBoard files beside it."""

    def __init__(self, folder: str | Path, *, after_step: int) -> None:
        self.path = Path(folder) / "metrics.jsonl"
        kept = [row for row in read_metrics(self.path) if row["step"] <= after_step]
        with WholeFile(self.path) as part:
            part.write_text("".join(json.dumps(row) + "\n" for row in kept))
        self._file = self.path.open("a")
        self._board = SummaryWriter(str(self.path.parent / "tensorboard"), purge_step=after_step + 1)

    def write(self, step: int, **values: float | int) -> None:
        """Adds a row and makes sure that a reader sees it."""
        self._file.write(json.dumps({"step": step, **values}) + "\n")
        self._file.flush()
        for name, value in values.items():
            self._board.add_scalar(name, value, step)

    def close(self) -> None:
        """Flushes both."""
        self._file.close()
        self._board.close()


def read_metrics(path: str | Path) -> list[dict]:
    """Rows of a metrics file in order; a last line cut short by a kill is left out."""
    path = Path(path)
    if not path.exists():
        return []
    rows = []
    for line in path.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            break
    return rows
