"""Importers: the same walk in every format gives the same trajectories, and every broken file one clear message."""

import json
import re
import shlex
import sqlite3
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning import quick_training
from scipy.io import savemat

from envs.importers import ImportConfig, ImportFailed, import_files, read
from envs.importers.holdout import held_out
from envs.importers.importing import VERSION, card_path, holdout_path
from envs.importers.samples import sampled, spacing, time_step
from envs.importers.scenes import assembled, cut, rows_per_scene
from envs.importers.survey import survey
from envs.importers.tracks import tracks_of
from envs.storage import load, read_header
from envs.trajectories import AGENT, AGENT_EDGE, GOAL, GOAL_EDGE, OBSTACLE, OBSTACLE_EDGE, TrajectoryError
from swarm_mjcf.errors import SpecError
from swarmnet.cli import main, parse

FPS = 5.0
PLAIN = ImportConfig()
METRES = ImportConfig(unit="m", time_unit="s")

# Three people at 5 frames per second: 1 walks east at 1 m/s from frame 0 to 6, 2 north at 0.5 m/s from 2 to 6, 3 stands
# at (4, 4) and takes one step of 0.2 m in y at frame 5.
WALK = np.asarray(
    [(f, 1, 0.2 * f, 1.0) for f in range(7)]
    + [(f, 2, 3.0, 0.1 * f) for f in range(2, 7)]
    + [(f, 3, 4.0, 4.0 + 0.2 * (f >= 5)) for f in range(7)]
)


