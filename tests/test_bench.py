"""Benchmarks measure what they say: bodies meet, batches are as asked, results come in the common format."""

import json
from dataclasses import replace
from types import SimpleNamespace

import learning
import numpy as np
import pytest

from gnn.checkpoint import Model
from gnn.config import PRESETS
from gnn.decode import Integrator
from repair.errors import Status
from repair.network import Situations
from repair.weight_box import Polished
from swarmnet.bench_repair import (
    GAP,
    Part,
    Proof,
    Rotation,
    Study,
    edge_function,
    last_layer,
    loop_parts,
    rotations,
    thesis,
)
from swarmnet.bench_throughput import AGENTS, EPISODE, bench_throughput
from swarmnet.cli import main
from swarmnet.figures import svg
from swarmnet.figures_gaps import gaps


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


@pytest.fixture(scope="module")
def study() -> Study:
    """A tiny network and agents that fly towards an obstacle faster and slower, some of which it does not stop."""
    config = replace(PRESETS["thesis-ch5-small"], edge_hidden=(3, 3), message=2, node_hidden=(4,))
    history, _, graph = learning.random_swarm(0)
    scales, kinematics = learning.scales(), Integrator(dt=0.5, substeps=2, max_speed=5.0, max_acceleration=4.0)
    params = learning.initial(config, scales, history, graph)
    rng = np.random.default_rng(0)
    angle, away, speed = rng.uniform(0, 2 * np.pi, 60), rng.uniform(1.7, 3, 60), rng.uniform(0.2, 1.6, 60)
    side = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places = {"goal": np.array([[3.0, 2.0, 0, 0]]), "obstacle": np.zeros((1, 4)), "agent": np.array([[-9.0, 0, 0, 1]])}
    situations = Situations(
        own=np.concatenate([away[:, None] * side, -speed[:, None] * side], axis=1),
        senders={name: np.repeat(at[None], 60, axis=0) for name, at in places.items()},
        present={name: np.ones((60, len(at)), bool) for name, at in places.items()},
    )
    model = Model(config, scales, kinematics, params, {"preset": "thesis-ch5-small"})
    return Study(model, situations, SimpleNamespace(agent_radius=0.5, obstacle_radius=1.0))


def test_proofs_of_repair(study):
    proofs = [
        *last_layer(study, 20.0, rows=(5, 15), margins=(0.0,)),
        *thesis(study, 20.0, rows=(5,), boxes=(0.1, 0.3)),
        *(found for found in edge_function(study, 20.0, rows=(2, 4), boxes=(0.01,)) if isinstance(found, Proof)),
    ]
    families = [proof.family for proof in proofs]
    assert families == [
        *["last layer, obstacles"] * 2, *["last layer, obstacles and agents"] * 2, *["thesis"] * 2,
        *["edge function"] * 2,
    ]  # fmt: skip
    assert [proof.rows for proof in proofs if proof.family == "edge function"] == [2, 4]
    for proof in proofs:
        assert proof.bound <= proof.incumbent + 1e-9
        assert proof.proven == (proof.gap <= GAP * (1 + 1e-9))
        assert 0 < proof.seconds < 20
    assert all(proof.proven for proof in proofs if proof.family == "thesis")
    drawn = svg(gaps(proofs))
    for family in set(families):
        assert family in drawn
    assert svg(gaps([])).startswith("<?xml")


def test_boxes_that_took_too_long_are_not_tried_with_more_rows(study, monkeypatch):
    def unproven(params, problem, *, radius, **_):
        gap = 0.3 if radius > 0.01 else 0.001
        size = {"rows": 1, "columns": 1, "binaries": 1, "coefficients": 1}
        return Polished(
            params=params, status=Status.FEASIBLE, start=1.0, incumbent=1.0, bound=1 - gap, gap=gap, violated=0,
            seconds=1.0, nodes=0, size=size,
        )  # fmt: skip

    monkeypatch.setattr("swarmnet.bench_repair.polish", unproven)
    found = list(edge_function(study, 1.0, rows=(2, 4), boxes=(0.01, 0.02, 0.05)))
    assert [isinstance(item, Proof) for item in found] == [True, True, False, True, False, False]
    assert "0.05 is left out from 2 rows on" in found[2]
    assert "0.02 is left out from 4 rows on" in found[4]


def test_the_rotation_over_layers_lowers_the_merit(study):
    alone, every = rotations(study, 5.0, rows=(6,))
    assert (alone.layers, every.layers) == ("readout alone", "all layers")
    for found in (alone, every):
        assert found.rows == 6
        assert found.broken >= 3  # half are drawn from those that break it
        assert found.after < found.before == alone.before  # its targets are its own actions: there is only price to pay
        assert 1 <= found.accepted <= found.steps
        assert found.left <= found.broken
    assert every.steps > alone.steps


def test_parts_of_a_round(study):
    parts = list(loop_parts(study, steps=250))
    assert [part.name for part in parts] == ["screening", "250 Adam steps", "quadratic program"]
    assert all(isinstance(part, Part) and part.seconds > 0 for part in parts)


def test_repair_is_printed_and_written(study, tmp_path, capsys, monkeypatch):
    proof = Proof(
        family="edge function", rows=20, setting="box", value=0.02, seconds=1.5, gap=0.008, status="optimal",
        binaries=7, size=(3, 4), incumbent=2.0, bound=1.984,
    )  # fmt: skip
    monkeypatch.setattr("swarmnet.commands.bench.network", lambda *_: study.model)
    turned = Rotation(
        layers="all layers",
        rows=20,
        box=0.02,
        seconds=9.0,
        before=3.0,
        after=2.5,
        steps=10,
        accepted=4,
        broken=9,
        left=2,
    )
    found = [Part("roll-out", 5.0), "left out", proof, turned]
    monkeypatch.setattr("swarmnet.commands.bench.bench_repair", lambda *_: found)
    file = tmp_path / "bench-repair.json"
    assert main(["bench", "repair", "--json", str(file)]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert "repair.edge_function.r20.box0.02.gap_percent 0.8" in [line.strip() for line in printed]
    assert "left out" in printed
    cells = {(row["row"], row["column"]): row for row in json.loads(file.read_text())["rows"]}
    assert cells["edge function", "R=20 box=0.02 seconds"]["status"] == "optimal"
    assert cells["edge function", "R=20 box=0.02 binaries"]["value"] == 7
    assert cells["rotation, all layers", "R=20 box=0.02 merit"]["value"] == 2.5
    assert "repair.rotation.all_layers.r20.box0.02.rows_left_violated 2" in printed
    assert (tmp_path / "bench-repair.svg").read_text().startswith("<?xml")
