"""Which panels a choice of files, scenes and grid gives, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from test_figures import scenes

from envs.storage import save
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.selection import read_scenes, select


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Recordings of the same two scenes, others that do not match, and a file of 12 scenes that all differ."""
    folder = tmp_path_factory.mktemp("recordings")
    expert = replace(scenes(), provenance={"expert": "boids"})
    for name, what in {
        "expert": expert,
        "learned": replace(scenes(), provenance={"policy": "best", "expert": "boids"}),
        "again": expert,
        "moved": scenes(shift=2.0),
        "slower": replace(scenes(), dt=0.25),
        "shorter": scenes(rows=4),
        "fewer": scenes(count=1),
        "nameless": replace(scenes(), provenance={}),
    }.items():
        save(folder / f"{name}.h5", what)
    many = scenes(count=12)
    many.position[:, :, 0, 0] = np.arange(12)[:, None]
    save(folder / "many.h5", many)
    return folder


def goals(selection) -> list[float]:
    """Where the goals lie, which tells scenes of many.h5 apart."""
    return [float(panel.recording.position[0, 0, 0, 0]) for panel in selection.panels]


@pytest.mark.parametrize(
    ("options", "shown", "columns"),
    [
        ({}, [0], 1),
        ({"scenes": [7]}, [7], 1),
        ({"scenes": [7, 2, 7]}, [7, 2, 7], 3),
        ({"scenes": range(8)}, list(range(8)), 3),
        ({"scenes": [3], "grid": "2x4"}, [3, 4, 5, 6, 7, 8, 9, 10], 4),
        ({"scenes": [9, 1, 4], "grid": "2x2"}, [9, 1, 4], 2),
        ({"grid": "12x1"}, list(range(12)), 1),
    ],
)
def test_scenes_of_one_file(folder, options, shown, columns) -> None:
    chosen = select([folder / "many.h5"], **options)
    assert goals(chosen) == shown
    assert chosen.columns == columns
    assert not chosen.compared
    assert all(panel.reference is None for panel in chosen.panels)
    assert [panel.title.split(" · ")[-1] for panel in chosen.panels] == [f"scene {scene}" for scene in shown]


@pytest.mark.parametrize(("count", "columns"), [(2, 2), (3, 3), (4, 2)])
def test_one_scene_of_several_files(folder, count, columns) -> None:
    files = [folder / f"{name}.h5" for name in ("expert", "learned", "again", "nameless")][:count]
    chosen = select(files, scenes=[1])
    names = ["boids (expert)", "best", "boids (again)", "nameless"] if count > 2 else ["boids", "best"]
    assert [panel.title for panel in chosen.panels] == [f"{name} · scene 1" for name in names[:count]]
    assert chosen.columns == columns
    assert chosen.compared
    first = chosen.panels[0]
    assert first.reference is None
    for panel in chosen.panels[1:]:
        assert panel.reference is first.recording
        assert panel.reference_title == names[0]
    titled = select(files, titles=[f"policy {k}" for k in range(count)])
    assert [panel.title for panel in titled.panels] == [f"policy {k} · scene 0" for k in range(count)]
    assert select(files, grid=f"{count}x1").columns == 1


def test_scenes_are_read_across_slabs(tmp_path) -> None:
    """Files are read slab by slab of 256 scenes."""
    many = scenes(count=520)
    many.position[:, :, 0, 0] = np.arange(520)[:, None]
    save(tmp_path / "many.h5", many)
    found = read_scenes(tmp_path / "many.h5", [519, 255, 256, 0])
    assert [float(one.position[0, 0, 0, 0]) for one in found] == [519, 255, 256, 0]
    assert all(len(one) == 1 for one in found)


@pytest.mark.parametrize(
    ("files", "options", "said"),
    [
        ([], {}, "data: '0 files' was given, allowed is 1 to 4"),
        (["many"] * 5, {}, "data: '5 files' was given"),
        (["many"], {"scenes": [12]}, r"scene: 12 was given, allowed is what .*many.h5 holds: 12 scenes, 0 to 11"),
        (["fewer"], {"scenes": [1]}, "only scene 0"),
        (["many"], {"scenes": [-1]}, "scene: -1"),
        (["many"], {"scenes": []}, "scene"),
        (["many"], {"grid": "4x4"}, "grid: '4x4' was given, allowed is at most 12 panels"),
        (["many"], {"grid": "3x3", "scenes": [4]}, "at most 8 panels"),
        (["many"], {"grid": "1x2", "scenes": [4, 5, 6]}, "room for 3 panels"),
        (["many"], {"grid": "3by3"}, "ROWSxCOLUMNS"),
        (["many"], {"grid": "0x3"}, "ROWSxCOLUMNS"),
        (["many"], {"titles": ["a", "b"]}, "titles.*one for each of 1 files"),
        (["expert", "learned"], {"grid": "1x1"}, "room for 2 panels"),
        (["expert", "learned"], {"scenes": [0, 1]}, "one scene when several files"),
    ],
)
def test_values_out_of_range_are_named(folder, files, options, said) -> None:
    with pytest.raises(SpecError, match=said):
        select([folder / f"{name}.h5" for name in files], **options)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("moved", "scene 0 has other starts"),
        ("slower", r"dt 0\.5 s in one and 0\.25 s"),
        ("shorter", "6 rows in one and 4 in the other"),
        ("fewer", "2 scenes in one and 1 in the other"),
    ],
)
def test_files_that_do_not_match_are_named(folder, name, said) -> None:
    with pytest.raises(SwarmError, match=rf"expert.h5 and .*{name}.h5 do not hold the same scenes.*{said}"):
        select([folder / "expert.h5", folder / f"{name}.h5"])
