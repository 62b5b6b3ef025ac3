"""Data generation: the file depends on the settings alone, whatever the chunks, threads, interruptions and engine."""

import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_same_trajectories

from envs import simulate as simulation
from envs.config import SimulateConfig, clear
from envs.experts.config import ChaserConfig, Interaction
from envs.plain import from_plain, plain
from envs.simulate import block_of, fingerprint, simulate, simulate_in_memory
from envs.storage import load, save
from envs.trajectories import ARRAYS, Trajectories, TrajectoryError
from swarm_mjcf.errors import SpecError

ROOT = Path(__file__).parents[1]
BLOCK = 256
"""Scenes that are computed together for few agents."""
SCENES = 2 * BLOCK + 25
CONFIG = SimulateConfig(preset="published", scenes=SCENES, steps=3, num_agents=3, seed=4, engine="native", chunk=8)


@pytest.fixture(scope="module")
def expected() -> Trajectories:
    return simulate_in_memory(CONFIG)


def assert_same_arrays(first: Trajectories, second: Trajectories) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def test_a_file_holds_what_was_asked_for_and_where_it_comes_from(tmp_path: Path, expected: Trajectories):
    seen = []
    header = simulate(CONFIG, tmp_path / "swarm.h5", progress=lambda done, total: seen.append((done, total)))
    assert (header.scenes, header.rows, header.nodes) == (SCENES, 4, 1 + 1 + 3)
    assert seen == [(done, SCENES) for done in (0, BLOCK, 2 * BLOCK, SCENES)]
    assert header.provenance["simulate"]["seed"] == 4
    assert header.provenance["engine"] == "native"
    assert header.provenance["world"]["scene"]["contacts"] is False
    assert "mujoco" in header.provenance["versions"]
    assert [p.name for p in tmp_path.iterdir()] == ["swarm.h5"]  # no parts left
    assert_same_trajectories(load(tmp_path / "swarm.h5"), expected)


def test_a_file_of_the_same_settings_is_kept(tmp_path: Path, expected: Trajectories):
    path = tmp_path / "swarm.h5"
    save(path, expected)
    (tmp_path / "swarm.h5.parts").mkdir()  # of a call that was killed when the file was whole
    written = path.stat()
    header = simulate(replace(CONFIG, chunk=5, threads=1), path, progress=lambda *_: pytest.fail("it ran again"))
    assert header.scenes == SCENES
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (written.st_mtime_ns, written.st_ino)
    assert not (tmp_path / "swarm.h5.parts").exists()


@pytest.mark.parametrize("change", [{"seed": 5}, {"scenes": 24}, {"steps": 7}, {"preset": "clear"}, {"mixed": True}])
def test_a_file_of_other_settings_is_refused_and_kept(tmp_path: Path, expected: Trajectories, change: dict):
    path = tmp_path / "swarm.h5"
    save(path, expected)
    with pytest.raises(TrajectoryError, match="made with other settings"):
        simulate(replace(CONFIG, **change), path)
    assert_same_trajectories(load(path), expected)


def test_a_file_that_is_no_trajectories_is_refused_and_kept(tmp_path: Path):
    path = tmp_path / "notes.h5"
    path.write_text("important")
    with pytest.raises(TrajectoryError, match=r"notes\.h5"):
        simulate(CONFIG, path)
    assert path.read_text() == "important"


def test_threads_change_nothing():
    bodies = replace(CONFIG, preset="clear", scenes=8, steps=3)
    one, two = (simulate_in_memory(replace(bodies, threads=threads)) for threads in (1, 2))
    assert_same_arrays(one, two)


def test_the_threads_that_were_asked_for_are_used(monkeypatch: pytest.MonkeyPatch):
    asked, make = [], simulation.make_engine
    simulation._stage.cache_clear()
    monkeypatch.setattr(
        simulation, "make_engine", lambda *a, threads: asked.append(threads) or make(*a, threads=threads)
    )
    simulate_in_memory(replace(CONFIG, threads=2, scenes=1, steps=1))
    assert asked == [2]


@pytest.mark.parametrize("chunk", [BLOCK + 1, 1000])
def test_chunks_change_nothing(expected: Trajectories, chunk: int):
    assert_same_trajectories(simulate_in_memory(replace(CONFIG, chunk=chunk)), expected)


def test_a_block_has_one_shape_whatever_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    """What keeps the last bit: every call of the compiled rollout has the same number of scenes."""
    shapes, make = [], simulation.make_rollout
    simulation._stage.cache_clear()

    def spied(*args, **kwargs):
        run = make(*args, **kwargs)
        return lambda params, start, keys: shapes.append(len(keys)) or run(params, start, keys)

    monkeypatch.setattr(simulation, "make_rollout", spied)
    for scenes, chunk in ((1, 1), (BLOCK + 1, 7), (BLOCK + 1, 1000)):
        assert len(simulate_in_memory(replace(CONFIG, scenes=scenes, chunk=chunk, steps=1))) == scenes
    simulation._stage.cache_clear()
    assert shapes == [BLOCK] * 5
    assert block_of(CONFIG) == BLOCK


