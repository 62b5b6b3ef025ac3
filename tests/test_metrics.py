"""Metrics: rows a reader sees at once, dropped after a checkpoint on resume, whole after any kill."""

import json
from pathlib import Path

from gnn.metrics import Metrics, read_metrics


def write(folder: Path, steps, *, after_step: int = 0, loss: float = 1.0) -> None:
    metrics = Metrics(folder, after_step=after_step)
    for step in steps:
        metrics.write(step, loss=loss)
    metrics.close()


def test_rows_are_json_lines_in_order_and_visible_before_the_end(tmp_path: Path):
    metrics = Metrics(tmp_path / "run", after_step=0)
    metrics.write(10, loss=0.5, horizon=1)
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines] == [{"step": 10, "loss": 0.5, "horizon": 1}]
    metrics.write(20, loss=0.25, horizon=2)
    metrics.close()
    assert [row["step"] for row in read_metrics(metrics.path)] == [10, 20]
    assert list((tmp_path / "run" / "tensorboard").iterdir())


def test_resuming_drops_what_came_after_the_checkpoint(tmp_path: Path):
    write(tmp_path, [10, 20, 30])
    write(tmp_path, [20, 30, 40], after_step=10, loss=2.0)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [(row["step"], row["loss"]) for row in rows] == [(10, 1.0), (20, 2.0), (30, 2.0), (40, 2.0)]


def test_a_fresh_start_drops_everything(tmp_path: Path):
    write(tmp_path, [10, 20])
    write(tmp_path, [5], after_step=0)
    assert [row["step"] for row in read_metrics(tmp_path / "metrics.jsonl")] == [5]


def test_a_last_line_cut_short_is_no_row_and_does_not_stay(tmp_path: Path):
    write(tmp_path, [10, 20])
    path = tmp_path / "metrics.jsonl"
    whole = path.read_text()
    for cut in range(1, len(whole.splitlines()[-1]) + 1):
        path.write_text(whole[:-cut])
        assert [row["step"] for row in read_metrics(path)] == ([10, 20] if cut == 1 else [10])
    write(tmp_path, [20, 30], after_step=10)
    assert [json.loads(line)["step"] for line in path.read_text().splitlines()] == [10, 20, 30]


def test_a_whole_last_line_without_its_end_does_not_swallow_the_next(tmp_path: Path):
    write(tmp_path, [10, 20])
    path = tmp_path / "metrics.jsonl"
    path.write_text(path.read_text()[:-1])
    write(tmp_path, [30], after_step=20)
    assert [row["step"] for row in read_metrics(path)] == [10, 20, 30]


def test_no_file_has_no_rows(tmp_path: Path):
    assert read_metrics(tmp_path / "none.jsonl") == []
