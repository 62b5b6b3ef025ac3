"""What goes wrong on real machines: each exits with 2 and one clear line, and leaves earlier results as they were."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from learning import environment, published, quick_training, spring

from envs.storage import load, save
from envs.trajectories import Trajectories, TrajectoryError
from gnn.checkpoint import load_model
from gnn.config import TrainConfig
from gnn.metrics import read_metrics
from gnn.train import train
from swarm_mjcf.errors import SpecError
from swarm_mjcf.spec import SceneSpec
from swarmnet.cli import main

SIMULATE = ("simulate", "--preset", "published", "--scenes", "4", "--steps", "12", "--engine", "native")
TRAIN = ("--model", "thesis-ch5", "--horizons", "1", "--stage-steps", "6", "--chunk", "2", "--batch", "4")


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_training():
        yield


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    """A whole file of trajectories."""
    path = tmp_path_factory.mktemp("good") / "data.h5"
    save(path, published())
    return path


def fails(capsys, *arguments: str) -> str:
    assert main(arguments) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.splitlines()
    assert line.startswith("swarmnet: ")
    return line


SCRIPT = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
from gnn.config import PRESETS
from learning import tiny
from swarmnet.cli import main
PRESETS["thesis-ch5"] = tiny("thesis-ch5")
sys.exit(main(sys.argv[2:]))
"""


def with_full_disk(size: int, *arguments: str) -> subprocess.CompletedProcess:
    """`swarmnet ARGUMENTS` in a process that may write no file longer than `size` bytes."""
    command = [sys.executable, "-c", SCRIPT, str(size), *arguments]
    settings = environment()
    del settings["JAX_COMPILATION_CACHE_DIR"]  # JAX warns of what it cannot cache
    return subprocess.run(command, env=settings, capture_output=True, text=True)


def one_line(found: subprocess.CompletedProcess) -> str:
    assert found.returncode == 2, found.stderr
    lines = [line for line in found.stderr.splitlines() if not line.startswith(("simulate ", "train "))]  # progress
    assert len(lines) == 1, found.stderr
    assert lines[0].startswith("swarmnet: ")
    return lines[0]


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# --- places that cannot be written (root may write almost anywhere, but not there) ---


def test_a_folder_that_cannot_be_written(good: Path, capsys):
    assert "/proc/nowhere" in fails(capsys, *SIMULATE, "--out", "/proc/nowhere/d.h5")
    assert "/proc/nowhere" in fails(capsys, "train", str(good), *TRAIN, "--run", "/proc/nowhere/r")
    assert "/proc/nowhere" in fails(capsys, "render", str(good), "--size", "64", "--out", "/proc/nowhere/v.mp4")


def test_a_name_that_a_file_already_has(good: Path, tmp_path: Path, capsys):
    (tmp_path / "taken").write_text("mine")
    assert str(tmp_path / "taken") in fails(capsys, *SIMULATE, "--out", str(tmp_path / "taken" / "d.h5"))
    assert str(tmp_path / "taken") in fails(capsys, "train", str(good), *TRAIN, "--run", str(tmp_path / "taken"))
    assert (tmp_path / "taken").read_text() == "mine"


# --- a full disk ---


def test_a_disk_that_fills_while_simulating(tmp_path: Path):
    line = one_line(with_full_disk(6000, *SIMULATE, "--out", str(tmp_path / "d.h5")))
    assert str(tmp_path / "d.h5") in line
    assert "cannot be written" in line
    assert not [path for path in tmp_path.rglob("*") if path.is_file()], "no half a file may stay"