def test_scenes_that_only_fill_a_block_up_cannot_fail(monkeypatch: pytest.MonkeyPatch):
    """Whether the next scene finds room for its bodies is no business of who did not ask for it."""
    asked, keys_of = [], simulation.scene_keys
    monkeypatch.setattr(
        simulation, "scene_keys", lambda seed, scenes: asked.extend(scenes.tolist()) or keys_of(seed, scenes)
    )
    simulate_in_memory(replace(CONFIG, scenes=BLOCK + 2, steps=1))
    assert asked == [*range(BLOCK + 1), *[BLOCK + 1] * (BLOCK - 1)]


def test_scenes_do_not_depend_on_how_many_there_are(expected: Trajectories):
    fewer = simulate_in_memory(replace(CONFIG, scenes=11))
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(fewer, name), getattr(expected, name)[:11], err_msg=name)
    assert (simulate_in_memory(replace(CONFIG, scenes=11, seed=5)).position != fewer.position).any()


def test_contacts_reach_the_file():
    world = simulate_in_memory(replace(CONFIG, preset="clear", scenes=4, steps=3))
    assert (world.dt, world.substeps, world.max_acceleration) == (0.3, 30, 10)
    assert world.provenance["world"]["scene"]["contacts"] is True


def test_going_on_with_another_chunk_size_is_right_too(tmp_path: Path, expected: Trajectories):
    path = tmp_path / "swarm.h5"

    def stop(done: int, total: int) -> None:
        if done >= 2 * BLOCK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(CONFIG, path, progress=stop)
    simulate(replace(CONFIG, chunk=BLOCK + 1), path)
    assert_same_trajectories(load(path), expected)
    assert [p.name for p in tmp_path.iterdir()] == ["swarm.h5"]


