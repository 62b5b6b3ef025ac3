"""Exports: what was written is read back the same, by our importers or as the other project's own loader does it."""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from helpers import make_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import blank

from envs.exporters import ExportError, export, gns_metadata, long_table, nri_arrays, without_partial
from envs.importers import ImportConfig, import_files
from envs.storage import load, save
from envs.trajectories import AGENT, GOAL, NO_EDGE, OBSTACLE, Trajectories, concatenate
from swarm_mjcf.errors import SpecError
from swarmnet.cli import main


def swarm(seed: int = 0, *, agents: int = 3, obstacles: int = 2, rows: int = 5, scenes: int = 3) -> Trajectories:
    """Random states; the goal and the first agent are always there, others may be padding."""
    t = make_trajectories(scenes=scenes, rows=rows, goals=1, obstacles=obstacles, agents=agents, seed=seed)
    mask, rng = t.mask.copy(), np.random.default_rng(seed)
    mask[:, :, [0, 1 + obstacles]] = True
    here = mask[..., None]
    states = rng.uniform(-50, 50, (2, *t.position.shape)).astype(np.float32)
    states[1] *= rng.uniform(0.1, 1, states[1].shape)
    present = mask.any(axis=1)
    return replace(
        t,
        position=np.where(here, states[0], 0).astype(np.float32),
        velocity=np.where(here, states[1], 0).astype(np.float32),
        mask=mask,
        edges=np.where(present[:, :, None] & present[:, None], _complete(t.kind), NO_EDGE).astype(np.int8),
    )


def _complete(kind: np.ndarray) -> np.ndarray:
    edges = (kind + 1)[:, :, None] * (kind == AGENT)[:, None]
    edges[:, range(kind.shape[1]), range(kind.shape[1])] = NO_EDGE
    return edges


def comes_and_goes(t: Trajectories) -> Trajectories:
    """The last agent leaves for the last row of every scene, an obstacle enters in the second."""
    mask = t.mask.copy()
    mask[:, -1, -1] = mask[:, 0, 2] = False
    here = mask[..., None]
    return replace(t, mask=mask, position=np.where(here, t.position, 0), velocity=np.where(here, t.velocity, 0))


def assert_same_states(again: Trajectories, t: Trajectories) -> None:
    """The same to the bit, scene by scene over the nodes that are ever there; padding may have moved."""
    assert (len(again), again.position.shape[1]) == (len(t), t.position.shape[1])
    assert again.dt == pytest.approx(t.dt, rel=1e-9)
    for scene in range(len(t)):
        a, b = again.mask[scene].any(axis=0), t.mask[scene].any(axis=0)
        for name in ("position", "velocity", "mask"):
            np.testing.assert_array_equal(
                getattr(again, name)[scene][:, a], getattr(t, name)[scene][:, b], err_msg=name
            )
        np.testing.assert_array_equal(again.kind[scene][a], t.kind[scene][b])
        np.testing.assert_array_equal(again.edges[scene][np.ix_(a, a)], t.edges[scene][np.ix_(b, b)])


def imported(path: Path, **options: object) -> Trajectories:
    out = path.with_name("again.h5")
    import_files([path], ImportConfig(**options), out)
    return load(out)


@settings(max_examples=15)
@given(
    seed=st.integers(0, 10_000),
    agents=st.integers(1, 4),
    obstacles=st.integers(0, 2),
    rows=st.integers(2, 6),
    scenes=st.integers(1, 4),
    format=st.sampled_from(["csv", "parquet", "published"]),
)
def test_what_is_exported_is_imported_the_same(
    seed: int, agents: int, obstacles: int, rows: int, scenes: int, format: str
):
    t = swarm(seed, agents=agents, obstacles=obstacles, rows=rows, scenes=scenes)
    with tempfile.TemporaryDirectory() as folder:
        if format == "published":
            export(t, Path(folder) / "train", format)
            again = imported(Path(folder) / "train_timeseries.npy")
        else:
            path = Path(folder) / f"swarm.{format}"
            assert export(t, path, format) == [path]
            declared = {"unit": "m", "time_unit": "s"} if format == "csv" else {}
            again = imported(path, velocity="file", substeps=15, segment=0.0, **declared)
            assert again.substeps == t.substeps
        assert_same_states(again, t)


def test_long_tables_hold_who_comes_and_goes(tmp_path: Path):
    t = comes_and_goes(swarm())
    export(t, tmp_path / "t.parquet", "parquet")
    again = imported(tmp_path / "t.parquet", velocity="file", segment=0.0)
    assert_same_states(again, t)
    table = pq.read_table(tmp_path / "t.parquet")
    assert table.column_names == ["run", "t", "id", "type", "x", "y", "vx", "vy"]
    assert table.num_rows == t.mask.sum()
    assert set(table["type"].to_pylist()) == {"goal", "obstacle", "agent"}