def text(name: str, content: str | bytes):
    """Writes a file into a folder that is given later."""

    def write(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


def csv(path: Path, rows: np.ndarray = WALK, header: str = "t,id,x,y") -> Path:
    rows = np.asarray(rows, float)
    lines = [f"{frame / FPS:.10g},{int(id)},{x:.10g},{y:.10g}" for frame, id, x, y in rows]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


def juelich(path: Path, rows: np.ndarray = WALK, header: str = "# framerate: 5 fps\n# id frame x/cm y/m z/m\n") -> Path:
    lines = [f"{int(id)} {int(frame)} {100 * x:.10g} {y:.10g} 1.76" for frame, id, x, y in rows]
    path.write_text(header + "\n".join(lines) + "\n")
    return path


def jupedsim(path: Path, rows: np.ndarray = WALK, *, fps: str | None = "5.0") -> Path:
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE trajectory_data (frame INTEGER, id INTEGER, pos_x REAL, pos_y REAL)")
        base.execute("CREATE TABLE metadata (key TEXT, value TEXT)")
        base.executemany("INSERT INTO trajectory_data VALUES (?, ?, ?, ?)", rows.tolist())
        if fps is not None:
            base.execute("INSERT INTO metadata VALUES ('fps', ?)", (fps,))
    base.close()
    return path


def eth(path: Path, rows: np.ndarray = WALK) -> Path:
    """Every third frame of a video of 15 frames per second is annotated."""
    lines = [f"{3 * frame:.7e} {id:.7e} {x:.7e} 0.0 {y:.7e} 0.1 0.0 0.2" for frame, id, x, y in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def trajnet(path: Path, rows: np.ndarray = WALK) -> Path:
    """Frame numbers advance by 6; predictions must not be taken for people."""
    lines = [{"scene": {"id": 0, "p": 1, "s": 0, "e": 36, "fps": FPS, "tag": 0}}]
    lines += [{"track": {"f": int(6 * f), "p": int(id), "x": x, "y": y}} for f, id, x, y in rows]
    lines += [{"track": {"f": 0, "p": 1, "x": 9.0, "y": 9.0, "prediction_number": 0, "scene_id": 0}}]
    path.write_text("\n".join(json.dumps(line) for line in lines) + "\n")
    return path


def published(path: Path) -> Path:
    """Two runs of a goal, an obstacle, two agents and, in run 1, a padded place; 6 rows 0.3 s apart."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(2, 6, 5, 4)).astype(np.float32)
    states[:, :, :2, 2:] = 0
    states[:, :, :2, :2] = states[:, :1, :2, :2]
    states[1, :, 4] = 0
    edges = np.zeros((2, 5, 5), np.int64)
    edges[:, 0, 2:] = GOAL_EDGE
    edges[:, 1, 2:] = OBSTACLE_EDGE
    edges[:, 2:, 2:] = AGENT_EDGE
    edges[:, range(5), range(5)] = 0
    edges[1, :, 4] = edges[1, 4] = 0
    stem = str(path).removesuffix("_timeseries.npy")
    np.save(path, states)
    np.save(f"{stem}_edge.npy", edges)
    np.save(f"{stem}_time.npy", np.tile(np.arange(6) * 0.3, (2, 1)))
    return path


def trajectories(path: Path, config: ImportConfig, out: Path | None = None):
    out = out or path.with_suffix(".h5")
    import_files([path], config, out)
    return load(out)


# --- every format gives the same walk ---


def parquet(path: Path, **columns: object) -> Path:
    pq.write_table(pa.table(columns), path)
    return path


def matlab(path: Path, rows: np.ndarray = WALK) -> Path:
    savemat(path, {"tracks": np.asarray(rows), "about": "a walk"})
    return path


def frames(path: Path, rows: np.ndarray = WALK) -> Path:
    frame, id, x, y = np.asarray(rows, float).T
    return parquet(path, frame=frame, id=id.astype(int), x=x, y=y)


def damaged_matlab(folder: Path) -> Path:
    """Compressed, with bytes flipped in the middle."""
    path = folder / "a.mat"
    savemat(path, {"tracks": np.random.default_rng(0).normal(size=(200, 4))}, do_compression=True)
    whole = bytearray(path.read_bytes())
    for at in range(len(whole) // 2, len(whole) // 2 + 40):
        whole[at] ^= 0xFF
    path.write_bytes(bytes(whole))
    return path


MATLAB = ImportConfig(unit="m", fps=FPS, columns=("frame=1", "id=2", "x=3", "y=4"))
WRITERS = {
    "csv": (csv, "w.csv", METRES),
    "parquet": (frames, "w.parquet", ImportConfig(unit="m", fps=FPS)),
    "juelich": (juelich, "w.txt", PLAIN),
    "jupedsim": (jupedsim, "w.sqlite", PLAIN),
    "eth": (eth, "obsmat.txt", ImportConfig(fps=15.0)),
    "trajnet": (trajnet, "w.ndjson", PLAIN),
    "matlab": (matlab, "w.mat", MATLAB),
}
"""Each format's writer, a name that it is known by, and what has to be declared."""


def timestamps(path: Path) -> Path:
    clock = pa.array((1.6e18 + WALK[:, 0] * 2e8).astype("int64"), pa.timestamp("ns"))
    return parquet(path, t=clock, id=WALK[:, 1].astype(int), x=WALK[:, 2], y=WALK[:, 3])


FORMS = {name: lambda d, w=w, n=n, c=c: (w(d / n), c) for name, (w, n, c) in WRITERS.items()} | {
    "csv with units": lambda d: (csv(d / "w.csv", header="t/s,id,x [m],y (m)"), PLAIN),
    "csv renamed": lambda d: (
        csv(d / "w.csv", header="time,ped,px,py"),
        replace(METRES, columns=("t=time", "id=ped", "x=px", "y=py")),
    ),
    "csv in cm and ms": lambda d: (
        csv(d / "w.csv", WALK * [1000, 1, 100, 100]),
        ImportConfig(unit="cm", time_unit="ms"),
    ),
    "csv with semicolons and remarks": lambda d: (
        text("w.csv", "# from my camera\n" + csv(d / "v.csv").read_text().replace(",", "; "))(d),
        METRES,
    ),
    "csv by rows of time": lambda d: (csv(d / "w.csv", WALK[np.argsort(WALK[:, 0], kind="stable")]), METRES),
    "parquet with timestamps": lambda d: (timestamps(d / "w.parquet"), ImportConfig(unit="m")),
}


@pytest.mark.parametrize("form", FORMS)
def test_the_same_walk_in_every_format(form: str, tmp_path: Path):
    t = trajectories(*FORMS[form](tmp_path))
    assert (t.dt, t.substeps, t.counts) == (0.2, 1, (0, 0, 3))
    assert t.mask.shape == (1, 6, 3)
    # A person's first row has no velocity, so the stay begins at the second, and with the first such stay the run.
    assert t.mask[0].T.tolist() == [[True] * 6, [False] * 2 + [True] * 4, [True] * 6]
    np.testing.assert_allclose(t.position[0, :, 0], [[0.2 * f, 1] for f in range(1, 7)], rtol=1e-6)
    np.testing.assert_allclose(t.velocity[0, :, 0], [[1, 0]] * 6, atol=1e-5)
    np.testing.assert_allclose(t.velocity[0, 2:, 1], [[0, 0.5]] * 4, atol=1e-5)
    np.testing.assert_allclose(t.velocity[0, :, 2], [[0, 0]] * 4 + [[0, 1], [0, 0]], atol=1e-5)
    assert (t.edges[0] == AGENT_EDGE * (1 - np.eye(3))).all()
    for name in ("agent_contact", "solid_contact", "depth", "radius"):
        assert not getattr(t, name).any(), name
    assert t.max_speed == t.max_acceleration == np.inf


def test_the_published_arrays_keep_their_states_edges_and_padding(tmp_path: Path):
    path = published(tmp_path / "train_timeseries.npy")
    t = trajectories(path, ImportConfig(radius=1.0, obstacle_radius=7.0, max_speed=10.0, max_acceleration=5.0))
    states, edges = np.load(path), np.load(tmp_path / "train_edge.npy")
    assert t.counts == (1, 1, 3)
    assert t.dt == 0.3
    np.testing.assert_array_equal(np.concatenate([t.position, t.velocity], -1), states)
    np.testing.assert_array_equal(t.edges, edges)
    assert t.mask[0].all()
    assert t.mask[1].tolist() == [[True] * 4 + [False]] * 6
    assert t.radius.tolist() == [[0, 7, 1, 1, 1], [0, 7, 1, 1, 0]]
    assert (t.max_speed, t.max_acceleration) == (10, 5)
    different = trajectories(path, ImportConfig(velocity="difference"), tmp_path / "d.h5")
    np.testing.assert_allclose(
        different.velocity[0, 1:, 2], np.diff(states[0, :, 2, :2], axis=0) / 0.3, rtol=1e-4, atol=1e-5
    )
    assert different.mask[0, 0].tolist() == [True, True, False, False, False]  # what never moves has a velocity at once


def test_chasers_have_one_edge_type_and_are_all_agents(tmp_path: Path):
    path = published(tmp_path / "c_timeseries.npy")
    edges = np.zeros((2, 5, 5), int)
    edges[:, [1, 2, 3, 4, 0], [0, 1, 2, 3, 4]] = 1
    np.save(tmp_path / "c_edge.npy", edges)
    t = trajectories(path, PLAIN)
    assert t.counts == (0, 0, 5)
    np.testing.assert_array_equal(t.edges, AGENT_EDGE * edges)


def test_goals_and_obstacles_of_a_long_table(tmp_path: Path):
    """A pillar and a goal that are given once stand there always; a door that opens has a velocity."""
    rows = ["t,id,x,y,kind"]
    rows += [f"{0.1 * k:.1f},p,{k},0,pedestrian" for k in range(5)]
    rows += ["0.2,stone,7,7,pillar", "0.0,exit,9,0,goal"]
    rows += [f"{0.1 * k:.1f},door,5,{min(k, 2)},pillar" for k in range(5)]
    path = tmp_path / "w.csv"
    path.write_text("\n".join(rows))
    config = replace(METRES, columns=("type=kind",), types=("pedestrian=agent", "pillar=obstacle"))
    t = trajectories(path, config)
    assert t.counts == (1, 2, 1)
    assert t.kind[0].tolist() == [GOAL, OBSTACLE, OBSTACLE, AGENT]
    assert t.mask[0].T.tolist() == [[True] * 4] * 4  # from the walker's second row on
    np.testing.assert_array_equal(t.position[0, :, 2], [[7, 7]] * 4)
    np.testing.assert_allclose(t.velocity[0, :, 1], [[0, 10], [0, 10], [0, 0], [0, 0]], atol=1e-5)
    assert not t.velocity[0, :, [0, 2]].any()
    with pytest.raises(ImportFailed, match=r"types 'pedestrian', 'pillar' are none of goal, obstacle, agent"):
        read(path, replace(config, types=()))


def test_x_in_cm_beside_y_in_m_is_converted_as_the_header_says(tmp_path: Path):
    (track,) = read(juelich(tmp_path / "w.txt"), PLAIN)
    np.testing.assert_allclose(track.position[:7], WALK[:7, 2:])
    assert track.facts["unit of x"] == "cm (header)"
    assert track.facts["unit of y"] == "m (header)"
    assert track.facts["frame rate"] == "5 fps (header)"
    assert track.facts["z"] == "left out, varies by at most 0 m within an id"


def test_a_csv_with_x_in_cm_beside_y_in_m(tmp_path: Path):
    mixed = text("a.csv", "t [ms],id,x [cm],y (m)\n0,1,100,3\n200,1,120,3.5\n")(tmp_path)
    (track,) = read(mixed, PLAIN)
    np.testing.assert_allclose(track.position, [[1, 3], [1.2, 3.5]])
    np.testing.assert_allclose(track.time, [0, 0.2])
    assert (track.facts["unit of x"], track.facts["unit of y"]) == ("cm (header)", "m (header)")
    with pytest.raises(ImportFailed, match="its header says cm, --unit says m"):
        read(mixed, ImportConfig(unit="m"))


def test_a_frame_rate_counts_frames_alone(tmp_path: Path):
    path = text("a.csv", "t,id,x,y\n0,1,1,3\n5,1,1.2,3\n")(tmp_path)
    (track,) = read(path, ImportConfig(unit="m", time_unit="frame", fps=25.0))
    np.testing.assert_allclose(track.time, [0, 0.2])


@pytest.mark.parametrize("format", WRITERS)
def test_a_third_coordinate_that_varies_is_said_and_one_that_is_no_number_refused(format: str, tmp_path: Path):
    def written(heights: tuple[float, ...]) -> tuple[Path, ImportConfig]:
        _, name, config = WRITERS[format]
        path, rows = tmp_path / name, [(k, 1, k, 0, z) for k, z in enumerate(heights)]
        frame, id, x, y, z = np.asarray(rows).T
        lines = {
            "csv": ["t,id,x,y,z"] + [f"{k},1,{k},0,{z}" for k, *_, z in rows],
            "juelich": ["# framerate: 5 fps", "# id frame x/m y/m z/m"] + [f"1 {k} {k} 0 {z}" for k, *_, z in rows],
            "eth": [f"{k} 1 {k} {z} 0 1 0 0" for k, *_, z in rows],
            "trajnet": ['{"scene": {"fps": 5}}']
            + [json.dumps({"track": dict(zip("fpxyz", row, strict=True))}) for row in rows],
        }
        path.unlink(missing_ok=True)
        if format == "parquet":
            parquet(path, frame=frame, id=id, x=x, y=y, z=z)
        elif format == "matlab":
            savemat(path, {"tracks": np.asarray(rows)})
            config = replace(config, columns=(*config.columns, "z=5"))
        elif format == "jupedsim":
            jupedsim(path, np.asarray(rows)[:, :4])
            with sqlite3.connect(path) as base:
                base.execute("ALTER TABLE trajectory_data ADD COLUMN pos_z REAL")
                base.executemany("UPDATE trajectory_data SET pos_z = ? WHERE frame = ?", [(r[4], r[0]) for r in rows])
            base.close()
        else:
            path.write_text("\n".join(lines[format]))
        return path, config

    (track,) = read(*written((1.7, 1.75, 1.72)))
    assert track.facts["z"] == "left out, varies by at most 0.05 m within an id"
    (track,) = read(*written((1.7, 2.5, 3.4)))
    assert "left out although it varies by up to 1.7 m" in track.facts["z"]
    assert track.position.shape == (3, 2)
    with pytest.raises(ImportFailed, match="z is not finite"):
        read(*written((1.7, np.nan, 3.4)))


def test_heights_are_compared_within_a_run(tmp_path: Path):
    path = text("a.csv", "run,t,id,x,y,z\na,0,1,0,0,1.7\na,1,1,1,0,1.8\nb,0,1,0,0,3.0\nb,1,1,1,0,3.0\n")(tmp_path)
    assert read(path, METRES)[0].facts["z"] == "left out, varies by at most 0.1 m within an id"


def test_the_rate_of_trajnet_scenes_that_say_none_is_declared(tmp_path: Path):
    lines = '{"scene": {"id": 0}}\n' + "\n".join(
        f'{{"track": {{"f": {10 * k}, "p": 1, "x": 0, "y": 0}}}}' for k in (0, 1)
    )
    path = text("a.ndjson", lines)(tmp_path)
    (track,) = read(path, ImportConfig(fps=2.5))
    np.testing.assert_allclose(track.time, [0, 0.4])
    with pytest.raises(ImportFailed, match="give --fps"):
        read(path, PLAIN)


def test_a_rate_that_contradicts_the_published_times_is_refused(tmp_path: Path):
    path = published(tmp_path / "a_timeseries.npy")
    with pytest.raises(
        ImportFailed, match=r"a_time.npy: rows are 0.3 s apart, --fps says 25 a second; leave --fps out"
    ):
        read(path, ImportConfig(fps=25.0))
    assert len(read(path, ImportConfig(fps=1 / 0.3))) == 2
    (tmp_path / "a_time.npy").unlink()
    assert spacing(read(path, ImportConfig(fps=25.0))[0]) == 0.04


@pytest.mark.parametrize("format", ["juelich", "jupedsim", "eth", "trajnet"])
@pytest.mark.parametrize(
    ("option", "value", "of"),
    [
        ("time_unit", "s", "csv, parquet, matlab"),
        ("columns", ("t=a",), "csv, parquet, matlab"),
        ("types", ("a=agent",), "csv, parquet, matlab"),
        ("variable", "a", "matlab"),
    ],
)
def test_options_that_a_format_does_not_read_are_refused(
    format: str, option: str, value: object, of: str, tmp_path: Path
):
    write, name, config = WRITERS[format]
    config = replace(config, **{option: value})
    path = write(tmp_path / name)
    with pytest.raises(SpecError, match=f"{option}.*nothing for {format}: it belongs to {of}"):
        import_files([path], config, tmp_path / "out.h5")
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_an_option_may_be_for_one_file_of_several(tmp_path: Path):
    mixed = [csv(tmp_path / "a.csv"), juelich(tmp_path / "b.txt", header="# framerate: 5\n# id frame x/cm y/m\n")]
    mixed[0].write_text(mixed[0].read_text().replace("x,y", "x/m,y/m"))
    import_files(mixed, ImportConfig(time_unit="s"), tmp_path / "out.h5")
    assert len(load(tmp_path / "out.h5")) == 2


def test_a_height_that_some_tracks_lack_is_refused(tmp_path: Path):
    lines = '{"scene": {"fps": 2}}\n{"track": {"f": 0, "p": 1, "x": 0, "y": 0}}\n'
    path = text("a.ndjson", lines + '{"track": {"f": 1, "p": 1, "x": 0, "y": 0, "z": 1.7}}\n')(tmp_path)
    with pytest.raises(ImportFailed, match="z is not finite in some rows"):
        read(path, PLAIN)


@pytest.mark.parametrize("header", ["# id frame x [cm] y [m] z [m]", "# id frame x[cm] y(m) z (m)"])
def test_units_in_brackets_are_no_columns(header: str, tmp_path: Path):
    (plain,) = read(juelich(tmp_path / "a.txt"), PLAIN)
    (bracketed,) = read(juelich(tmp_path / "b.txt", header=f"# framerate: 5 fps\n{header}\n"), PLAIN)
    np.testing.assert_array_equal(bracketed.position, plain.position)


@pytest.mark.parametrize("name", ["PersID", "pers_id", "PersonID", "ped"])
def test_columns_of_a_juelich_header_are_found_by_name(name: str, tmp_path: Path):
    head = f"# framerate: 5\n# framerate: 5.0 fps\n# Frame {name} X/cm Y/m\n# x and y are of the head\n"
    (track,) = read(text("a.txt", head + "0 7 100 2\n1 7 120 2\n0 8 300 2\n")(tmp_path), PLAIN)
    assert track.labels == ("7", "8")
    np.testing.assert_allclose(track.time, [0, 0.2, 0])
    np.testing.assert_allclose(track.position, [[1, 2], [1.2, 2], [3, 2]])


def test_prose_about_x_and_y_is_no_juelich_header(tmp_path: Path):
    head = "# framerate: 5\n# x and y are those of the head\n"
    (track,) = read(text("a.txt", head + "7 0 1 2\n7 1 2 2\n")(tmp_path), METRES)
    assert track.labels == ("7",)


def test_two_files_of_different_declared_units(tmp_path: Path):
    first = juelich(tmp_path / "a.txt", header="# framerate: 5\n# id frame x/cm y/m\n")
    second = jupedsim(tmp_path / "b.sqlite")
    import_files([first, second], PLAIN, tmp_path / "out.h5")
    t = load(tmp_path / "out.h5")
    assert len(t) == 2
    np.testing.assert_allclose(t.position[0], t.position[1], atol=1e-6)


def test_motion_in_three_dimensions_is_said(tmp_path: Path):
    path = tmp_path / "w.csv"
    path.write_text("t,id,x,y,z\n" + "\n".join(f"{k},1,{k},0,{k}" for k in range(4)))
    (track,) = read(path, METRES)
    assert "varies by up to 3 m" in track.facts["z"]
    assert track.position.shape == (4, 2)


def test_eth_says_how_its_own_speeds_compare(tmp_path: Path):
    path = tmp_path / "obsmat.txt"
    path.write_text("\n".join(f"{6 * k} 1 {0.4 * k} 0 0 1.0 0 0" for k in range(5)))
    (track,) = read(path, ImportConfig(fps=15.0))  # 0.4 m in 6/15 s is 1 m/s, as the file says
    assert "is 1 times" in track.facts["check of the frame rate"]
    (track,) = read(path, ImportConfig(fps=25.0))
    assert "is 1.67 times" in track.facts["check of the frame rate"]


# --- what is broken is said once and clearly ---


DEFECTS = {
    "twice": (np.vstack([WALK, WALK[-1:]]), "1 rows repeat an id at a time, first id 3 at t = 1.2 s"),
    "back in time": (WALK[[0, 1, 3, 2, 4]], "time goes backwards for id 1, from 0.6 s in data row 3 to 0.4 s"),
    "nan": (
        np.where(np.arange(19)[:, None] == 4, WALK * [1, 1, np.nan, 1], WALK),
        "x is nan in 1 of 19 rows|no number",
    ),
    "no rows": (WALK[:0], "no rows of data|[Ee]mpty|tables of numbers with 4 columns or more: none"),
}


@pytest.mark.parametrize("defect", DEFECTS)
@pytest.mark.parametrize("format", WRITERS)
def test_the_same_defect_in_every_format(format: str, defect: str, tmp_path: Path):
    (write, name, config), (rows, message) = WRITERS[format], DEFECTS[defect]
    path = write(tmp_path / name, rows)
    if (format, defect) == ("jupedsim", "back in time"):  # a table has no order; it is read by time
        assert len(read(path, config)[0].time) == 5
        return
    with pytest.raises(ImportFailed, match=message) as error:
        import_files([path], config, tmp_path / "out.h5")
    assert name in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("format", WRITERS)
def test_an_empty_file_and_one_agent_in_every_format(format: str, tmp_path: Path):
    write, name, config = WRITERS[format]
    (tmp_path / name).touch()
    with pytest.raises(ImportFailed, match=f"{name}: is empty"):
        read(tmp_path / name, config)
    (tmp_path / name).unlink()
    t = trajectories(write(tmp_path / name, WALK[:7]), config, tmp_path / "out.h5")
    assert t.mask.shape == (1, 6, 1)
    assert not t.edges.any()
    np.testing.assert_allclose(t.velocity[0, :, 0], [[1, 0]] * 6, atol=1e-5)


BROKEN = {
    "csv without header": (text("a.csv", "0,1,2,3\n1,1,3,3\n"), METRES, "a line with the columns' names is missing"),
    "csv other columns": (
        text("a.csv", "time,x,y\n0,1,2\n"),
        METRES,
        r"no column t \(or frame\), id among 'time', 'x'",
    ),
    "csv mapped to nothing": (
        text("a.csv", "t,id,x,y\n0,1,2,3\n"),
        replace(METRES, columns=("id=ped",)),
        "no column 'ped'; it has 't', 'id'",
    ),
    "csv no unit": (text("a.csv", "t,id,x,y\n0,1,2,3\n"), ImportConfig(time_unit="s"), "give --unit, one of m"),
    "csv no time unit": (text("a.csv", "t,id,x,y\n0,1,2,3\n"), ImportConfig(unit="m"), "give --time-unit"),
    "csv frames without rate": (text("a.csv", "frame,id,x,y\n0,1,2,3\n"), ImportConfig(unit="m"), "give --fps"),
    "csv unit of times beside frames": (
        text("a.csv", "frame,id,x,y\n0,1,2,3\n1,1,2,3\n"),
        replace(METRES, fps=25.0),
        "--time-unit says s, and the only clock is column 'frame', which counts frames; leave --time-unit out, or say",
    ),
    "csv rate beside times": (
        text("a.csv", "t,id,x,y\n0,1,2,3\n"),
        replace(METRES, fps=25.0),
        "--fps says 25 frames per second, and column 't' holds times; leave --fps out",
    ),
    "csv unit said twice": (text("a.csv", "t,id,x/cm,y/cm\n0,1,2,3\n"), METRES, "says cm, --unit says m"),
    "csv unknown unit": (text("a.csv", "t,id,x/ell,y/m\n0,1,2,3\n"), METRES, "'ell', known are m, dm"),
    "csv word": (text("a.csv", "t,id,x,y\n0,1,2,3\n1,1,two,3\n"), METRES, "column x: .*two"),
    "csv short row": (text("a.csv", "t,id,x,y\n0,1,2,3\n1,1,3\n"), METRES, "Expected 4 columns, got 3"),
    "csv nan": (
        text("a.csv", "t,id,x,y\n0,1,2,3\n1,1,nan,3\n"),
        METRES,
        r"x is nan in 1 of 2 rows.*data row 2 \(id 1\)",
    ),
    "csv missing value": (text("a.csv", "t,id,x,y\n0,1,2,3\n1,1,,3\n"), METRES, "x is nan in 1 of 2 rows"),
    "csv infinite": (text("a.csv", "t,id,x,y\n0,1,2,3\n1,1,3,inf\n"), METRES, "y is inf"),
    "csv garbage": (text("a.csv", bytes(range(256)) * 4), METRES, "a.csv: is not text"),
    "csv two types": (
        text("a.csv", "t,id,x,y,type\n0,1,2,3,agent\n1,1,2,3,goal\n"),
        METRES,
        "id 1 is agent and goal, a type must stay the same",
    ),
    "parquet garbage": (text("a.parquet", b"PAR1 and nothing"), METRES, "a.parquet: is no whole Parquet file"),
    "parquet other columns": (
        lambda d: parquet(d / "a.parquet", time=[0.0], x=[1.0], y=[2.0]),
        METRES,
        r"no column t \(or frame\), id among 'time', 'x', 'y'; say which is which, such as --columns t=time",
    ),
    "parquet mapped to nothing": (
        lambda d: parquet(d / "a.parquet", t=[0.0], id=[1], x=[1.0], y=[2.0]),
        replace(METRES, columns=("id=ped",)),
        "has no column 'ped'; it has 't', 'id', 'x', 'y'",
    ),
    "juelich no rate": (text("a.txt", "# id frame x/m y/m z/m\n1 0 1 1 1\n"), PLAIN, "frames a second has; give --fps"),
    "juelich no units": (text("a.txt", "# framerate: 25\n1 0 1 1 1\n"), PLAIN, "unit of positions; give --unit"),
    "juelich rate said twice": (
        text("a.txt", "# framerate: 25\n# id frame x/m y/m\n1 0 1 1\n"),
        ImportConfig(fps=10.0),
        "says 25 frames per second, --fps says 10",
    ),
    "juelich no x": (
        text("a.txt", "# framerate: 25\n# id frame y/m\n1 0 1 1\n"),
        PLAIN,
        "header names no column for x",
    ),
    "juelich an unknown name of ids": (
        text("a.txt", "# framerate: 25\n# Frame Who X/cm Y/cm\n0 1 1 1\n"),
        PLAIN,
        r"header names no column for id \(known are id, persid, pers_id, personid, ped\): Frame Who X/cm Y/cm",
    ),
    "juelich unit said twice": (
        text("a.txt", "# framerate: 25\n# PersID Frame X/cm Y/m\n1 0 1 1\n"),
        ImportConfig(unit="m"),
        "its header says cm, --unit says m",
    ),
    "juelich two names of ids": (
        text("a.txt", "# framerate: 25\n# id PersID frame x/m y/m\n1 1 0 1 1\n"),
        PLAIN,
        "header names id more than once: id PersID",
    ),
    "juelich two rates": (
        text("a.txt", "# framerate: 25\n# framerate: 30\n# id frame x/m y/m\n1 0 1 1\n"),
        PLAIN,
        "its header names several frame rates: 25, 30",
    ),
    "juelich more names than columns": (
        text("a.txt", "# framerate: 25\n# id frame x/m y/m z/m\n1 0 1 1\n"),
        PLAIN,
        "rows have 4 columns, its header names 5",
    ),
    "csv a column twice": (text("a.csv", "t,id,x,y,x\n0,1,2,3,4\n"), METRES, "has the column 'x' more than once"),
    "csv nobody": (text("a.csv", "t,id,x,y\n0,1,2,3\n1,,2,3\n"), METRES, "1 rows have no id"),
    "trajnet something else": (text("a.ndjson", '{"scene": {"fps": 2}}\n{"foo": 1}\n'), PLAIN, "line 2 is neither"),
    "trajnet a list": (text("a.ndjson", "[1, 2]\n"), PLAIN, "line 1 is neither"),
    "matlab damaged": (damaged_matlab, PLAIN, "is no whole MATLAB v5 file"),
    "matlab nobody": (
        lambda d: matlab(d / "a.mat", np.array([[0, np.nan, 1, 1], [1, 2, 1, 1]])),
        replace(METRES, columns=("t=1", "id=2", "x=3", "y=4")),
        "1 rows have no id",
    ),
    "published cut off": (
        text("a_timeseries.npy", b"\x93NUMPY\x01\x00\x10\x00{'descr': '<f4', "),
        PLAIN,
        "is no array of numbers",
    ),
    "published an archive": (text("a_timeseries.npy", b"PK\x03\x04 nothing"), PLAIN, "is no array of numbers"),
    "juelich columns change": (
        text("a.txt", "# framerate: 25\n# id frame x/m y/m z/m\n1 0 1 1 1\n1 1 1 1\n"),
        PLAIN,
        "line 4 has 4 columns, those before it 5; expected are the columns id frame x y",
    ),
    "juelich word": (
        text("a.txt", "# framerate: 25\n# id frame x/m y/m\n1 0 1 1\n1 1 one 1\n"),
        PLAIN,
        "line 4 has 'one' where a number should be",
    ),
    "juelich id": (
        text("a.txt", "# framerate: 25\n# id frame x/m y/m\n1 0 1 1\nnan 1 1 1\n"),
        PLAIN,
        r"id is nan in 1 of 2 rows, first in data row 2",
    ),
    "juelich header alone": (text("a.txt", "# framerate: 25\n# id frame x/m y/m z/m\n"), PLAIN, "no rows of data"),
    "juelich garbage": (text("a.txt", b"\xff\xfe\x00garbage\n\x80"), PLAIN, "a.txt: is not text"),
    "eth no rate": (text("obsmat.txt", "0 1 1 0 1 0 0 0\n"), PLAIN, "give --fps"),
    "eth columns": (text("obsmat.txt", "0 1 1 0\n"), ImportConfig(fps=15.0), "rows have 4 columns, expected are the 8"),
    "trajnet no json": (text("a.ndjson", "{]\n"), PLAIN, "line 1 is neither a scene nor a track"),
    "trajnet no rate": (
        text("a.ndjson", '{"track": {"f": 0, "p": 1, "x": 0, "y": 0}}\n'),
        PLAIN,
        "give --fps",
    ),
    "trajnet two rates": (
        text("a.ndjson", '{"scene": {"fps": 2}}\n{"scene": {"fps": 3}}\n'),
        PLAIN,
        "several frame rates: 2, 3",
    ),
    "trajnet no tracks": (text("a.ndjson", '{"scene": {"fps": 2}}\n'), PLAIN, "no rows of data"),
    "jupedsim garbage": (text("a.sqlite", b"not a database"), PLAIN, "is no SQLite database"),
    "jupedsim truncated": (
        lambda d: text("b.sqlite", jupedsim(d / "a.sqlite").read_bytes()[:5000])(d),
        PLAIN,
        "b.sqlite: a damaged or locked SQLite database",
    ),
    "jupedsim no rate": (lambda d: jupedsim(d / "a.sqlite", fps=None), PLAIN, "give --fps"),
    "jupedsim bad rate": (lambda d: jupedsim(d / "a.sqlite", fps="many"), PLAIN, "says fps 'many'"),
    "jupedsim no rows": (lambda d: jupedsim(d / "a.sqlite", WALK[:0]), PLAIN, "no rows of data"),
    "matlab garbage": (text("a.mat", b"MATLAB 5.0 MAT-file" + bytes(200)), PLAIN, "is no whole MATLAB v5 file"),
    "matlab 7.3": (text("a.mat", b"MATLAB 7.3 MAT-file" + bytes(200)), PLAIN, "v7.3; save it"),
    "unknown ending": (text("a.xyz", "1"), PLAIN, "give --format, one of csv"),
    "missing": (lambda d: d / "a.csv", METRES, "a.csv: does not exist"),
    "a folder": (lambda d: (d / "a.csv").mkdir() or d / "a.csv", METRES, "a.csv: is a folder"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_clear_message(case: str, tmp_path: Path, capsys):
    make, config, message = BROKEN[case]
    path = make(tmp_path)
    before = sorted(p.name for p in tmp_path.iterdir())
    with pytest.raises(ImportFailed, match=message) as error:
        import_files([path], config, tmp_path / "out.h5")
    assert "\n" not in str(error.value)
    assert path.name in str(error.value)
    assert sorted(p.name for p in tmp_path.iterdir()) == before, "nothing may be written"


def test_a_foreign_database_says_what_it_holds(tmp_path: Path):
    with sqlite3.connect(tmp_path / "a.db") as base:
        base.execute("CREATE TABLE birds (name TEXT)")
    base.close()
    with pytest.raises(ImportFailed, match=r"no JuPedSim database: .*it has the tables birds"):
        read(tmp_path / "a.db", PLAIN)


def test_matlab_columns_and_tables_are_named(tmp_path: Path):
    path = tmp_path / "a.mat"
    savemat(path, {"one": WALK, "two": WALK})
    config = ImportConfig(unit="m", fps=FPS, columns=("frame=1", "id=2", "x=3", "y=4"))
    with pytest.raises(ImportFailed, match="4 columns or more: one, two; name one with --variable"):
        read(path, config)
    assert len(read(path, replace(config, variable="two"))) == 1
    with pytest.raises(ImportFailed, match="has no table 'three'"):
        read(path, replace(config, variable="three"))
    with pytest.raises(ImportFailed, match="say which is t \\(or frame\\), id, x, y"):
        read(path, replace(config, variable="two", columns=()))
    with pytest.raises(SpecError, match="'x=9' was given, allowed is numbers from 1 to 4"):
        read(path, replace(config, variable="two", columns=("x=9",)))


def test_large_ids_stay_apart(tmp_path: Path):
    rows = np.add(WALK, [0, 20_240_000, 0, 0])
    for write, name, config in WRITERS.values():
        (found,) = read(write(tmp_path / name, rows), config)
        assert found.labels == ("20240001", "20240002", "20240003"), name


def test_published_arrays_that_are_missing_empty_or_in_space(tmp_path: Path):
    path = published(tmp_path / "a_timeseries.npy")
    states, edges = np.load(path), tmp_path / "a_edge.npy"
    np.save(path, np.concatenate([states, states[..., :2]], axis=-1))
    with pytest.raises(ImportFailed, match=r"a_timeseries.npy: nodes have 6 numbers, expected are 4: x, y, vx, vy"):
        read(path, PLAIN)
    path.write_bytes(b"")
    with pytest.raises(ImportFailed, match=r"a_timeseries.npy: is empty"):
        read(path, PLAIN)
    np.save(path, states)
    edges.write_bytes(b"")
    with pytest.raises(ImportFailed, match=r"a_edge.npy: is empty"):
        read(path, PLAIN)
    edges.unlink()
    with pytest.raises(ImportFailed, match=r"a_edge.npy: does not exist"):
        read(path, PLAIN)


def test_published_arrays_of_one_agent(tmp_path: Path):
    path = published(tmp_path / "a_timeseries.npy")
    states = np.load(path)[:, :, 2:3]
    np.save(path, states)
    np.save(tmp_path / "a_edge.npy", np.zeros((2, 1, 1), int))
    t = trajectories(path, PLAIN)
    assert t.counts == (0, 0, 1)
    assert t.mask.all()
    assert not t.edges.any()
    np.testing.assert_array_equal(np.concatenate([t.position, t.velocity], -1), states)


@pytest.mark.parametrize("format", ["jupedsim", "eth", "trajnet", "published"])
def test_a_unit_that_contradicts_the_format_is_refused(format: str, tmp_path: Path):
    write, name, config = WRITERS.get(format, (published, "a_timeseries.npy", PLAIN))
    path = write(tmp_path / name)
    with pytest.raises(ImportFailed, match=f"{name}: its format says m, --unit says cm"):
        read(path, replace(config, unit="cm"))
    assert read(path, replace(config, unit="m"))[0].facts["unit"] == "m (format)"


def test_broken_published_arrays(tmp_path: Path):
    path = published(tmp_path / "a_timeseries.npy")
    edges = np.load(tmp_path / "a_edge.npy")
    np.save(tmp_path / "a_edge.npy", edges[:, :4])
    with pytest.raises(ImportFailed, match=r"a_edge.npy: has the shape \(2, 4, 5\), .* \(2, 5, 5\)"):
        read(path, PLAIN)
    np.save(tmp_path / "a_edge.npy", np.where(edges == 3, 7, edges))
    with pytest.raises(ImportFailed, match="of a second species"):
        read(path, PLAIN)
    np.save(tmp_path / "a_edge.npy", np.where(np.arange(5) == 0, 3, edges))
    with pytest.raises(ImportFailed, match="sends as a goal and receives"):
        read(path, PLAIN)
    np.save(tmp_path / "a_edge.npy", edges)
    (tmp_path / "a_time.npy").unlink()
    with pytest.raises(ImportFailed, match=r"a_time.npy: does not exist; give --dt"):
        read(path, PLAIN)
    assert spacing(read(path, ImportConfig(dt=0.1))[0]) == 0.1
    states = np.load(path)
    np.save(path, np.where(np.arange(4) == 1, np.nan, states))
    with pytest.raises(ImportFailed, match=r"a_timeseries.npy run 0: y is nan in 30 of 30 rows"):
        read(path, ImportConfig(dt=0.1))
    np.save(path, states[:0])
    with pytest.raises(ImportFailed, match=r"a_timeseries.npy: no rows of data"):
        read(path, PLAIN)
    np.save(path, states)
    for times, message in (([0, 1, 1, 2, 3, 4], "5 rows repeat"), ([0, 2, 1, 3, 4, 5], "time goes backwards")):
        np.save(tmp_path / "a_time.npy", [times] * 2)
        with pytest.raises(ImportFailed, match=message):
            read(path, PLAIN)
    np.save(path, np.asarray([{"x": 1}], object), allow_pickle=True)
    with pytest.raises(ImportFailed, match=r"a_timeseries.npy: is no array of numbers.*allow_pickle"):
        read(path, PLAIN)
    with pytest.raises(ImportFailed, match=r"name the file that ends in _timeseries.npy"):
        read(tmp_path / "a_edge.npy", ImportConfig(format="published"))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("fps", 0.0),
        ("dt", -1.0),
        ("holdout", 1.0),
        ("segment", -1.0),
        ("radius", float("inf")),
        ("columns", ("time",)),
        ("columns", ("when=time",)),
        ("columns", ("t=a", "t=b")),
        ("types", ("car=vehicle",)),
        ("gap", "interpolate"),
        ("max_gap", 1.0),
        ("substeps", 0),
        ("substeps", 2),
        ("max_speed", 0.0),
    ],
)
def test_options_that_make_no_sense(field: str, value: object):
    with pytest.raises(SpecError):
        ImportConfig(**{field: value})


# --- the grid: resampling, velocities, gaps ---


def track(time, x, *, id=None, kind=None, velocity=None, y=0.0):
    time, x = np.asarray(time, float), np.asarray(x, float)
    return tracks_of(
        "run",
        time=time,
        id=np.zeros(len(time), int) if id is None else np.asarray(id),
        position=np.stack([x, np.full(len(x), float(y))], axis=1),
        kind=kind,
        velocity=velocity,
        facts={},
    )


def test_resampling_is_linear_and_stays_inside_the_stay():
    """By hand: rows at 0.1, 0.2, 0.4, 0.5 s of somebody else's clock that starts at 0; x = 1, 2, 6, 7."""
    both = track(
        [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.55, 0.1, 0.2, 0.3, 0.45], [0] * 7 + [1, 2, 3, 6], id=[0] * 7 + [1] * 4
    )
    s = sampled(both, 0.15, ImportConfig(dt=0.15))
    mine = s.person == 1  # the grid is 0, 0.15, 0.3, 0.45, ...; the stay [0.1, 0.45] has 0.15, 0.3, 0.45
    assert s.row[mine].tolist() == [2, 3]
    np.testing.assert_allclose(s.position[mine, 0], [3, 6])
    np.testing.assert_allclose(s.velocity[mine, 0], [(3 - 1.5) / 0.15, (6 - 3) / 0.15])


@settings(max_examples=40)
@given(
    step=st.floats(0.02, 0.5),
    every=st.integers(1, 4),
    rows=st.integers(6, 30),
    start=st.floats(-1e3, 1e5),
    seed=st.integers(0, 999),
)
def test_every_nth_row_is_taken_exactly_and_the_decoder_is_exact(
    step: float, every: int, rows: int, start: float, seed: int
):
    """At a multiple of the recording's step nothing is interpolated, and x' = x + v' dt to rounding."""
    x = np.random.default_rng(seed).normal(size=rows).cumsum()
    step = float(f"{step:.4g}")
    s = sampled(track(start + step * np.arange(rows), x), every * step, ImportConfig(dt=every * step))
    expected = x[::every]
    np.testing.assert_array_equal(s.position[:, 0], expected[1:])
    np.testing.assert_allclose(s.position[:-1, 0] + s.velocity[1:, 0] * every * step, s.position[1:, 0], atol=1e-9)


@settings(max_examples=40)
@given(seed=st.integers(0, 9999), dt=st.floats(0.1, 0.7))
def test_no_velocity_knows_the_future(seed: int, dt: float):
    """What happens after a grid row and the recorded row that follows it changes nothing up to there."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=40).cumsum()
    other = x.copy()
    other[21:] += rng.normal(size=19)
    a, b = (sampled(track(0.1 * np.arange(40), v), dt, ImportConfig(dt=dt)) for v in (x, other))
    before = a.row * dt <= 2.0
    np.testing.assert_array_equal(a.velocity[before], b.velocity[before])
    np.testing.assert_array_equal(a.position[before], b.position[before])
    inside = a.row * dt
    assert (inside <= 3.9 + 1e-4 * dt).all()  # a row within 1e-4 of a step of the grid is on it


def test_gaps_are_refused_split_or_bridged():
    """Rows at 0..3 and 6..8 and 15..17 tenths of a second: gaps of 0.3 s and 0.7 s."""
    time = np.asarray([0, 1, 2, 3, 6, 7, 8, 15, 16, 17]) / 10
    gappy = track(time, 10 * time)
    with pytest.raises(ImportFailed, match=r"id 0 has no rows for 0.3 s after t = 0.3 s .*--gap split"):
        sampled(gappy, 0.1, PLAIN)
    split = sampled(gappy, 0.1, ImportConfig(gap="split"))
    assert split.row.tolist() == [1, 2, 3, 7, 8, 16, 17]
    assert [(gap.start, round(gap.length, 6), gap.bridged) for gap in split.gaps] == [
        (0.3, 0.3, False),
        (0.8, 0.7, False),
    ]
    bridged = sampled(gappy, 0.1, ImportConfig(gap="interpolate", max_gap=0.5))
    assert bridged.row.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 16, 17]
    np.testing.assert_allclose(bridged.velocity[:, 0], 10)
    assert [gap.bridged for gap in bridged.gaps] == [True, False]


def test_the_time_step_is_the_recordings_or_declared():
    even = track(np.arange(5) * 0.04, range(5))
    assert time_step([even], PLAIN) == 0.04
    assert time_step([even], ImportConfig(dt=0.16)) == 0.16
    with pytest.raises(SpecError, match=r"at least 0.04 s, the spacing of run: rows between would be invented"):
        time_step([even], ImportConfig(dt=0.01))
    with pytest.raises(ImportFailed, match=r"unevenly spaced.*give --dt"):
        time_step([track([0, 0.1, 0.23, 0.3, 0.41], range(5))], PLAIN)
    with pytest.raises(ImportFailed, match=r"0.04 s apart in run and 0.1 s in run; give --dt"):
        time_step([even, track(np.arange(5) * 0.1, range(5))], PLAIN)
    with pytest.raises(ImportFailed, match="nobody has two rows"):
        time_step([track([0], [0])], PLAIN)


def test_the_files_own_velocities_are_kept_when_asked_for(tmp_path: Path):
    path = tmp_path / "w.csv"
    path.write_text("t,id,x/cm,y/cm,vx,vy\n" + "\n".join(f"{k},1,{k},0,{100 * k},0" for k in range(4)))
    config = ImportConfig(time_unit="s", velocity="file", substeps=3)
    t = trajectories(path, config)
    np.testing.assert_allclose(t.velocity[0, :, 0, 0], [0, 1, 2, 3])
    assert t.substeps == 3
    with pytest.raises(ImportFailed, match="has no velocities"):
        trajectories(csv(tmp_path / "v.csv"), replace(METRES, velocity="file"))


@pytest.mark.parametrize(
    ("header", "columns", "factor"),
    [
        ("x/cm,y/cm,vx/m/s,vy/m/s", (), (1, 1)),
        ("x/cm,y/cm,vx [m/s],vy (cm/s)", (), (1, 0.01)),
        ("x/cm,y/cm,u [m / s],vy", ("vx=u",), (1, 0.01)),
        ("x/m,y/m,vx [cm/s],vy", ("vx=vx [cm/s]",), (0.01, 1)),
    ],
)
def test_velocities_have_their_own_unit_or_that_of_positions(
    header: str, columns: tuple[str, ...], factor: tuple[float, float], tmp_path: Path
):
    path = text("a.csv", f"t/s,id,{header}\n0,1,0,0,3,4\n1,1,1,1,3,4\n")(tmp_path)
    (track,) = read(path, ImportConfig(velocity="file", columns=columns))
    np.testing.assert_allclose(track.velocity, [[3 * factor[0], 4 * factor[1]]] * 2)


@pytest.mark.parametrize("unit", ["m/min", "px/s", "m", "km/h"])
def test_other_units_of_velocities_are_refused_where_they_are_used(unit: str, tmp_path: Path):
    path = text("a.csv", f"t/s,id,x/m,y/m,vx [{unit}],vy\n0,1,0,0,3,4\n1,1,1,1,3,4\n")(tmp_path)
    with pytest.raises(ImportFailed, match=f"says unit of velocities '{unit}', known are m/s, dm/s"):
        read(path, ImportConfig(velocity="file"))
    assert len(read(path, PLAIN)[0].time) == 2


# --- scenes, hold-out ---


def crowd(people: int = 10, rows: int = 8, *, apart: int = 3):
    """Person i is there from row `apart` i for `rows` rows, one second apart, walking at 1 m/s."""
    time = np.concatenate([apart * i + np.arange(rows) for i in range(people)]).astype(float)
    id = np.repeat(np.arange(people), rows)
    return track(time, time + 0.5 * id, id=id)


def test_a_long_recording_becomes_scenes_of_those_present():
    samples = sampled(crowd(), 1.0, PLAIN)
    config = ImportConfig(segment=5.0)
    rows = rows_per_scene([samples], 1.0, config)
    scenes = cut([samples], rows)
    assert rows == 5
    (t,) = assembled(scenes, rows=rows, dt=1.0, config=config, provenance={})
    # Person i has velocities in rows 3 i + 1 .. 3 i + 7: 0 and 1 are in rows 0 to 4, 0 to 2 in 5 to 9, and so on.
    assert t.mask.any(axis=1).sum(axis=1).tolist() == [2, 3, 4, 4, 3, 4, 2]
    assert t.counts == (0, 0, 4)
    assert t.mask.sum() == len(samples.row) == 70
    present = t.mask.any(axis=1)
    assert (t.edges[0] > 0).sum() == 2
    assert not t.position[~t.mask].any()
    assert not (t.edges.astype(bool) & ~(present[:, :, None] & present[:, None])).any()
    whole = rows_per_scene([samples], 1.0, ImportConfig(segment=0.0))
    (t,) = assembled(cut([samples], whole), rows=whole, dt=1.0, config=ImportConfig(segment=0.0), provenance={})
    assert t.mask.shape == (1, 35, 10)


@settings(max_examples=30)
@given(seed=st.integers(0, 9999), rows=st.integers(2, 9))
def test_cutting_neither_loses_nor_changes_a_row(seed: int, rows: int):
    """Every sample of a person with two rows in a scene is found again, whatever the order of people."""
    rng = np.random.default_rng(seed)
    people = int(rng.integers(1, 6))
    starts, lengths = rng.integers(0, 12, people), rng.integers(2, 12, people)
    time = np.concatenate([s + np.arange(n) for s, n in zip(starts, lengths, strict=True)]).astype(float)
    x = rng.normal(size=len(time)).astype(np.float32).astype(float)
    samples = sampled(track(time, x, id=np.repeat(rng.permutation(people), lengths)), 1.0, PLAIN)
    scenes = cut([samples], rows)
    kept = np.concatenate([scene.which for scene in scenes]) if scenes else np.zeros(0, int)
    assert len(np.unique(kept)) == len(kept)
    lost = np.setdiff1d(np.arange(len(samples.row)), kept)
    for number in np.unique(samples.row[lost] // rows):
        inside = samples.row // rows == number
        assert samples.row[inside].max() == samples.row[inside].min()
    if scenes:
        parts = list(assembled(scenes, rows=rows, dt=1.0, config=PLAIN, provenance={}))
        found = np.concatenate([t.position[t.mask][:, 0] for t in parts])
        np.testing.assert_array_equal(np.sort(found), np.sort(samples.position[kept, 0].astype(np.float32)))


def test_held_out_people_are_never_in_training_and_their_scenes_are_complete():
    samples = sampled(crowd(), 1.0, PLAIN)
    (train,), (held,), words = held_out([samples], ImportConfig(holdout=0.2))
    assert set(train.person) == set(range(8))
    assert set(held.person) == {8, 9}
    assert train.rows == 3 * 7 + 8  # until person 7 has gone
    first = 3 * 7 + 8
    at = samples.row >= first
    assert held.row.tolist() == (samples.row[at] - first).tolist()  # everybody who is there then is held out
    assert "20% of people" in words


def test_runs_are_held_out_whole():
    runs = [replace(sampled(crowd(3), 1.0, PLAIN), start=float(i)) for i in range(5)]
    train, held, _ = held_out(runs, ImportConfig(holdout=0.4))
    assert [run.start for run in train] == [0, 1, 2]
    assert [run.start for run in held] == [3, 4]
    with pytest.raises(SpecError, match="leaves some of 5 runs"):
        held_out(runs, ImportConfig(holdout=0.95))


def test_holding_out_people_needs_people_who_stay_longer():
    together = sampled(crowd(4, apart=0), 1.0, PLAIN)
    with pytest.raises(ImportFailed, match=r"nothing is left when all but 1 of 4 people have gone.*--holdout-by time"):
        held_out([together], ImportConfig(holdout=0.2))
    (train,), (held,), words = held_out([together], ImportConfig(holdout=0.25, holdout_by="time"))
    assert (train.rows, held.rows) == (6, 2)
    assert "the same people may be in both" in words


# --- figures, card, files ---


def test_the_survey_measures_speed_spacing_and_outliers():
    """One walks at 2 m/s and jumps 30 m once, another stands 3 m beside its way."""
    x = 2.0 * np.arange(30)
    x[20:] += 30
    stand = np.full(30, 5.0)
    both = track(np.tile(np.arange(30.0), 2), np.concatenate([x, stand]), id=np.repeat([0, 1], 30))
    both = replace(both, position=both.position + np.where(both.id == 1, 3.0, 0.0)[:, None] * [0, 1])
    figures = survey([sampled(both, 1.0, PLAIN)], 1.0, ImportConfig(outlier_speed=10.0, outlier_acceleration=5.0))
    assert figures.speed[1] == 1.0  # half of all rows stand still, half move at 2 m/s: the median is between
    assert figures.present == (2, 2, 2)
    assert figures.spacing is not None
    assert figures.spacing[0] == pytest.approx(np.hypot(1, 3))  # at x = 4 and 6
    assert figures.largest == 88
    assert [(o.id, o.time, o.what, o.value) for o in figures.outliers] == [
        ("0", 20.0, "speed [m/s]", 32.0),
        ("0", 20.0, "acceleration [m/s^2]", 30.0),
        ("0", 21.0, "acceleration [m/s^2]", 30.0),
    ]
    assert figures.outlying == 3


def test_accelerations_are_of_one_person_without_a_gap():
    """One leaves at 1 m/s when another enters at 5 m/s, and goes on at 3 m/s after a gap: nobody ever accelerates."""
    time, x = [0, 1, 2, 6, 7, 8, 2, 3, 4], [0, 1, 2, 0, 3, 6, 0, 5, 10]
    samples = sampled(track(time, x, id=[0] * 6 + [1] * 3), 1.0, ImportConfig(gap="split"))
    assert samples.row.tolist() == [1, 2, 7, 8, 3, 4]
    assert survey([samples], 1.0, PLAIN).acceleration == (0, 0, 0)


def test_import_writes_a_card_and_keeps_what_is_there(tmp_path: Path, capsys, monkeypatch):
    path = juelich(tmp_path / "walk.txt", np.vstack([WALK, np.add(WALK, [7, 3, 0, 0])]))
    out = tmp_path / "walk.h5"
    arguments = (
        "import",
        str(path),
        "--holdout",
        "0.5",
        "--segment",
        "0.6",
        "--licence",
        "CC-BY-4.0",
        "--source",
        "me",
    )
    arguments += ("--out", str(out))
    monkeypatch.setattr("sys.argv", ["swarmnet", *arguments])
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    for words in (
        "median speed",
        "m/s",
        "km/h",
        "nearest other",
        "5 fps (header)",
        "cm (header)",
        "0.2 s apart",
        "card:",
    ):
        assert words in printed
    names = {"walk.txt", "walk.h5", "walk_holdout.h5", "walk.card.md", "walk_holdout.card.md"}
    assert {p.name for p in tmp_path.iterdir()} == names
    card = card_path(out).read_text()
    for words in (
        "CC-BY-4.0",
        "Source: me",
        "swarmnet import",
        "walk.txt",
        "Training part: 1 runs, 3 agents",
        "median",
    ):
        assert words in card
    about = read_header(out).provenance["import"]
    assert about["agents"] == 6
    assert about["figures"]["present"][2] == 3
    assert read_header(holdout_path(out)).provenance["import"]["part_agents"] == 3
    written = out.read_bytes()
    assert main(arguments) == 0
    assert "was there already" in capsys.readouterr().out
    assert out.read_bytes() == written
    card_path(out).unlink()
    assert main(arguments) == 0
    assert card_path(out).read_text() == card, "a card that was deleted is written again"
    assert main((*arguments, "--radius", "0.2")) == 2
    assert "exists and holds something else" in capsys.readouterr().err
    monkeypatch.setattr("envs.importers.importing.VERSION", VERSION + 1)
    assert main(arguments) == 2
    assert "by an older version, which made other rows of them; delete it, or" in capsys.readouterr().err
    assert out.read_bytes() == written


def test_many_files_outliers_and_gaps_fit_into_the_header(tmp_path: Path):
    rng = np.random.default_rng(0)
    paths = []
    for number in range(55):
        rows = [(f, i, *rng.normal(0, 1e3, 2)) for i in range(4) for f in range(12) if f % 4]
        paths.append(csv(tmp_path / f"a_rather_long_name_of_a_file_{number}.csv", np.asarray(rows)))
    import_files(paths, replace(METRES, gap="split", outlier_speed=1.0), tmp_path / "out.h5")
    about = read_header(tmp_path / "out.h5").provenance["import"]
    assert about["number_of_files"] == 55
    assert len(about["files"]) == len(about["gaps"]["listed"]) == len(about["outliers"]["listed"]) == 50
    assert about["gaps"]["count"] == 55 * 4 * 2
    assert "file_54.csv" in card_path(tmp_path / "out.h5").read_text()


def test_who_is_left_out_is_said(tmp_path: Path, capsys):
    """Steps of 0.4 s: a.csv has id 1 for 7 rows and 2 for 2; b.csv has three ids of 2 rows, of which none is left."""
    short = np.asarray([(f, i, f, 0) for i in range(3) for f in range(2)])
    first = csv(tmp_path / "a.csv", np.vstack([WALK[:7], WALK[7:9]]))
    second = csv(tmp_path / "b.csv", short)
    out = tmp_path / "out.h5"
    declared = ("--unit", "m", "--time-unit", "s", "--dt", "0.4", "--out", str(out))
    assert main(("import", str(first), str(second), *declared)) == 0
    words = "left out: 4 of 5 ids, with too few rows for steps of 0.4 s; 1 of 2 runs, with no agent left (b.csv)\n"
    assert words in capsys.readouterr().out
    card = card_path(out).read_text()
    assert words in card
    assert "## Runs left out: 1 of 1\n\n- b.csv\n" in card
    about = read_header(out).provenance["import"]
    assert about["left_out"] == {"ids": 4, "of_ids": 5, "runs": 1, "of_runs": 2, "listed": ["b.csv"]}


def test_rows_of_segments_that_are_cut_away_are_counted(tmp_path: Path, capsys):
    """The 6 rows with velocities in segments of 5: the last is alone in the second."""
    path, out = csv(tmp_path / "w.csv", WALK[:7]), tmp_path / "out.h5"
    declared = ("--unit", "m", "--time-unit", "s", "--out", str(out))
    assert main(("import", str(path), "--segment", "1.0", *declared)) == 0
    words = "left out: 1 of 6 rows of agents, in segments that have agents in one row only (everything)\n"
    assert words in capsys.readouterr().out
    assert load(out).mask.sum() == 5
    out.unlink()
    assert main(("import", str(path), *declared)) == 0
    assert "eft out" not in capsys.readouterr().out + card_path(out).read_text()


def test_coordinates_too_large_for_single_precision_ask_for_an_origin(tmp_path: Path):
    path = csv(tmp_path / "w.csv", np.add(WALK[:7], [0, 0, 5e6, 4e6]))
    with pytest.raises(ImportFailed, match=r"coordinates reach 5e\+06 m.*--origin X Y"):
        trajectories(path, METRES)
    t = trajectories(path, replace(METRES, origin=(5e6, 4e6)))
    np.testing.assert_allclose(t.velocity[0, :, 0], [[1, 0]] * 6, atol=1e-4)


def test_nothing_is_left_of_an_import_that_fails_while_it_writes(tmp_path: Path):
    path = csv(tmp_path / "w.csv")
    (tmp_path / "out_holdout.h5").mkdir()
    with pytest.raises(TrajectoryError):
        import_files([path], replace(METRES, holdout=0.3, holdout_by="time", segment=0.4), tmp_path / "out.h5")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out_holdout.h5", "w.csv"]


def test_an_imported_recording_can_be_trained_on(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    rows = [(f, i, 0.1 * f + i, rng.normal(0, 0.02)) for i in range(6) for f in range(5 * i, 5 * i + 30)]
    csv(tmp_path / "w.csv", np.asarray(rows))
    assert main(("import", "w.csv", "--unit", "m", "--time-unit", "s", "--segment", "2", "--out", "w.h5")) == 0
    train = (
        "train",
        "w.h5",
        "--run",
        "r",
        "--model",
        "thesis-ch5",
        "--horizons",
        "1",
        "--stage-steps",
        "2",
        "--chunk",
        "2",
        "--batch",
        "4",
    )
    with quick_training():
        assert main((*train, "--validation", "0.2")) == 0
    assert "trained for 2 steps" in capsys.readouterr().out


def test_the_page_about_data_tells_commands_that_parse_and_code_that_runs(tmp_path: Path, monkeypatch, capsys):
    page = (Path(__file__).parent.parent / "docs" / "data.md").read_text()
    commands = re.findall(r"(?:`|^    )swarmnet ((?:import|export|train|evaluate|learn) [^`\n]+)", page, re.MULTILINE)
    assert len(commands) >= 15
    for command in commands:
        parse(shlex.split(command))
    monkeypatch.chdir(tmp_path)
    csv(tmp_path / "walk.csv", WALK / [2, 1, 1, 1])  # 0.1 s apart
    (block,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(compile(block, "docs/data.md", "exec"), {})
    assert "('1', '2', '3')" in capsys.readouterr().out
