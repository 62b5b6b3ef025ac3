"""Checkpoints: what is loaded predicts what was saved, and damage is one clear line, never a traceback."""

import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_same
from learning import INTEGRATOR, initial, random_swarm, scales, tiny

from gnn.checkpoint import CheckpointError, Checkpoints, check_same, describe, load_model
from gnn.config import ModelConfig
from gnn.decode import Integrator, make_predict
from swarm_mjcf.errors import SwarmError

CONFIG = tiny("best")


def weights(seed: int) -> dict:
    history, _, graph = random_swarm(0)
    return initial(CONFIG, scales(), history, graph, seed)


def state(seed: int, step: int) -> dict:
    return {"params": weights(seed), "optimizer": {"m": weights(seed + 100)}, "step": jnp.asarray(step, jnp.int32)}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two checkpoints: step 10 with weights 1, step 20 with weights 2."""
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    about = {"preset": "best", **describe(CONFIG, scales(), INTEGRATOR)}
    checkpoints.save(10, state(1, 10), about)
    checkpoints.save(20, state(2, 20), about)
    checkpoints.close()
    return tmp_path / "checkpoints"


def test_a_run_goes_on_after_a_setting_has_come_into_being():
    """What was stored before a field existed has its default."""
    about = {"seed": 1, **describe(CONFIG, scales(), INTEGRATOR)}
    old = {name: value for name, value in about["model"].items() if name != "edge_bias"}
    check_same(Path("r"), about | {"model": old, "step": 3}, about, model=ModelConfig)
    check_same(Path("r"), about | {"step": 3}, about)
    twice = [about | {"initial": about | {"initial": {"model": model}}} for model in (old, about["model"])]
    check_same(Path("r"), *twice, model=ModelConfig)
    check_same(Path("r"), *reversed(twice), model=ModelConfig)
    unbiased = about | {"model": old | {"edge_bias": False}}
    for had, now, kinds in (
        (about | {"model": old}, about, {}),
        (about | {"model": old}, unbiased, {"model": ModelConfig}),
        (about | {"model": old | {"gone": 1}}, about, {"model": ModelConfig}),
    ):
        with pytest.raises(CheckpointError, match=r"r: holds a run with other settings \(model differ\)"):
            check_same(Path("r"), had, now, **kinds)
    with pytest.raises(CheckpointError, match=r"\(seed, model differ\)"):
        check_same(Path("r"), unbiased | {"seed": 2}, about, model=ModelConfig)


def test_a_loaded_model_predicts_to_the_bit_what_was_saved(folder: Path):
    model = load_model(folder)
    assert model.config == CONFIG
    assert model.integrator == INTEGRATOR
    assert model.about["step"] == 20
    assert model.about["preset"] == "best"
    assert_same(model.scales, scales())
    assert_same(model.params, weights(2))
    history, _, graph = random_swarm(3)
    saved = make_predict(CONFIG, scales(), INTEGRATOR)
    loaded = make_predict(model.config, model.scales, model.integrator)
    one = jax.jit(lambda p: saved(p, history, graph, horizon=2))(weights(2))
    two = jax.jit(lambda p: loaded(p, history, graph, horizon=2))(model.params)
    np.testing.assert_array_equal(one, two)


def test_the_full_state_comes_back_in_its_structure_and_types(folder: Path):
    checkpoints = Checkpoints(folder)
    assert checkpoints.latest() == 20
    assert_same(checkpoints.restore(20, state(7, 0)), state(2, 20))
    assert_same(checkpoints.restore(10, state(7, 0)), state(1, 10))
    checkpoints.close()


def test_the_newest_two_are_kept(folder: Path):
    checkpoints = Checkpoints(folder)
    checkpoints.save(30, state(3, 30), {"preset": "best"})
    checkpoints.close()
    assert sorted(path.name for path in folder.iterdir()) == ["20", "30"]


def test_no_limit_survives_as_infinity(tmp_path: Path):
    unlimited = Integrator(dt=0.1, substeps=1, max_speed=float("inf"), max_acceleration=float("inf"))
    checkpoints = Checkpoints(tmp_path / "c")
    checkpoints.save(1, state(1, 1), describe(CONFIG, scales(), unlimited))
    checkpoints.close()
    assert load_model(tmp_path / "c").integrator == unlimited


# --- damage ---


def truncate(step: Path) -> None:
    for file in step.rglob("*"):
        if file.is_file():
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def garble(step: Path) -> None:
    for file in step.rglob("*"):
        if file.is_file():
            file.write_bytes(b"\xff\x00" * 50)


def empty(step: Path) -> None:
    shutil.rmtree(step)
    step.mkdir()


def without_weights(step: Path) -> None:
    shutil.rmtree(step / "state")


def without_description(step: Path) -> None:
    shutil.rmtree(step / "about")


def half_the_weights(step: Path) -> None:
    """Cuts the largest file alone, so that only reading the numbers can notice."""
    files = sorted((f for f in (step / "state").rglob("*") if f.is_file()), key=lambda f: f.stat().st_size)
    files[-1].write_bytes(files[-1].read_bytes()[: files[-1].stat().st_size // 2])


DAMAGES = [truncate, garble, empty, without_weights, without_description, half_the_weights]
damages = pytest.mark.parametrize("damage", DAMAGES, ids=lambda f: f.__name__)


@damages
def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_is_taken(folder: Path, damage, caplog):
    damage(folder / "20")
    model = load_model(folder)
    assert model.about["step"] == 10
    assert_same(model.params, weights(1))
    (warning,) = [record.getMessage() for record in caplog.records if record.name == "gnn.checkpoint"]
    assert str(folder / "20") in warning
    assert "step 10 is taken instead" in warning
    assert "\n" not in warning


@damages
def test_nothing_but_damage_is_one_clear_line(folder: Path, damage):
    damage(folder / "10")
    damage(folder / "20")
    with pytest.raises(CheckpointError) as error:
        load_model(folder)
    assert str(folder) in str(error.value)
    assert "checkpoint" in str(error.value)
    assert "\n" not in str(error.value)


def test_reading_changes_nothing_in_the_folder(folder: Path):
    """A training may run beside us: its unfinished save must stay."""
    unfinished = folder / "30.orbax-checkpoint-tmp"
    unfinished.mkdir()
    before = sorted(folder.rglob("*"))
    assert load_model(folder).about["step"] == 20
    assert sorted(folder.rglob("*")) == before


def test_leftovers_of_an_interrupted_save_do_not_count_and_go_when_training_goes_on(folder: Path):
    unfinished = folder / "30.orbax-checkpoint-tmp"
    shutil.copytree(folder / "20", unfinished)
    checkpoints = Checkpoints(folder)
    assert checkpoints.latest() == 20
    checkpoints.save(30, state(3, 30), {"preset": "best"})
    checkpoints.close()
    assert not unfinished.exists()
    assert sorted(path.name for path in folder.iterdir()) == ["20", "30"]


def test_no_folder_an_empty_folder_and_a_file_are_told_apart(tmp_path: Path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("not a folder")
    for name, message in (("none", "no such"), ("empty", "holds no whole checkpoint"), ("file", "no such")):
        with pytest.raises(CheckpointError, match=message):
            load_model(tmp_path / name)


def test_a_folder_of_something_else_is_refused(tmp_path: Path):
    (tmp_path / "7").mkdir()
    (tmp_path / "7" / "photo.txt").write_text("holiday")
    (tmp_path / "notes").mkdir()
    with pytest.raises(CheckpointError):
        load_model(tmp_path)


def test_a_place_that_cannot_be_written_is_one_clear_line():
    with pytest.raises(SwarmError, match="/proc/nowhere") as error:
        Checkpoints("/proc/nowhere/checkpoints").save(1, state(1, 1), {})
    assert "\n" not in str(error.value)