def test_a_disk_that_fills_while_training_keeps_the_last_checkpoint(good: Path, tmp_path: Path):
    """The first chunks fit; then a run whose files may not be as long as a checkpoint's goes on and fails."""
    run = tmp_path / "run"
    config = TrainConfig(model="thesis-ch5", horizons=(1,), stage_steps=(6,), chunk=2, batch=4, checkpoint_seconds=1e-9)

    class Stopped(Exception):
        pass

    def stop(done: int, total: int, row: dict) -> None:
        raise Stopped

    data = load(good)
    with pytest.raises(Stopped):
        train(config, data.take(slice(1, None)), run, validation=data.take(slice(0, 1)), progress=stop)
    before = load_model(run / "checkpoints")
    checkpoint = tree(run / "checkpoints" / "2")
    largest = max(len(content) for content in checkpoint.values())
    arguments = ("train", str(good), *TRAIN, "--run", str(run), "--checkpoint-seconds", "1e-9", "--validation", "0.1")
    found = with_full_disk(largest // 2, *arguments)
    assert str(run) in one_line(found)
    after = load_model(run / "checkpoints")
    assert after.about["step"] == before.about["step"] == 2
    assert tree(run / "checkpoints" / "2") == checkpoint
    # With room again, the same run goes on to its end.
    train(config, data.take(slice(1, None)), run, validation=data.take(slice(0, 1)))
    assert [row["step"] for row in read_metrics(run / "metrics.jsonl")] == [2, 4, 6]


# --- bad files ---


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def no_hdf5(path: Path) -> None:
    path.write_text("t,id,x,y\n0,1,2,3\n")


def nothing(path: Path) -> None:
    path.write_bytes(b"")


def changed_number(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file["position"][0, 0, 2, 0] += 1


@pytest.mark.parametrize("damage", [cut, no_hdf5, nothing, changed_number], ids=lambda f: f.__name__)
def test_a_bad_file_is_named_by_every_command_that_reads_it(good: Path, tmp_path: Path, damage, capsys):
    path, run = tmp_path / "bad.h5", tmp_path / "run"
    path.write_bytes(good.read_bytes())
    damage(path)
    assert str(path) in fails(capsys, "train", str(path), *TRAIN, "--run", str(run))
    assert str(path) in fails(capsys, "render", str(path), "--out", str(tmp_path / "v.mp4"))
    assert sorted(item.name for item in tmp_path.iterdir()) == ["bad.h5"], "nothing is begun with bad data"


def test_a_run_folder_with_a_damaged_checkpoint_is_named(tmp_path: Path, capsys):
    step = tmp_path / "run" / "checkpoints" / "10"
    step.mkdir(parents=True)
    assert str(step) in fails(capsys, "evaluate", str(tmp_path / "run"))


# --- bad numbers ---


def test_not_a_number_in_trajectories_is_refused_with_its_place():
    data = published()
    position = data.position.copy()
    position[3, 7, 2, 1] = np.nan
    with pytest.raises(TrajectoryError, match=r"position is not finite in 1 of 8 .* scene 3, row 7, node 2"):
        replace(data, position=position)


def test_not_a_number_in_a_file_with_right_checksums_is_refused(tmp_path: Path, capsys):
    """As a program without our checks would write it: only the numbers themselves are wrong."""
    path, data = tmp_path / "nan.h5", published()
    velocity = data.velocity.copy()
    velocity[2, 5, 3, 0] = np.inf
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trajectories, "__post_init__", lambda self: None)
        save(path, replace(data, velocity=velocity))
    line = fails(capsys, "train", str(path), *TRAIN, "--run", str(tmp_path / "run"))
    assert str(path) in line
    assert "velocity is not finite" in line
    assert "scene 2, row 5, node 3" in line
    assert not (tmp_path / "run").exists()


def test_a_loss_that_diverges_is_one_line_and_keeps_the_checkpoint(tmp_path: Path, capsys):
    save(tmp_path / "d.h5", spring())
    arguments = ("train", str(tmp_path / "d.h5"), *TRAIN, "--chunk", "1", "--checkpoint-seconds", "1e-9")
    line = fails(capsys, *arguments, "--learning-rate", "1e30", "--run", str(tmp_path / "run"))
    assert "the loss is" in line
    assert "smaller learning_rate" in line
    step = load_model(tmp_path / "run" / "checkpoints").about["step"]
    assert f"the checkpoint of step {step} stays" in line


# --- impossible scenes ---


def test_a_scene_too_dense_is_refused_before_anything_is_written(tmp_path: Path, capsys):
    crowd = ("--num-agents", "3000", "--scenes", "2", "--engine", "native")
    line = fails(capsys, "simulate", *crowd, "--out", str(tmp_path / "d.h5"))
    assert "too dense" in line
    assert not list(tmp_path.iterdir())


def test_too_few_substeps_are_refused_with_the_number_that_would_do():
    with pytest.raises(SpecError, match="substeps: 3 was given, allowed is at least 15"):
        SceneSpec(agent_radius=1.0, max_speed=10.0, dt=0.3, substeps=3)


# --- interrupted ---


def test_an_interrupted_simulation_goes_on(tmp_path: Path, monkeypatch, capsys):
    """Interrupted after two of three chunks: the same command makes the third alone, and the same file."""
    import envs.simulate as module

    command = (*SIMULATE, "--num-agents", "3", "--chunk", "256", "--scenes", "520")  # blocks of 256
    assert main((*command, "--out", str(tmp_path / "whole.h5"))) == 0
    original, made = module.save, []

    def interrupted(path: Path, chunk) -> None:
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(path)
        original(path, chunk)

    monkeypatch.setattr(module, "save", interrupted)
    assert main((*command, "--out", str(tmp_path / "d.h5"))) == 130
    assert not (tmp_path / "d.h5").exists()
    monkeypatch.setattr(module, "save", lambda path, chunk: (made.append(path), original(path, chunk)))
    assert main((*command, "--out", str(tmp_path / "d.h5"))) == 0
    assert len(made) == len(set(made)) == 3
    one, two = load(tmp_path / "whole.h5"), load(tmp_path / "d.h5")
    np.testing.assert_array_equal(one.position, two.position)
    np.testing.assert_array_equal(one.velocity, two.velocity)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["d.h5", "whole.h5"]