def there_in(t: Trajectories, rows: list[int]) -> Trajectories:
    """The same with nobody there in all other rows."""
    mask = t.mask & np.isin(np.arange(t.mask.shape[1]), rows)[:, None]
    here = mask[..., None]
    return replace(t, mask=mask, position=np.where(here, t.position, 0), velocity=np.where(here, t.velocity, 0))


@pytest.mark.parametrize("format", ["csv", "parquet"])
def test_an_import_comes_back_without_the_rows_at_its_ends_in_which_nobody_is(tmp_path: Path, format: str):
    walks = [f"{k / 10},{i},{0.3 * k * i},{k**2 / 7}" for i in (1, 2) for k in range(9)]
    (tmp_path / "w.csv").write_text("t,id,x,y\n" + "\n".join(walks) + "\n")
    units = {"unit": "m", "time_unit": "s"}
    whole = imported(tmp_path / "w.csv", segment=0.0, **units)
    assert whole.position.shape == (1, 8, 2, 2)
    assert whole.mask.all(), "nobody has a velocity in the recording's first row: it is no row of ours"
    for name in ("published", "nri", "gns"):
        export(whole, tmp_path / name, name)  # formats without masks take it
    t = concatenate([there_in(whole, [1, 2, 3, 4, 5, 6]), there_in(whole, [2, 3, 4, 6])])
    (tmp_path / "back").mkdir()
    export(t, tmp_path / "back" / f"t.{format}", format)
    declared = units if format == "csv" else {}
    again = imported(tmp_path / "back" / f"t.{format}", velocity="file", segment=0.0, gap="split", **declared)
    assert_same_states(again.take([0]), t.take([0]).rows(1, 6))
    # A scene begins with the first row that somebody is in and has as many rows as the longest.
    assert again.mask[1].all(axis=1).tolist() == [True, True, True, False, True, False]
    assert_same_states(again.take([1]), t.take([1]).rows(2, 6))


def test_a_row_of_the_long_table():
    t = swarm()
    table = long_table(t).to_pylist()
    row = next(r for r in table if (r["run"], r["id"]) == (1, 3) and r["t"] == 2 * t.dt)
    assert row["type"] == "agent"
    assert [row[name] for name in ("x", "y", "vx", "vy")] == [*t.position[1, 2, 3], *t.velocity[1, 2, 3]]


def test_published_arrays_are_as_the_author_s_code_reads_them(tmp_path: Path):
    t = swarm()
    written = export(t, tmp_path / "train", "published")
    assert [path.name for path in written] == ["train_timeseries.npy", "train_edge.npy", "train_time.npy"]
    states, edges, times = (np.load(path) for path in written)
    assert (states.shape, states.dtype) == ((3, 5, 6, 4), np.float32)
    np.testing.assert_array_equal(states[..., :2], t.position)
    np.testing.assert_array_equal(states[..., 2:], t.velocity)
    np.testing.assert_array_equal(edges, t.edges)
    np.testing.assert_allclose(times, [[0, 0.3, 0.6, 0.9, 1.2]] * 3)


def test_nri_arrays_are_as_its_loader_reads_them(tmp_path: Path):
    """The loader's steps: transpose to (sims, atoms, rows, dims), edges int((e + 1) / 2) without the diagonal."""
    t = swarm()
    t = replace(t, mask=np.ones_like(t.mask), edges=_complete(t.kind).astype(np.int8))
    written = export(t, tmp_path / "nri", "nri", split="valid", suffix="_boids6")
    assert [p.name for p in written] == ["loc_valid_boids6.npy", "vel_valid_boids6.npy", "edges_valid_boids6.npy"]
    loc, vel, edges = (np.load(path) for path in written)
    assert loc.shape == vel.shape == (3, 5, 2, 6)
    features = np.concatenate([np.transpose(loc, [0, 3, 1, 2]), np.transpose(vel, [0, 3, 1, 2])], axis=3)
    np.testing.assert_array_equal(features[1, 4, 2], [*t.position[1, 2, 4], *t.velocity[1, 2, 4]])
    relations = np.array((np.reshape(edges, [-1, 36]) + 1) / 2, dtype=np.int64)
    off = np.ravel_multi_index(np.where(np.ones((6, 6)) - np.eye(6)), (6, 6))
    assert relations[:, off].tolist() == (t.edges.reshape(3, 36)[:, off] > 0).astype(int).tolist()
    sender, receiver = 0, 5  # the goal acts on an agent and not the other way round
    assert (edges[:, sender, receiver] == 1).all()
    assert (edges[:, receiver, sender] == 0).all()


