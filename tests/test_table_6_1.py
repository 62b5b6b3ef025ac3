"""Table 6.1 without a training: how contacts are counted and compared, its references, its cells, its pictures."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from learning import INTEGRATOR, quick_compiles, spring, tiny

from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.decode import Integrator
from gnn.features import Scales
from gnn.graph import Graph
from repair import once
from repair.constraints.diamond import Diamond
from repair.errors import RepairError
from repair.network import Situations
from repair.screen import Acted
from swarmnet.figures import MODEL
from swarmnet.figures_repair import FLOOR, make_repair_figures, pareto, repair_rounds
from swarmnet.reproduce import table_6_1 as table
from swarmnet.reproduce.experiment import Cell, find
from swarmnet.reproduce.table_6_1 import TABLE_6_1, beside, draw_6_1, many, outcome, squared, thesis_figures


@pytest.fixture(autouse=True, scope="module")
def _quickly():
    with quick_compiles():
        yield


def made_up() -> Acted:
    """2 scenes of 4 control steps with a goal at (10, 0), an obstacle and 2 agents.

    Scene 0: agents touch each other in steps 0 and 1, agent 1 the obstacle in steps 1 and 2. Scene 1: nothing. At the
    end agents are 3 and 4 m (scene 0), 0 and 5 m (scene 1) from the goal.
    """
    nodes = np.zeros((2, 5, 4, 4))
    nodes[:, :, 0, 0] = 10.0
    nodes[0, -1, 2:, :2] = [[7.0, 0.0], [10.0, 4.0]]
    nodes[1, -1, 2:, :2] = [[10.0, 0.0], [13.0, -4.0]]
    agent, obstacle = np.zeros((2, 4, 2), bool), np.zeros((2, 4, 2), bool)
    agent[0, :2] = True
    obstacle[0, 1:3, 1] = True
    present = np.ones((2, 4), bool)
    graph = Graph(
        goal=np.ones((2, 2, 1), bool),
        obstacle=np.ones((2, 2, 1), bool),
        agent=np.tile(~np.eye(2, dtype=bool), (2, 1, 1)),
        present=present,
    )
    return Acted(nodes=nodes, graph=graph, touching_agent=agent, touching_obstacle=obstacle)


def test_contacts_by_hand():
    found = outcome(made_up())
    assert found[table.TOUCHING] == pytest.approx(100 * 3 / 8)
    assert found[table.BETWEEN] == pytest.approx(100 * 2 / 8)
    assert found[table.SOLID] == pytest.approx(100 * 2 / 8)
    assert found[table.EVER] == 50
    assert found[table.DISTANCE] == pytest.approx((3 + 4 + 0 + 5) / 4)
    # Of two scenes, the bootstrap draws both of one kind a quarter of the time.
    _, low, high = (found[name] for name in table.interval(table.TOUCHING))
    assert (low, high) == (0, 75)
    assert thesis_figures(made_up()) == (25, 50)
    assert set(found) < set(table.MAIN)
    assert {*found, table.RATIO, table.AWAY} >= set(table.ELSEWHERE)


def test_contacts_of_many_trajectories_by_hand():
    """Scene 0 touches, and everybody begins on the same spot; in scene 1 they begin apart."""
    world = table.THESIS.world()
    acted = made_up()
    acted.nodes[1, 0, 1, 0], acted.nodes[1, 0, 3, 1] = 50.0, 9.0
    one = many(acted, world)
    names = (table.TOUCHED, table.LOST, table.AVOIDED)
    assert [one[f"{table.MANY}: {name}"] for name in names] == [1, 1, 0]
    assert one[f"{table.MANY}: {table.AT_MOST}"] == pytest.approx(95)  # 0 of 1
    acted.touching_agent[1, 3, 0] = True
    two = many(acted, world)
    assert [two[f"{table.MANY}: {name}"] for name in names] == [2, 1, 1]
    assert two[f"{table.MANY}: {table.AT_MOST}"] == 100
    assert set(two) == set(table.OF_MANY)
    acted.touching_agent[0], acted.touching_obstacle[0] = False, False
    with pytest.raises(RepairError, match="proven to be lost had no contact"):
        many(acted, world)


def test_ratios_to_the_imitation_policy():
    imitation = outcome(made_up())
    found = beside({table.TOUCHING: 3.0, table.DISTANCE: 6.0}, imitation)
    assert found == pytest.approx({table.RATIO: 3 / 37.5, table.AWAY: 2.0})
    few = {table.TOUCHING: 0.49, table.DISTANCE: 3.0}
    assert set(beside(imitation, few)) == {table.AWAY}  # no ratio to next to nothing


# --- errors ---


def knowing(truth: Trajectories, off: float = 0.0) -> Model:
    """A model that knows what comes, `off` metres aside in x."""
    whole = np.concatenate([truth.position, truth.velocity], axis=-1)

    class Knows(Model):
        def predict(self, params, history, graph, horizon):
            found = []
            for now in np.asarray(history)[:, -1]:
                scene, row = np.argwhere(np.abs(whole - now).max(axis=(2, 3)) < 1e-6)[0]
                found.append(whole[scene, row + 1 : row + 1 + horizon])
            return np.stack(found) + np.array([off, 0, 0, 0])

    return Knows(tiny("thesis-ch5"), Scales.ones(), INTEGRATOR, {}, {})


def test_who_knows_what_comes_makes_no_error():
    truth = spring(scenes=3, rows=24)
    assert squared(knowing(truth), truth) == 0
    assert squared(knowing(truth, off=0.5), truth) == pytest.approx(0.25, rel=1e-5)
    assert squared(knowing(truth, off=0.5), truth, horizon=3) == pytest.approx(0.25, rel=1e-5)


# --- the experiment ---


def test_references_are_the_thesis_own():
    """Of table 6.1: 25 of 1000 steps, 5 of 100 trajectories and so on, before and after."""
    columns = (
        "train steps [%]",
        "train trajs [%]",
        "train MSE [m^2]",
        "test steps [%]",
        "test trajs [%]",
        "test MSE [m^2]",
    )
    before = (100 * 25 / 1000, 100 * 5 / 100, 4.62, 100 * 51 / 2500, 100 * 13 / 250, 4.95)
    after = (100 * 6 / 1000, 100 * 2 / 100, 20.09, 100 * 25 / 2500, 100 * 7 / 250, 19.26)
    assert columns == table.THESIS_COLUMNS
    expected = {("imitation", c): x for c, x in zip(columns, before, strict=True)}
    expected |= {("thesis replica", c): x for c, x in zip(columns, after, strict=True)}
    assert TABLE_6_1.references == pytest.approx(expected)


def test_which_cells_there_are():
    assert find("table-6.1") is TABLE_6_1
    assert len(table.ROWS) == 11
    cells = TABLE_6_1.cells((0, 1, 2))
    certified = {"imitation", "counter-example loop"}
    everywhere = certified | {"expert", "loop in crowds", "filter", "repaired + filter"}
    for row in table.ROWS:
        for data in ("thesis", "certificate", "many trajectories", "10 agents", "20 agents", "3 obstacles"):
            seeds = {cell.seed for cell in cells if (cell.row, cell.data) == (row, data)}
            there = data == "thesis" or row in (certified if data == "certificate" else everywhere)
            there &= (row, data) != ("loop in crowds", "many trajectories")
            assert seeds == (({0} if row == "expert" else {0, 1, 2}) if there else set()), (row, data)
    assert (cells[0].row, cells[1].row) == ("imitation", "imitation")  # whom all others need comes first
    columns = [column for data in TABLE_6_1.data_sets for column in data.columns]
    assert len(columns) == len(set(columns))
    assert {column for _, column in TABLE_6_1.references} <= set(columns)


def test_what_no_weights_can_mend_is_left_out(monkeypatch):
    """An agent inside an obstacle is no row of a program; one that can still turn is."""
    motion = Integrator(dt=0.3, substeps=30, max_speed=10.0, max_acceleration=10.0)
    bodies = table.THESIS.world().scene
    reach = bodies.agent_radius + bodies.obstacle_radius
    own = np.array([[0.5, 0, 0, 0], [reach * 2**0.5 + 0.3, 0, -1.2, 0], [60, 0, 0, 0]], float)
    present = {name: np.ones((3, 1), bool) for name in ("goal", "obstacle")} | {"agent": np.zeros((3, 1), bool)}
    states = Situations(own=own, senders=dict.fromkeys(present, np.zeros((3, 1, 4))), present=present)
    model = Model(tiny("thesis-ch5"), Scales.ones(), motion, {}, {})
    monkeypatch.setattr(once, "actions", lambda params, scales, rows, **_: np.zeros((len(rows), 2)))
    kept = once.mendable(model, True, Diamond(kinematics=motion), states, bodies)
    np.testing.assert_array_equal(kept.own, own[1:])


# --- pictures ---

COSTS = (table.DEVIATION, table.AWAY)


def points() -> list[tuple[str, dict[str, float]]]:
    rng = np.random.default_rng(0)
    draw = lambda: {table.TOUCHING: float(rng.uniform(0, 3)), **{c: float(rng.uniform(0.9, 3)) for c in COSTS}}  # noqa: E731
    return [(row, draw()) for row in table.ROWS for _ in range(3)]


def drawn(figure) -> list[dict[str, int]]:
    """Points of each name in each panel."""
    return [
        {line.get_gid(): len(line.get_xdata()) for line in ax.lines if line.get_gid() in table.ROWS}
        for ax in figure.axes
    ]


def test_every_row_is_in_every_panel_that_it_has_a_cost_for():
    made = points()
    assert drawn(pareto(made, table.TOUCHING, COSTS)) == [dict.fromkeys(table.ROWS, 3)] * 2
    for number, (row, values) in enumerate(made):
        if row == "filter":
            del values[table.DEVIATION]
        if row == "expert":
            values[table.AWAY] = (np.nan, np.inf, 1.0)[number]
    left, right = drawn(pareto(made, table.TOUCHING, COSTS, note="words " * 60))
    assert "filter" not in left
    assert (left["expert"], right["expert"], right["filter"]) == (3, 1, 3)


def test_nothing_at_all_stands_at_the_floor():
    figure = pareto([("a", {"contacts": 0.0, "cost": 1.0})], "contacts", ("cost",))
    (line,) = figure.axes[0].lines
    assert list(line.get_ydata()) == [FLOOR]


def test_the_picture_of_the_table_takes_cells_of_its_own_scenes(tmp_path: Path):
    record = {"minutes": 5.0, "dt": 0.3, "seed": 0, "profile": "cpu", "demonstrations": 2000}
    done = [(Cell(row, "thesis", 0), record | {"values": values}) for row, values in points()]
    # The expert learns nothing, so its cells know no minutes; they come first.
    untrained = {name: value for name, value in record.items() if name != "minutes"}
    expert = untrained | {"values": {"contact steps [%]": 0.03, "goal distance / imitation": 0.96}}
    done.insert(0, (Cell("expert", "thesis", 0), expert))
    done += [(Cell("imitation", "10 agents", 0), record | {"values": {"10 agents: x": 1.0}})]
    files = draw_6_1(tmp_path, done)
    assert {path.name for path in files} == {"table-6.1.png", "table-6.1.pdf"}
    assert all(path.stat().st_size > 1000 for path in files)
    assert draw_6_1(tmp_path, done[-1:]) == []


@cache
def rounds() -> list[dict]:
    shares = zip((0.02, 0.004, 0.0, 0.0), (0.05, 0.01, 0.001, 0.0), strict=True)
    found = [
        {"round": k, "contact_steps": c, "avoidable": a, "goal_distance": 10 + k, "changed": 0.3 * k, "scenes": 64}
        for k, (c, a) in enumerate(shares)
    ]
    found[-1]["polished"] = True
    return found


def test_a_repair_round_by_round():
    (ax,) = repair_rounds(rounds()).axes
    touching, avoidable, _ = ax.lines
    np.testing.assert_allclose(touching.get_ydata(), [2, 0.4, FLOOR, FLOOR])
    np.testing.assert_allclose(avoidable.get_ydata(), [5, 1, 0.1, FLOOR])
    assert list(touching.get_xdata()) == [0, 1, 2, 3]
    assert touching.get_color() == MODEL
    assert [text.get_text() for text in ax.texts] == ["quadratic programs"]


@pytest.mark.parametrize("goal", [True, False])
def test_pictures_of_a_repair(goal: bool, tmp_path: Path):
    assert make_repair_figures(tmp_path) == []
    made = [{key: x for key, x in row.items() if goal or key != "goal_distance"} for row in rounds()]
    (tmp_path / "repair.json").write_text(json.dumps({"rounds": made}))
    files = make_repair_figures(tmp_path)
    assert [file.path.name for file in files] == ["repair_pareto.svg", "repair_rounds.svg"]
    text = files[0].path.read_text()
    assert "change of actions" in text
    assert ("distance to the goal" in text) == goal
    (tmp_path / "repair.json").write_text(json.dumps({"rounds": []}))
    assert make_repair_figures(tmp_path) == []
