"""Shards: two processes write what one would have written, to the byte, and a merge that misses something says what."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers import assert_same_trajectories
from hypothesis import given
from hypothesis import strategies as st

from envs.config import SimulateConfig
from envs.merge import merge
from envs.shards import Shard, block_size
from envs.simulate import simulate, simulate_in_memory
from envs.storage import load, read_header, save, stream
from envs.trajectories import TrajectoryError
from swarm_mjcf.errors import SpecError
from swarmnet.cli import main

ROOT = Path(__file__).parents[1]
CONFIG = SimulateConfig(preset="clear", scenes=600, steps=1, num_agents=2, mixed=True, seed=4, engine="native", dt=0.02)
COMMAND = (
    "simulate", "--preset", "clear", "--scenes", "600", "--steps", "1", "--num-agents", "2", "--mixed", "--seed", "4",
    "--dt", "0.02",
)  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "swarm.h5"
    simulate(CONFIG, path)
    return path


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> list[Path]:
    """Three shards, two of them by processes of their own with other threads and chunks."""
    folder = tmp_path_factory.mktemp("parts")
    more = (("1/3", "--threads", "1", "--chunk", "300"), ("3/3", "--threads", "2", "--chunk", "1"))
    commands = [
        [sys.executable, "-m", "swarmnet", *COMMAND, "--engine", "native", "--out", "swarm.h5", "--shard", *options]
        for options in more
    ]
    running = [subprocess.Popen(command, cwd=folder, env=environment(), stderr=subprocess.PIPE) for command in commands]
    simulate(CONFIG, folder / "swarm.shard-2-of-3.h5", shard=Shard(2, 3))
    for process in running:
        _, error = process.communicate(timeout=200)
        assert process.returncode == 0, error.decode()[-3000:]
    return [folder / f"swarm.shard-{number}-of-3.h5" for number in (1, 2, 3)]


def environment() -> dict[str, str]:
    import os

    return os.environ | {"PYTHONPATH": str(ROOT)}


def test_processes_with_other_threads_and_chunks_write_the_same_bytes(whole: Path, parts: list[Path], tmp_path: Path):
    assert sorted(p.name for p in parts[0].parent.iterdir()) == [p.name for p in parts]  # nothing else is left
    scenes = load(whole)
    for part, first, last in zip(parts, (0, 256, 512), (255, 511, 599), strict=True):
        assert_same_trajectories(
            replace(load(part), provenance={}), replace(scenes.take(slice(first, last + 1)), provenance={})
        )
        shard = read_header(part).provenance["shard"]
        assert shard == {"number": parts.index(part) + 1, "of": 3, "first": first, "last": last}
    header = merge([parts[2], parts[0], parts[1]], tmp_path / "merged.h5")
    assert header.scenes == 600
    assert (tmp_path / "merged.h5").read_bytes() == whole.read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["merged.h5"]


def test_a_shard_of_another_number_of_shards_holds_the_same_scenes(whole: Path, tmp_path: Path):
    for number in (1, 2):
        simulate(CONFIG, tmp_path / f"{number}.h5", shard=Shard(number, 2))
    assert [read_header(tmp_path / f"{n}.h5").scenes for n in (1, 2)] == [256, 344]
    merge([tmp_path / "1.h5", tmp_path / "2.h5"], tmp_path / "merged.h5")
    assert (tmp_path / "merged.h5").read_bytes() == whole.read_bytes()


def test_a_shard_is_kept_and_no_other_takes_its_place(parts: list[Path]):
    before = parts[0].stat().st_mtime_ns
    assert simulate(CONFIG, parts[0], shard=Shard(1, 3)).scenes == 256
    assert parts[0].stat().st_mtime_ns == before
    for shard in (Shard(2, 3), Shard(1, 2), Shard()):
        with pytest.raises(TrajectoryError, match="made with other settings"):
            simulate(CONFIG, parts[0], shard=shard)


def refused(given: list[Path], out: Path) -> str:
    """The error of a merge that must write nothing."""
    before = sorted(p.name for p in out.parent.iterdir())
    with pytest.raises(TrajectoryError) as caught:
        merge(given, out)
    assert sorted(p.name for p in out.parent.iterdir()) == before
    return str(caught.value)


def test_missing_shards_are_named(parts: list[Path], tmp_path: Path):
    assert "its shards 1/3, 3/3 are missing" in refused([parts[1]], tmp_path / "out.h5")


def test_a_shard_given_twice_is_named(parts: list[Path], tmp_path: Path):
    copy = tmp_path / "copy.h5"
    copy.write_bytes(parts[1].read_bytes())
    message = refused([parts[0], parts[1], copy, parts[2]], tmp_path / "out.h5")
    assert message == f"{copy}: shard 2/3 again, as {parts[1]}"


def test_a_damaged_shard_is_named(parts: list[Path], tmp_path: Path):
    damaged, data = tmp_path / "damaged.h5", bytearray(parts[1].read_bytes())
    data[len(data) // 2] ^= 1
    damaged.write_bytes(data)
    assert str(damaged) in refused([parts[0], damaged, parts[2]], tmp_path / "out.h5")
    assert "does not exist" in refused([parts[0], tmp_path / "none.h5", parts[2]], tmp_path / "out.h5")


def test_shards_of_another_seed_are_refused_with_what_differs(parts: list[Path], tmp_path: Path):
    other = tmp_path / "other.h5"
    simulate(replace(CONFIG, seed=5), other, shard=Shard(3, 3))
    message = refused([parts[0], parts[1], other], tmp_path / "out.h5")
    assert message == f"{other}: does not belong to {parts[0]}: seed 5, not 4"


def edited(part: Path, path: Path, **changes: object) -> Path:
    """The part with other entries in its provenance."""
    whole = load(part)
    save(path, replace(whole, provenance=whole.provenance | changes))
    return path


def test_shards_of_other_versions_or_another_split_are_refused(parts: list[Path], tmp_path: Path):
    about = read_header(parts[1]).provenance
    old = edited(parts[1], tmp_path / "old.h5", versions=about["versions"] | {"jax": "0.1"}, fingerprint="old")
    assert "jax '0.1', not" in refused([parts[0], old, parts[2]], tmp_path / "out.h5")
    split = edited(parts[1], tmp_path / "split.h5", shard=about["shard"] | {"of": 4})
    assert "one of 4 shards, not of 3" in refused([parts[0], split, parts[2]], tmp_path / "out.h5")
    blocks = edited(parts[1], tmp_path / "blocks.h5", fingerprint="elsewhere")
    assert "in other blocks" in refused([parts[0], blocks, parts[2]], tmp_path / "out.h5")
    short = edited(parts[1], tmp_path / "short.h5", shard=about["shard"] | {"last": 700})
    assert "holds 256 scenes" in refused([parts[0], short, parts[2]], tmp_path / "out.h5")


def test_what_is_no_shard_is_refused(whole: Path, parts: list[Path], tmp_path: Path):
    assert f"{whole}: not a shard" in refused([whole], tmp_path / "out.h5")
    assert "no shards" in refused([], tmp_path / "out.h5")


def test_a_merged_file_is_kept_and_another_is_refused(whole: Path, parts: list[Path], tmp_path: Path):
    before = whole.stat().st_mtime_ns
    assert merge(parts, whole).scenes == 600
    assert whole.stat().st_mtime_ns == before
    other = tmp_path / "other.h5"
    save(other, simulate_in_memory(replace(CONFIG, scenes=2)))
    assert "holds something else" in refused(parts, other)
    assert "holds something else" in refused(parts, parts[0])


def test_a_merge_holds_a_slab_at_a_time(parts: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from envs import storage

    sizes, append = [], storage.TrajectoryWriter.append
    monkeypatch.setattr(
        storage.TrajectoryWriter, "append", lambda self, part: sizes.append(len(part)) or append(self, part)
    )
    merge(parts, tmp_path / "out.h5")
    assert sizes == [256, 256, 88]
    assert len(list(stream(tmp_path / "out.h5"))) == 3


def test_the_commands_say_what_is_wrong_and_write_nothing(parts: list[Path], tmp_path: Path, capsys):
    out = tmp_path / "out.h5"
    assert main(("merge", *map(str, parts[:2]), "--out", str(out))) == 2
    assert "its shards 3/3 are missing" in capsys.readouterr().err
    assert main((*COMMAND, "--out", str(out), "--shard", "4/4")) == 2
    assert "n of at most 3: 600 scenes are computed in 3 x 256" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
    assert main(("merge", *map(str, parts), "--out", str(out))) == 0
    assert "600 scenes from 3 shards" in capsys.readouterr().out


def test_the_scene_of_a_simulation_is_exported_and_nothing_is_simulated(tmp_path: Path, capsys):
    import mujoco

    path = tmp_path / "models" / "scene.xml"
    arguments = ("simulate", "--num-agents", "3", "--num-obstacles", "2", "--dt", "0.1")
    assert main((*arguments, "--export-xml", str(path), "--out", str(tmp_path / "out.h5"))) == 0
    model = mujoco.MjModel.from_xml_path(str(path))
    assert (model.nq, model.nmocap) == (6, 3)  # the goal and two obstacles
    assert model.opt.timestep == pytest.approx(0.01)
    assert [p.name for p in tmp_path.iterdir()] == ["models"]
    assert [p.name for p in path.parent.iterdir()] == ["scene.xml"]
    (tmp_path / "taken").touch()
    assert main((*arguments, "--export-xml", str(tmp_path / "taken" / "scene.xml"))) == 2
    assert "cannot be written" in capsys.readouterr().err


@given(total=st.integers(1, 5000), block=st.integers(1, 300), of=st.integers(1, 40))
def test_shards_share_the_scenes_in_order_and_evenly(total: int, block: int, of: int):
    blocks = -(-total // block)
    if of > blocks:
        with pytest.raises(SpecError, match=f"at most {blocks}: {total} scenes"):
            Shard(1, of).scenes(total, block)
        return
    shards = [Shard(number, of).scenes(total, block) for number in range(1, of + 1)]
    assert [scene for shard in shards for scene in shard] == list(range(total))
    assert all(shard.start % block == 0 for shard in shards)
    sizes = [-(-len(shard) // block) for shard in shards]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("text", ["", "2", "0/4", "5/4", "-1/4", "1/0", "1/4/2", "a/b", "1.0/2", " 1/2"])
def test_a_shard_that_makes_no_sense_is_refused(text: str):
    with pytest.raises(SpecError, match="i/n with 1 <= i <= n") as caught:
        Shard.parse(text)
    assert caught.value.field == "shard"


def test_a_shard_is_read_and_names_its_file():
    assert Shard.parse("2/10") == Shard(2, 10)
    assert Shard(2, 10).path(Path("runs/big.h5")) == Path("runs/big.shard-2-of-10.h5")
    assert Shard(1, 1).path(Path("runs/big.h5")) == Path("runs/big.h5")


def test_blocks_are_smaller_for_many_agents_and_larger_on_an_accelerator():
    assert [block_size(n) for n in (1, 80, 100, 1280, 100_000)] == [256, 256, 204, 16, 16]
    assert [block_size(n, accelerator=True) for n in (1, 8, 16, 100_000)] == [8192, 8192, 4096, 64]
