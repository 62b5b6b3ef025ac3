"""Data generation: the file depends on the settings alone, whatever the chunks, threads, interruptions and engine."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import assert_same_trajectories

from envs import simulate as simulation
from envs.config import SimulateConfig
from envs.simulate import fingerprint, simulate, simulate_in_memory
from envs.storage import load, save
from envs.trajectories import ARRAYS, Trajectories, TrajectoryError
from swarm_mjcf.errors import SpecError

ROOT = Path(__file__).parents[1]
CONFIG = SimulateConfig(preset="published", scenes=25, steps=6, num_agents=3, seed=4, engine="native", chunk=8)


@pytest.fixture(scope="module")
def expected() -> Trajectories:
    return simulate_in_memory(CONFIG)


def assert_same_arrays(first: Trajectories, second: Trajectories) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def test_a_file_holds_what_was_asked_for_and_where_it_comes_from(tmp_path: Path, expected: Trajectories):
    seen = []
    header = simulate(CONFIG, tmp_path / "swarm.h5", progress=lambda done, total: seen.append((done, total)))
    assert (header.scenes, header.rows, header.nodes) == (25, 7, 1 + 1 + 3)
    assert seen == [(0, 25), (8, 25), (16, 25), (24, 25), (25, 25)]
    assert header.provenance["simulate"]["seed"] == 4
    assert header.provenance["engine"] == "native"
    assert header.provenance["world"]["scene"]["contacts"] is False
    assert "mujoco" in header.provenance["versions"]
    assert [p.name for p in tmp_path.iterdir()] == ["swarm.h5"]  # no parts left
    assert_same_trajectories(load(tmp_path / "swarm.h5"), expected)


def test_a_file_of_the_same_settings_is_kept(tmp_path: Path, expected: Trajectories):
    path = tmp_path / "swarm.h5"
    save(path, expected)
    written = path.stat()
    header = simulate(replace(CONFIG, chunk=5, threads=1), path, progress=lambda *_: pytest.fail("it ran again"))
    assert header.scenes == 25
    assert (path.stat().st_mtime_ns, path.stat().st_ino) == (written.st_mtime_ns, written.st_ino)


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
    monkeypatch.setattr(
        simulation, "make_engine", lambda *a, threads: asked.append(threads) or make(*a, threads=threads)
    )
    simulate_in_memory(replace(CONFIG, threads=2, scenes=1, steps=1))
    assert asked == [2]


@pytest.mark.parametrize("chunk", [7, 1000])
def test_chunks_change_nothing_but_float32_rounding(expected: Trajectories, chunk: int):
    """XLA may order a sum differently for another batch size; physics does not."""
    other = simulate_in_memory(replace(CONFIG, chunk=chunk))
    assert len(other) == 25
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(other, name), getattr(expected, name), atol=1e-3, err_msg=name)
    np.testing.assert_array_equal(other.mask, expected.mask)


def test_scenes_do_not_depend_on_how_many_there_are(expected: Trajectories):
    fewer = simulate_in_memory(replace(CONFIG, scenes=11))
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(fewer, name), getattr(expected, name)[:11], err_msg=name)
    assert (simulate_in_memory(replace(CONFIG, seed=5)).position != expected.position).any()


def test_contacts_reach_the_file():
    world = simulate_in_memory(replace(CONFIG, preset="clear", scenes=4, steps=3))
    assert (world.dt, world.substeps, world.max_acceleration) == (0.3, 30, 10)
    assert world.provenance["world"]["scene"]["contacts"] is True


def test_going_on_with_another_chunk_size_is_right_too(tmp_path: Path, expected: Trajectories):
    path = tmp_path / "swarm.h5"

    def stop(done: int, total: int) -> None:
        if done >= 16:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(CONFIG, path, progress=stop)
    simulate(replace(CONFIG, chunk=5), path)
    got = load(path)
    assert len(got) == 25
    np.testing.assert_allclose(got.position, expected.position, atol=1e-3)


def test_an_interrupted_call_goes_on_where_it_was_and_makes_a_damaged_part_again(
    tmp_path: Path, expected: Trajectories
):
    path, seen = tmp_path / "swarm.h5", []

    def stop(done: int, total: int) -> None:
        if done >= 16:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(CONFIG, path, progress=stop)
    assert not path.exists()
    part = min((tmp_path / "swarm.h5.parts").iterdir())
    damaged = bytearray(part.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    part.write_bytes(damaged)
    simulate(CONFIG, path, progress=lambda done, total: seen.append(done))
    assert seen == [8, 16, 24, 25]
    assert_same_trajectories(load(path), expected)


KILLED = """
import sys
from pathlib import Path
from envs.config import SimulateConfig
from envs.simulate import simulate
import time
config = SimulateConfig(
    preset="published", scenes=25, steps=6, num_agents=3, seed=4, engine="native", chunk=8
)
def progress(done, total):
    print(done, flush=True)
    if done == 16:
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
            if line.strip() == "16":
                process.send_signal(signal.SIGKILL)
                break
        assert process.wait(timeout=60) == -signal.SIGKILL
    assert not path.exists()
    simulate(CONFIG, path, progress=lambda done, total: seen.append(done))
    assert seen == [16, 24, 25]
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
    for change in ({"seed": 5}, {"engine": "mjx"}, {"mixed": True}, {"num_agents": 4}, {"steps": 1}):
        assert fingerprint(replace(CONFIG, **change)) != fingerprint(CONFIG)


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, 0) for field in ("scenes", "steps", "num_agents", "chunk")]
    + [(field, -1) for field in ("num_obstacles", "seed", "threads")]
    + [("preset", "chaos")],
)
def test_settings_that_make_no_sense_are_refused(field: str, value: object):
    with pytest.raises(SpecError) as caught:
        SimulateConfig(**{field: value})  # pyright: ignore[reportArgumentType]
    assert (caught.value.field, caught.value.given) == (field, value)