def test_an_interrupted_call_goes_on_where_it_was_and_makes_a_damaged_part_again(
    tmp_path: Path, expected: Trajectories
):
    path, seen = tmp_path / "swarm.h5", []

    def stop(done: int, total: int) -> None:
        if done >= 2 * BLOCK:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(CONFIG, path, progress=stop)
    assert not path.exists()
    part = min((tmp_path / "swarm.h5.parts").iterdir())
    damaged = bytearray(part.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    part.write_bytes(damaged)
    simulate(CONFIG, path, progress=lambda done, total: seen.append(done))
    assert seen == [BLOCK, 2 * BLOCK, SCENES]
    assert_same_trajectories(load(path), expected)


KILLED = """
import sys
from pathlib import Path
from envs.config import SimulateConfig
from envs.simulate import simulate
import time
config = SimulateConfig(
    preset="published", scenes=537, steps=3, num_agents=3, seed=4, engine="native", chunk=8
)
def progress(done, total):
    print(done, flush=True)
    if done == 512:
        time.sleep(60)  # the third chunk is under way for whoever looks from outside
simulate(config, Path(sys.argv[1]), progress=progress)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_kill_9_loses_at_most_the_current_chunk(tmp_path: Path, expected: Trajectories):
    path, seen = tmp_path / "swarm.h5", []
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == "512":
                process.send_signal(signal.SIGKILL)
                break
        assert process.wait(timeout=60) == -signal.SIGKILL
    assert not path.exists()
    simulate(CONFIG, path, progress=lambda done, total: seen.append(done))
    assert seen == [2 * BLOCK, SCENES]
    assert_same_trajectories(load(path), expected)
    assert [p.name for p in tmp_path.iterdir()] == ["swarm.h5"]


@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_kill_9_at_any_moment_leaves_something_to_go_on_from(tmp_path: Path, expected: Trajectories):
    path = tmp_path / "swarm.h5"
    quick = KILLED.replace("time.sleep(60)", "pass")
    for delay in (0.0, 0.03):
        command = [sys.executable, "-c", quick, str(path)]
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            process.stdout.readline()
            time.sleep(delay)
            process.kill()
            process.wait(timeout=60)
    simulate(CONFIG, path)
    assert_same_trajectories(load(path), expected)


def test_both_engines_give_the_same_trajectories():
    """Contacts on, random scenes: those without contact agree closely, and nearly all agree."""
    config = SimulateConfig(scenes=64, steps=10, num_agents=3, seed=2, engine="native")
    native, mjx = simulate_in_memory(config), simulate_in_memory(replace(config, engine="mjx"))
    assert mjx.provenance["engine"] == "mjx"
    free = ~(native.agent_contact + native.solid_contact).any(axis=(1, 2))
    assert free.mean() > 0.9
    apart = np.abs(native.position - mjx.position).max(axis=(1, 2, 3))
    assert (apart[free] <= 1e-3).mean() >= 0.98  # an almost head-on boid may turn to the other side
    assert (apart <= 1e-2).mean() >= 0.98
    same = (native.agent_contact == mjx.agent_contact).all(axis=(1, 2))
    assert same.mean() >= 0.98


def test_the_fingerprint_is_of_the_settings_that_matter():
    assert fingerprint(replace(CONFIG, chunk=1, threads=7)) == fingerprint(CONFIG)
    assert fingerprint(replace(CONFIG, engine="auto")) == fingerprint(CONFIG)  # native on a CPU
    changes = ({"seed": 5}, {"engine": "mjx"}, {"mixed": True}, {"num_agents": 4}, {"steps": 1}, {"start": "crossing"})
    changes += ({"perception_noise": 0.1}, {"actuation_noise": 0.1}, {"rules": ("goal",)}, {"nearest": 2}, {"dt": 0.1})
    for change in changes:
        assert fingerprint(replace(CONFIG, **change)) != fingerprint(CONFIG)


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, 0) for field in ("scenes", "steps", "num_agents", "chunk")]
    + [(field, -1) for field in ("num_obstacles", "seed", "threads")]
    + [("seed", 2**32)]
    + [("preset", "chaos"), ("start", "nowhere"), ("dt", 0.0), ("dt", -0.3), ("obstacle_speed", -1.0), ("nearest", 0)],
)
def test_settings_that_make_no_sense_are_refused(field: str, value: object):
    with pytest.raises(SpecError) as caught:
        SimulateConfig(**{field: value})  # pyright: ignore[reportArgumentType]
    assert (caught.value.field, caught.value.given) == (field, value)


def test_the_world_is_made_of_what_was_asked_for():
    config = SimulateConfig(
        start="corridor", num_obstacles=4, obstacle_speed=2.0, rules=("goal", "obstacle"), nearest=3,
        interaction_radius=30.0, dt=0.1, mixed=True,
    )  # fmt: skip
    usual, world = clear(num_obstacles=4), config.world()
    assert world.expert == replace(
        usual.expert, cohesion=0.0, separation=0.0, alignment=0.0, interaction=Interaction(radius=30.0, nearest=3)
    )
    assert world.spawn == replace(usual.spawn, family="corridor", obstacle_speed=2.0, min_agents=1, min_obstacles=0)
    # 30 physics steps in 0.3 s: 10 of the same in 0.1 s.
    assert world.scene == replace(usual.scene, moving_obstacles=True, dt=0.1, substeps=10)
    assert SimulateConfig(preset="published", dt=0.1).world().scene.substeps == 1
    assert SimulateConfig().world() == clear()


def test_an_unknown_rule_is_refused_with_the_known_ones():
    with pytest.raises(SpecError, match="'nose' was given, allowed is some of cohesion, separation, alignment"):
        SimulateConfig(rules=("goal", "nose"))
    with pytest.raises(SpecError, match="repulsion, body, friction, goal"):
        SimulateConfig(preset="helbing", rules=("separation",))
    with pytest.raises(SpecError, match="none: chaser has a single rule"):
        SimulateConfig(preset="chaser", rules=("gain",))


def test_with_the_goal_rule_alone_agents_do_what_the_formula_says():
    """A subset of rules is simulated: acceleration 0.5 (wanted - own velocity), clipped at 5, speed clipped at 10."""
    got = simulate_in_memory(replace(CONFIG, scenes=8, steps=1, rules=("goal",)))
    goal, start, velocity = got.position[:, 0, :1], got.position[:, 0, 2:], got.velocity[:, 0, 2:]
    distance = np.linalg.norm(goal - start, axis=-1, keepdims=True)
    pull = 0.5 * (10 * np.minimum(1, distance / 20) * (goal - start) / distance - velocity)
    pull *= np.minimum(1, 5 / np.linalg.norm(pull, axis=-1, keepdims=True))
    after = velocity + 0.3 * pull
    after *= np.minimum(1, 10 / np.linalg.norm(after, axis=-1, keepdims=True))
    np.testing.assert_allclose(got.velocity[:, 1, 2:], after, atol=1e-4)


def test_settings_written_before_a_field_existed_are_read_with_its_default():
    settings = plain(CONFIG)
    for later in ("start", "dt", "rules", "nearest", "obstacle_speed", "perception_noise", "chunk", "threads"):
        del settings[later]
    assert from_plain(SimulateConfig, settings) == replace(CONFIG, chunk=1024)
    assert from_plain(SimulateConfig, plain(replace(CONFIG, rules=("goal",)))).rules == ("goal",)
    with pytest.raises(KeyError, match="agents"):
        from_plain(WithoutDefault, {"scenes": 3})


@dataclass(frozen=True)
class WithoutDefault:
    agents: int
    scenes: int = 1


def test_chasers_have_the_targets_that_were_asked_for():
    world = SimulateConfig(preset="chaser", num_agents=6, targets=3, assignment="agent", average=True).world()
    assert (world.spawn.targets, world.spawn.assignment) == (3, "agent")
    assert world.expert == ChaserConfig(average=True)


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"preset": "chaser", "num_agents": 3, "targets": 3}, "targets"),
        ({"preset": "chaser", "targets": 0}, "targets"),
        ({"preset": "chaser", "assignment": "random"}, "assignment"),
        ({"preset": "clear", "targets": 1}, "targets"),
        ({"preset": "clear", "average": True}, "average"),
    ],
)
def test_targets_that_make_no_sense_are_refused(settings: dict, field: str):
    with pytest.raises(SpecError) as caught:
        SimulateConfig(**settings)
    assert caught.value.field == field
