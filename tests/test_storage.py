"""Files of trajectories: what is written is read back, whole or not at all, and damage is always noticed."""

import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers import assert_same_trajectories, make_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st

from envs import storage
from envs.storage import SLAB, TrajectoryWriter, ending, join, load, read_header, save, stream
from envs.trajectories import TrajectoryError, concatenate

ROOT = Path(__file__).parents[1]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "swarm.h5"


def only_file(path: Path) -> bool:
    return [p.name for p in path.parent.iterdir()] == [path.name]


@settings(max_examples=30)
@given(
    scenes=st.integers(1, 5),
    rows=st.integers(1, 6),
    goals=st.integers(0, 2),
    obstacles=st.integers(0, 2),
    agents=st.integers(1, 4),
    seed=st.integers(0, 2**32 - 1),
)
def test_what_is_saved_is_loaded_to_the_bit(scenes: int, rows: int, goals: int, obstacles: int, agents: int, seed: int):
    t = make_trajectories(scenes=scenes, rows=rows, goals=goals, obstacles=obstacles, agents=agents, seed=seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "swarm.h5"
        save(path, t)
        assert only_file(path)
        assert_same_trajectories(load(path), t)
        header = read_header(path)
        assert (header.scenes, header.rows, header.nodes) == t.mask.shape
        assert (header.dt, header.substeps, header.max_speed) == (t.dt, t.substeps, t.max_speed)
        assert (header.max_acceleration, header.provenance) == (t.max_acceleration, t.provenance)


@pytest.mark.parametrize("sizes", [(SLAB,), (SLAB + 1,), (3, 2 * SLAB, 5), (SLAB - 1, 1, 1), (1,) * 7])
def test_parts_of_any_size_make_the_same_file(path: Path, sizes: tuple[int, ...]):
    whole = make_trajectories(scenes=sum(sizes), rows=2)
    with TrajectoryWriter(path) as writer:
        start = 0
        for size in sizes:
            writer.append(whole.take(slice(start, start + size)))
            start += size
    assert_same_trajectories(load(path), whole)
    slabs = list(stream(path))
    assert [len(slab) for slab in slabs[:-1]] == [SLAB] * (len(slabs) - 1)
    assert 0 < len(slabs[-1]) <= SLAB
    assert_same_trajectories(concatenate(slabs), whole)


def test_the_first_scenes_are_loaded_alone(path: Path):
    whole = make_trajectories(scenes=SLAB + 10, rows=2)
    save(path, whole)
    assert_same_trajectories(load(path, scenes=7), whole.take(slice(0, 7)))
    assert_same_trajectories(load(path, scenes=SLAB + 3), whole.take(slice(0, SLAB + 3)))
    with pytest.raises(TrajectoryError, match=rf"{SLAB + 11} scenes were asked for, it holds {SLAB + 10}"):
        load(path, scenes=SLAB + 11)


def test_folders_are_made_and_an_earlier_file_is_replaced(tmp_path: Path):
    path = tmp_path / "a" / "b" / "swarm.h5"
    save(path, make_trajectories(seed=1))
    save(path, make_trajectories(seed=2))
    assert_same_trajectories(load(path), make_trajectories(seed=2))
    assert only_file(path)


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("earlier", [False, True])
def test_an_exception_inside_the_writer_leaves_everything_as_it_was(
    path: Path, error: type[BaseException], earlier: bool
):
    before = make_trajectories(seed=1)
    if earlier:
        save(path, before)

    def interrupted():
        with TrajectoryWriter(path) as writer:
            writer.append(make_trajectories(scenes=SLAB + 3, seed=2))
            raise error("in the middle")

    with pytest.raises(error, match="in the middle"):
        interrupted()
    assert [p.name for p in path.parent.iterdir()] == ([path.name] if earlier else [])
    if earlier:
        assert_same_trajectories(load(path), before)


def test_until_it_is_closed_there_is_no_file(path: Path):
    writer = TrajectoryWriter(path)
    writer.append(make_trajectories())
    assert not path.exists()
    writer.close()
    assert only_file(path)


def test_a_file_without_scenes_is_refused(path: Path):
    with pytest.raises(TrajectoryError, match="no scenes"), TrajectoryWriter(path):
        pass
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize("many", [1, SLAB])
@pytest.mark.parametrize("other", [{"rows": 5}, {"agents": 3}, {"obstacles": 0}])
def test_parts_of_different_shapes_are_refused_and_leave_nothing(path: Path, other: dict, many: int):
    writer = TrajectoryWriter(path)
    writer.append(make_trajectories(scenes=many))
    with pytest.raises(TrajectoryError, match=r"swarm\.h5"):
        writer.append(make_trajectories(scenes=many, **other))
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize("many", [1, SLAB])
@pytest.mark.parametrize(
    "change",
    [{"dt": 0.1}, {"substeps": 1}, {"max_speed": 3.0}, {"max_acceleration": 2.0}],
    ids=lambda change: next(iter(change)),
)
def test_parts_of_different_time_steps_or_limits_are_refused(path: Path, change: dict, many: int):
    part = make_trajectories(scenes=many)
    writer = TrajectoryWriter(path)
    writer.append(part)
    with pytest.raises(TrajectoryError, match=next(iter(change))):
        writer.append(replace(part, **change))
    assert not list(path.parent.iterdir())


@pytest.mark.parametrize("many", [1, SLAB])
def test_parts_of_another_number_type_are_refused_or_read_back_equal(path: Path, many: int):
    part = make_trajectories(scenes=many)
    wide = replace(part, position=part.position.astype(np.float64) + 1e-9)
    try:
        with TrajectoryWriter(path) as writer:
            writer.append(part)
            writer.append(wide)
    except TrajectoryError:
        assert not list(path.parent.iterdir())
        return
    np.testing.assert_array_equal(load(path).position[many:], wide.position)


def test_what_is_not_finite_never_reaches_a_file(path: Path):
    t = make_trajectories()
    broken = t.position.copy()
    broken[1, 2] = np.nan
    with pytest.raises(TrajectoryError, match="scene 1, row 2, node"):
        save(path, replace(t, position=broken))
    assert not path.exists()


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> tuple[bytes, Path]:
    path = tmp_path_factory.mktemp("sample") / "swarm.h5"
    save(path, SAMPLE)
    return path.read_bytes(), path.with_name("damaged.h5")


SAMPLE = make_trajectories(scenes=8, rows=5, agents=3, seed=5)


def equal_or_refused(path: Path) -> bool:
    """Whether a damaged file is refused; otherwise it must hold exactly what was saved."""
    try:
        got = load(path)
    except TrajectoryError as error:
        assert str(path) in str(error)  # noqa: PT017
        return True
    assert_same_trajectories(got, SAMPLE)
    return False


@settings(max_examples=60)
@given(share=st.floats(0, 1, exclude_max=True))
def test_a_truncated_file_is_refused(sample, share: float):
    whole, path = sample
    path.write_bytes(whole[: int(share * len(whole))])
    assert equal_or_refused(path)
    with pytest.raises(TrajectoryError, match="damaged"):
        read_header(path)


def test_flipped_bytes_anywhere_are_refused(sample):
    """In another process, because a damaged file must not stop the reader either: HDF5 itself can loop on one."""
    whole, path = sample
    path.with_name("whole.h5").write_bytes(whole)
    code = f"""
import sys
sys.path.insert(0, {str(ROOT / "tests")!r})
from pathlib import Path
import numpy as np
from helpers import assert_same_trajectories
from envs.storage import load
from envs.trajectories import TrajectoryError
path = Path({str(path)!r})
whole = path.with_name("whole.h5").read_bytes()
sample = load(path.with_name("whole.h5"))
rng = np.random.default_rng({FLIPS_SEED})
refused = 0
for _ in range({FLIPS}):
    damaged = bytearray(whole)
    for place in rng.integers(0, len(whole), rng.integers(1, 4)):
        damaged[place] ^= int(rng.integers(1, 256))
    path.write_bytes(damaged)
    try:
        got = load(path)
    except TrajectoryError as error:
        assert str(path) in str(error)
        refused += 1
    else:
        assert_same_trajectories(got, sample)  # never wrong data
print(refused)
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=200)
    assert result.returncode == 0, result.stderr[-3000:]
    assert int(result.stdout) == FLIPS


FLIPS, FLIPS_SEED = 400, 0


def test_every_byte_of_the_data_counts(sample):
    whole, path = sample
    with h5py.File(path.with_name("swarm.h5")) as file:
        chunk = file["position"].id.get_chunk_info(0)
    for place in range(chunk.byte_offset, chunk.byte_offset + chunk.size, max(1, chunk.size // 20)):
        damaged = bytearray(whole)
        damaged[place] ^= 0x10
        path.write_bytes(damaged)
        assert equal_or_refused(path), place


def with_a_right_ending(path: Path) -> None:
    """Gives an edited file the checksum of its bytes, so that what is inside has to speak for itself."""
    with open(path, "r+b") as file:
        file.write(ending(file))


@pytest.mark.parametrize("name", ["dt", "substeps", "provenance", "digests", "version", "slab", "max_speed"])
def test_an_edited_header_is_refused(path: Path, name: str):
    save(path, SAMPLE)
    with h5py.File(path, "r+") as file:
        old = file.attrs[name]
        file.attrs[name] = old[:-1] + " ]" if isinstance(old, str) else type(old)(2 * old)
    with pytest.raises(TrajectoryError, match="checksum"):
        load(path)
    with_a_right_ending(path)
    with pytest.raises(TrajectoryError, match=r"corrupt|version"):
        load(path)


@pytest.mark.parametrize("name", ["position", "mask", "edges"])
def test_edited_or_missing_data_is_refused(path: Path, name: str):
    save(path, SAMPLE)
    with h5py.File(path, "r+") as file:
        file[name][0] = 1 - file[name][0].astype(int)
    with_a_right_ending(path)
    with pytest.raises(TrajectoryError, match="scenes 0 to 7 do not match their checksum"):
        load(path)
    with h5py.File(path, "r+") as file:
        del file[name]
    with_a_right_ending(path)
    with pytest.raises(TrajectoryError, match=r"swarm\.h5"):
        load(path)


def test_other_files_are_refused_with_their_name(tmp_path: Path):
    foreign, text, empty, folder = (tmp_path / name for name in ("foreign.h5", "text.h5", "empty.h5", "folder.h5"))
    with h5py.File(foreign, "w") as file:
        file["position"] = np.zeros((2, 3, 4, 2))
    text.write_text("t,id,x,y\n0,1,2,3\n")
    empty.touch()
    folder.mkdir()
    for path, reason in (
        (foreign, "an HDF5 file, but not of trajectories"),
        (text, "not a whole HDF5 file"),
        (empty, "not a whole HDF5 file"),
        (folder, "not a whole HDF5 file"),
        (tmp_path / "missing.h5", "does not exist"),
    ):
        for read in (load, read_header, lambda p: list(stream(p))):
            with pytest.raises(TrajectoryError, match=reason) as caught:
                read(path)
            assert str(path) in str(caught.value)


def test_a_newer_version_is_refused_by_number(path: Path):
    save(path, SAMPLE)
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 99
    with_a_right_ending(path)
    with pytest.raises(TrajectoryError, match="version 99"):
        load(path)


def test_a_file_of_the_first_version_is_read_with_zeros_for_what_it_lacks(path: Path, monkeypatch):
    whole = make_trajectories(scenes=SLAB + 3, rows=2)
    with monkeypatch.context() as then:
        then.setattr(storage, "VERSION", 1)
        then.setattr(storage, "ARRAYS", tuple(name for name in storage.ARRAYS if name != "saturated"))
        save(path, whole)
    with h5py.File(path) as file:
        assert (file.attrs["version"], "saturated" in file) == (1, False)
    assert_same_trajectories(load(path), whole)
    assert not load(path).saturated.any()
    with h5py.File(path, "r+") as file:
        file["position"][SLAB] += 1
    with_a_right_ending(path)
    with pytest.raises(TrajectoryError, match="do not match their checksum"):
        load(path)


@pytest.mark.parametrize("sizes", [(5, SLAB, 1), (SLAB + 6,)])
def test_joined_parts_are_the_file_that_one_call_writes(tmp_path: Path, sizes: tuple[int, ...]):
    whole = make_trajectories(scenes=sum(sizes), rows=2)
    parts, start = [], 0
    for size in sizes:
        parts.append(tmp_path / f"{start}.h5")
        save(parts[-1], replace(whole.take(slice(start, start + size)), provenance={"part": start}))
        start += size
    join(parts, tmp_path / "joined.h5", whole.provenance)
    save(tmp_path / "whole.h5", whole)
    assert (tmp_path / "joined.h5").read_bytes() == (tmp_path / "whole.h5").read_bytes()


@pytest.mark.skipif(not Path("/proc/sys").is_dir(), reason="needs Linux's read-only /proc")
def test_a_place_that_cannot_be_written_is_refused():
    with pytest.raises(TrajectoryError, match=r"/proc/sys/swarm\.h5: .*"):
        save("/proc/sys/swarm.h5", SAMPLE)


def test_a_file_where_a_folder_should_be_is_refused(tmp_path: Path):
    (tmp_path / "taken").touch()
    with pytest.raises(TrajectoryError, match="cannot be written"):
        save(tmp_path / "taken" / "swarm.h5", SAMPLE)


@pytest.mark.skipif(sys.platform == "win32", reason="needs resource limits")
@pytest.mark.parametrize("limit", [0, 1000, 20_000, 60_000])
def test_a_full_disk_is_one_error_and_leaves_the_earlier_file(path: Path, limit: int):
    """A limit on the size of files stands in for a full disk; exceeding it fails writes as a full disk does."""
    save(path, SAMPLE)
    code = f"""
import resource, signal, sys
sys.path.insert(0, {str(ROOT / "tests")!r})
from helpers import make_trajectories
from envs.storage import save
from envs.trajectories import TrajectoryError
big = make_trajectories(scenes=300, rows=20, agents=5)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
try:
    save({str(path)!r}, big)
except TrajectoryError as error:
    assert {str(path)!r} in str(error), error
    print("refused")
"""
    environment = os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=100, env=environment
    )
    assert (result.returncode, result.stdout) == (0, "refused\n"), result.stderr[-3000:]
    assert_same_trajectories(load(path), SAMPLE)
    assert only_file(path)


def test_what_a_killed_writer_left_is_removed_and_a_living_ones_is_not(tmp_path: Path) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    abandoned, living = (tmp_path / f".a.h5.{pid}.partial" for pid in (dead.pid, os.getppid()))
    abandoned.write_bytes(b"half")
    living.write_bytes(b"half")
    save(tmp_path / "a.h5", make_trajectories(scenes=2))
    assert not abandoned.exists()
    assert living.exists()
