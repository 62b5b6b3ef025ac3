"""Benchmarks measure what they say: bodies meet, batches are as asked, results come in the common format."""

import json

import pytest

from swarmnet.bench_throughput import AGENTS, EPISODE, bench_throughput
from swarmnet.cli import main


def test_throughput_counts_real_contacts_and_names_what_it_ran():
    rows = list(bench_throughput(("native",), (4, 8), (1,), episodes=2))
    assert [(row.engine, row.scenes, row.substeps) for row in rows] == [("native", 4, 1), ("native", 8, 1)]
    for row in rows:
        assert 0 < row.contact_states < row.scenes * EPISODE * 2 * AGENTS
        assert row.control_steps_per_second > 0
        assert row.compile_seconds > 0


def test_the_command_writes_the_common_format(tmp_path, capsys):
    file = tmp_path / "throughput.json"
    arguments = ["--engine", "native", "--batch", "4", "--substeps", "2", "--json", str(file)]
    assert main(["bench", "throughput", *arguments]) == 0
    printed = capsys.readouterr().out
    document = json.loads(file.read_text())
    assert document["name"] == "bench-throughput"
    cells = {(row["row"], row["column"]): row["value"] for row in document["rows"]}
    rate = cells["native", "S=4 k=2 scene-steps/s"]
    assert cells["native", "S=4 k=2 physics steps/s"] == pytest.approx(2 * rate)
    assert f"throughput.native.s4.k2.scene_steps_s {rate:.4g}" in printed
