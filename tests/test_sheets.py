"""Sheets show the very numbers of the recordings, at one scale, in a size and with fonts that journals take."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from PIL import Image
from test_figures import scenes

from envs.storage import save
from swarm_mjcf.build import agent_color
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.cli import main
from swarmnet.film import Panel
from swarmnet.sheets import WIDTHS, sheet, write_sheet


def one(scene: int = 1, **changes) -> Panel:
    """A scene of the made-up recordings; scene 1 has a contact at row 3, its event too."""
    data = scenes()
    data.solid_events[1, 3, 2] = 1
    return Panel(data.take([scene]), f"scene {scene}", **changes)


def artist(axes, name: str):
    (found,) = [child for child in axes.get_children() if child.get_gid() == name]
    return found


def points(axes, name: str) -> np.ndarray:
    """x and y of a line, (P, 2)."""
    return np.stack(artist(axes, name).get_data(), axis=-1)


def test_paths_bodies_and_contacts_lie_where_they_were() -> None:
    panel = one()
    (axes,) = sheet([panel], columns=1).axes
    place = panel.recording.position[0]
    paths = artist(axes, "paths")
    assert isinstance(paths, LineCollection)
    # Agent 0 has 5 steps; agent 1 is absent in the last two of 6 rows, so it has 3. By row, then by agent.
    steps = [(t, i) for t in range(5) for i in range(2) if i == 0 or t < 3]
    np.testing.assert_array_equal(paths.get_segments(), [place[[t, t + 1], 2 + i] for t, i in steps])
    np.testing.assert_allclose(paths.get_colors()[:, :3], [agent_color(i) for _, i in steps])
    for agent, last in ((0, 5), (1, 3)):
        np.testing.assert_array_equal(points(axes, f"start {agent}"), place[:1, 2 + agent])
        np.testing.assert_array_equal(points(axes, f"end {agent}"), place[[last], 2 + agent])
    np.testing.assert_array_equal(points(axes, "contacts"), [[12, 0]])
    np.testing.assert_array_equal(points(axes, "goal"), [[30, 0]])
    (disc,) = artist(axes, "obstacle 1").get_paths()
    assert disc.get_extents().bounds == pytest.approx((6, 8, 8, 8))  # radius 4 around (10, 12)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [m]", "y [m]")
    assert axes.get_aspect() == 1
    low, high = axes.get_xlim()
    assert low < 0 < 30 < high


def test_colours_of_time_go_from_start_to_end() -> None:
    figure = sheet([one()], columns=1, color="time")
    axes, bar = figure.axes
    shade = artist(axes, "paths").get_array()
    np.testing.assert_allclose(shade, 0.5 * (np.array([0, 0, 1, 1, 2, 2, 3, 4]) + 0.5))
    assert bar.get_ylabel() == "time [s]"
    assert bar.get_ylim() == (0, 2.5)
    assert to_rgb(artist(axes, "end 0").get_color()) != to_rgb(artist(axes, "end 1").get_color())  # it left earlier


def test_panels_have_one_scale_and_labels_where_they_belong() -> None:
    small, large = one(0), one(1)
    large.recording.position[:] *= 3
    figure = sheet([small, large, small], columns=2, width="page")
    widths = [np.ptp(axes.get_xlim()) for axes in figure.axes[:3]]
    assert widths == pytest.approx([widths[0]] * 3)
    assert [bool(axes.get_xlabel()) for axes in figure.axes[:3]] == [False, True, True]  # lowest of its column
    assert [bool(axes.get_ylabel()) for axes in figure.axes[:3]] == [True, False, True]
    assert [axes.get_title() for axes in figure.axes[:3]] == ["scene 0", "scene 1", "scene 0"]


def test_a_shift_of_everything_shifts_the_sheet() -> None:
    here, there = one(), one()
    there.recording.position[:] += np.array([7, -3])
    one_axes, other_axes = sheet([here], columns=1).axes[0], sheet([there], columns=1).axes[0]
    np.testing.assert_allclose(np.array(other_axes.get_xlim()) - one_axes.get_xlim(), 7, atol=1e-5)
    np.testing.assert_allclose(np.array(other_axes.get_ylim()) - one_axes.get_ylim(), -3, atol=1e-5)


def test_moving_obstacles_show_their_way() -> None:
    panel = one()
    panel.recording.position[0, :, 1] += np.arange(6)[:, None] * np.array([2, 0])
    (axes,) = sheet([panel], columns=1).axes
    np.testing.assert_array_equal(points(axes, "obstacle path 1"), [[10 + 2 * t, 12] for t in range(6)])
    (disc,) = artist(axes, "obstacle 1").get_paths()
    assert disc.get_extents().bounds == pytest.approx((16, 8, 8, 8))  # where it ends
    still = sheet([one()], columns=1).axes[0]
    assert not [child for child in still.get_children() if child.get_gid() == "obstacle path 1"]


def test_a_reference_is_dashed_and_named() -> None:
    other = one()
    other.recording.position[0, :, 2, 1] += 1
    panel = one(reference=other.recording, reference_title="expert")
    figure = sheet([panel], columns=1)
    dashed = points(figure.axes[0], "dashed 2")
    np.testing.assert_array_equal(dashed, other.recording.position[0, :, 2])
    assert "expert" in [text.get_text() for text in figure.legends[0].get_texts()]


def legend(*panels: Panel, **options) -> list[str]:
    return [text.get_text() for text in sheet(list(panels), columns=1, **options).legends[0].get_texts()]


def test_the_legend_names_what_there_is() -> None:
    assert legend(one()) == ["start", "end", "goal", "obstacle", "contact"]
    assert legend(one(), contacts=False) == ["start", "end", "goal", "obstacle"]
    assert legend(one(0)) == ["start", "end", "goal", "obstacle"]
    bare = one(0)
    bare.recording.mask[:, :, :2] = False
    assert legend(bare) == ["start", "end"]


def test_nobody_and_a_crowd_are_drawn(tmp_path) -> None:
    empty = one(0)
    empty.recording.mask[:] = False
    write_sheet(tmp_path / "empty.png", sheet([empty], columns=1))
    data = scenes(count=1)
    many = {
        name: np.repeat(getattr(data, name), 50, axis=2)
        for name in (
            "position", "velocity", "mask", "agent_contact", "solid_contact", "agent_events", "solid_events", "depth"
        )
    }  # fmt: skip
    crowd = replace(
        data,
        **many,
        kind=np.repeat(data.kind, 50, axis=1),
        radius=np.repeat(data.radius, 50, axis=1),
        edges=np.zeros((1, 200, 200), data.edges.dtype),
    )
    (axes,) = sheet([Panel(crowd, "crowd")], columns=1).axes
    assert len(artist(axes, "paths").get_segments()) == 50 * 5 + 50 * 3
    assert len({line.get_gid() for line in axes.lines if line.get_gid().startswith("end")}) == 100


@pytest.mark.parametrize("width", WIDTHS)
def test_files_have_the_width_of_a_column_and_embedded_fonts(tmp_path, width) -> None:
    figure, same = (sheet([one(), one()], columns=2, width=width) for _ in range(2))
    png = write_sheet(tmp_path / "a.png", figure)
    with Image.open(png) as image:
        assert image.size[0] == pytest.approx(300 * WIDTHS[width], abs=1)
    pdf = write_sheet(tmp_path / "a.pdf", sheet([one(), one()], columns=2, width=width)).read_bytes()
    box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+)", pdf)
    assert box is not None
    assert float(box[1]) == pytest.approx(72 * WIDTHS[width], abs=0.01)
    assert b"/Type /Font /Subtype /Type0" in pdf or b"/FontFile2" in pdf  # TrueType
    assert b"/Subtype /Type3" not in pdf
    assert write_sheet(tmp_path / "b.pdf", same).read_bytes() == pdf  # no dates


def test_everything_lies_within_the_sheet() -> None:
    """Titles, labels and legend are neither cut nor on top of each other."""
    figure = sheet([one(0), one(1), one(0)], columns=2, color="time")
    figure.canvas.draw()
    width, height = figure.canvas.get_width_height()
    boxes = [axes.get_tightbbox() for axes in figure.axes if axes.get_visible() and axes.axison]
    boxes.append(figure.legends[0].get_window_extent())
    for box in boxes:
        assert box.x0 >= -1
        assert box.y0 >= -1
        assert box.x1 <= width + 1
        assert box.y1 <= height + 1
    for k, box in enumerate(boxes):
        assert not any(box.padded(-1).overlaps(other) for other in boxes[:k]), k


def test_bad_values_are_named_and_leave_no_file(tmp_path) -> None:
    for options, field in (({"width": "wide"}, "width"), ({"color": "speed"}, "color"), ({"columns": 0}, "panels")):
        with pytest.raises(SpecError, match=field):
            sheet([one()], **{"columns": 1, **options})
    with pytest.raises(SpecError, match="panels"):
        sheet([], columns=1)
    figure = sheet([one()], columns=1)
    with pytest.raises(SpecError, match="path"):
        write_sheet(tmp_path / "a.bmp", figure)
    (tmp_path / "file").write_text("")
    with pytest.raises(SwarmError, match="cannot write"):
        write_sheet(tmp_path / "file" / "a.pdf", figure)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("ending", ["pdf", "png", "svg"])
def test_the_command_writes_a_sheet(tmp_path, capsys, ending) -> None:
    save(tmp_path / "a.h5", scenes())
    out = tmp_path / f"a.{ending}"
    assert main(["render", str(tmp_path / "a.h5"), "--grid", "1x2", "--color", "time", "--out", str(out)]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    start = out.read_bytes()[:60]
    assert {"pdf": b"%PDF", "png": b"\x89PNG", "svg": b"<?xml"}[ending] in start