def test_gns_files_are_as_its_loader_reads_them(tmp_path: Path):
    """The loader's steps: every entry apart into positions (rows, particles, 2) and types, and metadata.json."""
    t = swarm()
    written = export(t, tmp_path / "gns", "gns", connectivity_radius=7.5)
    assert [path.name for path in written] == ["train.npz", "metadata.json"]
    with np.load(written[0], allow_pickle=True) as archive:  # as GNS does; nothing of ours reads it
        data = [item for _, item in archive.items()]
    assert len(data) == 3
    for scene, (positions, types) in enumerate(data):
        there = t.mask[scene, 0]
        np.testing.assert_array_equal(positions, t.position[scene][:, there])
        assert np.full(positions.shape[1], types, dtype=int).tolist() == [
            {GOAL: 0, OBSTACLE: 3, AGENT: 5}[kind] for kind in t.kind[scene][there].tolist()
        ]
    about = json.loads(written[1].read_text())
    assert about["default_connectivity_radius"] == 7.5
    assert (about["sequence_length"], about["dim"], about["dt"]) == (4, 2, 0.3)


def test_gns_statistics_by_hand():
    """Agent 0 moves by (1, 0) per row, agent 1 by (0, 2) and then (0, 4); the goal counts for the bounds alone."""
    position = np.zeros((1, 3, 3, 2))
    position[0, :, 0] = [30, 40]
    position[0, :, 1, 0] = [0, 1, 2]
    position[0, :, 2, 1] = [0, 2, 6]
    about = gns_metadata(blank(position, np.zeros_like(position), [GOAL, AGENT, AGENT]))
    assert about["bounds"] == [[0, 30], [0, 40]]
    assert about["default_connectivity_radius"] == 50
    np.testing.assert_allclose(about["vel_mean"], [0.5, 1.5])
    np.testing.assert_allclose(about["vel_std"], [0.5, np.std([0, 0, 2, 4])])
    np.testing.assert_allclose(about["acc_mean"], [0, 1])
    np.testing.assert_allclose(about["acc_std"], [0, 1])


def test_formats_without_masks_refuse_who_comes_and_goes_or_drop_them(tmp_path: Path):
    t = comes_and_goes(swarm())
    for format in ("published", "nri", "gns"):
        with pytest.raises(ExportError, match=r"are there for part of their scene, first node \d of scene \d"):
            export(t, tmp_path / format, format)
    assert not list(tmp_path.iterdir())
    whole = without_partial(t, drop=True)
    assert (whole.mask.all(axis=1) == whole.mask.any(axis=1)).all()
    np.testing.assert_array_equal(whole.mask[:, 0], t.mask.all(axis=1))
    assert not whole.edges[~whole.mask[:, 0]].any()
    assert not np.swapaxes(whole.edges, 1, 2)[~whole.mask[:, 0]].any()
    export(t, tmp_path / "train", "published", partial="drop")
    assert_same_states(imported(tmp_path / "train_timeseries.npy"), whole)
    alone = replace(t, mask=t.mask & (np.arange(5)[:, None] != 2))
    with pytest.raises(ExportError, match="no scene has an agent that is there all the time"):
        without_partial(alone, drop=True)


def test_scenes_of_different_people_do_not_fit_nri():
    t = swarm()
    mask = t.mask.copy()
    mask[:, :, -1] = [[True], [False], [True]]
    with pytest.raises(ExportError, match="the same atoms in every simulation"):
        nri_arrays(replace(t, mask=mask))


def test_options_that_do_not_exist_and_places_that_cannot_be_written(tmp_path: Path):
    t = swarm()
    for options in ({"format": "json"}, {"partial": "keep"}, {"split": "all"}, {"connectivity_radius": 0.0}):
        with pytest.raises(SpecError):
            export(t, tmp_path / "x", **({"format": "gns"} | options))
    with pytest.raises(ExportError, match="3 rows of a scene, there are 2"):
        export(swarm(rows=2), tmp_path, "gns", partial="drop")
    (tmp_path / "file").write_text("")
    with pytest.raises(ExportError, match="cannot be written"):
        export(t, tmp_path / "file" / "t.csv", "csv")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_command_names_what_it_wrote(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save("swarm.h5", swarm())
    assert main(("export", "swarm.h5")) == 0
    assert capsys.readouterr().out.startswith("swarm.parquet: ")
    assert main(("export", "swarm.h5", "--format", "gns", "--out", "g")) == 0
    assert {path.name for path in (tmp_path / "g").iterdir()} == {"train.npz", "metadata.json"}
    assert main(("import", "swarm.parquet", "--velocity", "file", "--segment", "0", "--out", "again.h5")) == 0
    assert_same_states(load("again.h5"), swarm())
