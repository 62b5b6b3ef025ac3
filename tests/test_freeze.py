"""Freezing: patterns over paths, an optimizer that never sees what is frozen, and training around it."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_same
from learning import quick_training, spring

from gnn.checkpoint import Model, load_model
from gnn.config import TrainConfig
from gnn.freeze import free_leaves, freeze, frozen, paths_of
from gnn.train import prepare, train
from swarm_mjcf.errors import SpecError, SwarmError

PARAMS = {
    "edge": {"goal": {"kernel": jnp.asarray([1.0, -2.0])}, "agent": {"kernel": jnp.asarray([3.0])}},
    "readout": {"bias": jnp.asarray([0.5]), "kernel": jnp.asarray([[4.0, -1.0]])},
}
SHORT = TrainConfig(model="thesis-ch5", horizons=(1,), stage_steps=(6,), chunk=2, batch=4, checkpoint_seconds=1e-9)


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


@pytest.mark.parametrize(
    ("patterns", "expected"),
    [
        ((), [False, False, False, False]),
        (("edge/*",), [True, True, False, False]),
        (("edge/goal/*", "*/bias"), [False, True, True, False]),
        (("*kernel",), [True, True, False, True]),
        (("readout/kernel",), [False, False, False, True]),
    ],
)
def test_patterns_choose_leaves_by_path(patterns, expected):
    assert paths_of(PARAMS) == ["edge/agent/kernel", "edge/goal/kernel", "readout/bias", "readout/kernel"]
    mask = frozen(PARAMS, patterns)
    assert jax.tree.structure(mask) == jax.tree.structure(PARAMS)
    assert jax.tree.leaves(mask) == expected
    assert len(free_leaves(PARAMS, mask)) == expected.count(False)


def test_a_pattern_that_matches_nothing_lists_the_paths():
    with pytest.raises(SpecError, match=r"(?s)edge/wall.*edge/agent/kernel.*readout/kernel"):
        frozen(PARAMS, ("edge/*", "edge/wall/*"))
    with pytest.raises(SpecError, match="leave something to train"):
        frozen(PARAMS, ("*",))


def test_the_optimizer_does_with_the_free_leaves_what_it_does_where_there_are_no_others():
    """Clipping by the global norm, weight decay and Adam's moments: a frozen part with a huge gradient changes none."""
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adamw(0.1, weight_decay=0.5))
    mask = frozen(PARAMS, ("edge/*",))
    whole, alone = freeze(optimizer, mask), optimizer
    params, only = PARAMS, {"readout": PARAMS["readout"]}
    state, lone = whole.init(params), alone.init(only)
    for step in range(1, 4):
        gradient = jax.tree.map(lambda x, step=step: step * x + 1, params)
        gradient["edge"] = jax.tree.map(lambda x: 1e6 * jnp.ones_like(x), gradient["edge"])
        updates, state = whole.update(gradient, state, params)
        lonely, lone = alone.update({"readout": gradient["readout"]}, lone, only)
        params, only = optax.apply_updates(params, updates), optax.apply_updates(only, lonely)
    assert_same(params["edge"], PARAMS["edge"])
    assert_same(params["readout"], only["readout"])
    assert not np.array_equal(params["readout"]["bias"], PARAMS["readout"]["bias"])


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> Model:
    return train(SHORT, spring(), tmp_path_factory.mktemp("first"))


@pytest.mark.parametrize("average", [0.0, 0.99])
def test_tuning_moves_the_free_parts_alone_and_keeps_the_scales(tmp_path: Path, first: Model, average: float):
    config = replace(SHORT, average=average, seed=5)
    model = train(config, spring(seed=3, k=2.5), tmp_path, initial=first, freeze=("edge/*", "node/layer0/*"))
    assert_same(model.params["edge"], first.params["edge"])
    assert_same(model.params["node"]["layer0"], first.params["node"]["layer0"])
    for free in (("node", "layer1"), ("readout", "layer0")):
        now, before = (source[free[0]][free[1]]["kernel"] for source in (model.params, first.params))
        assert not np.array_equal(now, before)
    assert_same(model.scales, first.scales)
    found = load_model(tmp_path / "checkpoints")
    assert found.about["freeze"] == ["edge/*", "node/layer0/*"]
    assert found.about["initial"]["step"] == 6
    assert found.about["initial"]["train"] == first.about["train"]
    again = train(config, spring(seed=3, k=2.5), tmp_path, initial=first, freeze=("edge/*", "node/layer0/*"))
    assert_same(again.params, model.params)


def test_parts_can_be_locked_as_they_were_drawn(tmp_path: Path, first: Model):
    """The control experiment of section 4.2: edge functions at their random beginning."""
    drawn = prepare(SHORT, spring()).start()["params"]
    locked = train(SHORT, spring(), tmp_path, freeze=("edge/*",)).params
    assert_same(locked["edge"], drawn["edge"])
    assert not np.array_equal(locked["readout"]["layer0"]["kernel"], drawn["readout"]["layer0"]["kernel"])
    assert not np.array_equal(
        first.params["edge"]["goal"]["layer0"]["kernel"], drawn["edge"]["goal"]["layer0"]["kernel"]
    )


def test_what_does_not_fit_is_refused(tmp_path: Path, first: Model):
    with pytest.raises(SpecError, match="thesis-ch5"):
        train(replace(SHORT, model="best"), spring(), tmp_path / "run", initial=first)
    with pytest.raises(SwarmError, match=r"trained at dt 0\.1 s, the data have rows 0\.2 s apart; tuning"):
        train(SHORT, replace(spring(), dt=0.2), tmp_path / "run", initial=first)
    lacking = replace(first, params={name: part for name, part in first.params.items() if name != "edge"})
    with pytest.raises(SpecError, match="edge/goal/layer0/kernel"):
        train(SHORT, spring(), tmp_path / "run", initial=lacking)
    with pytest.raises(SpecError, match=r"matches some of .*edge/goal"):
        train(SHORT, spring(), tmp_path / "run", freeze=("edges/*",))
    assert not (tmp_path / "run").exists()


def test_tuning_takes_the_substeps_of_its_data(first: Model):
    assert prepare(SHORT, replace(spring(), substeps=4), initial=first).integrator.substeps == 4
