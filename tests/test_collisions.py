"""The collision report against figures computed by hand, and its intervals."""

import math
from dataclasses import replace

import numpy as np
import pytest
from helpers import make_trajectories
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.collisions import NEAR_GOAL, Estimate, collision_report, worst_scenes
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories, edge_types


def still_life(scenes: int = 2, rows: int = 5, agents: int = 2, **changes: np.ndarray) -> Trajectories:
    """A goal at 0, an obstacle of radius 7 at (0, 60), agents of radius 1 at (40, 0), (40, 10), ..., all apart."""
    nodes = 2 + agents
    kind = np.tile(np.array([GOAL, OBSTACLE] + [AGENT] * agents, np.int8), (scenes, 1))
    position = np.zeros((scenes, rows, nodes, 2), np.float32)
    position[:, :, 1] = 0, 60
    for i in range(agents):
        position[:, :, 2 + i] = 40, 10 * i
    mask = np.ones((scenes, rows, nodes), bool)
    counts = {name: np.zeros((scenes, rows, nodes), np.int16) for name in CONTACT_FIELDS}
    fields = {
        "position": position,
        "velocity": np.zeros_like(position),
        "mask": mask,
        "kind": kind,
        "radius": np.tile(np.array([0, 7] + [1] * agents, np.float32), (scenes, 1)),
        "edges": edge_types(kind, mask[:, 0]),
        "depth": np.zeros(mask.shape, np.float32),
    }
    return Trajectories(
        **(fields | counts | changes), dt=0.5, substeps=15, max_speed=10.0, max_acceleration=5.0, provenance={}
    )


CONTACT_FIELDS = ("agent_contact", "solid_contact", "agent_events", "solid_events")


def contacts(**entries: list[tuple[int, int, int, int]]) -> dict[str, np.ndarray]:
    """Contact fields of `still_life` from (scene, row, node, count) entries."""
    fields = {}
    for name, places in entries.items():
        fields[name] = np.zeros((2, 5, 4), np.int16)
        for scene, row, node, count in places:
            fields[name][scene, row, node] = count
    return fields


def values(trajectories: Trajectories, **options) -> dict[str, float]:
    return {name: estimate.value for name, estimate in collision_report(trajectories, **options).items()}


def test_a_world_in_which_nothing_touches():
    report = values(still_life())
    for name, value in report.items():
        if "contact" in name or "touching" in name or "events" in name:
            assert value == 0 or (name == "agent_contact_steps_near_goal" and math.isnan(value)), name
    assert report["deepest_penetration"] == 0
    assert report["minimum_clearance"] == 10 - 2  # (40, 0) to (40, 10), radii 1; the obstacle is further
    assert report["final_goal_distance"] == pytest.approx((40 + math.hypot(40, 10)) / 2)
    assert report["reached_goal"] == 0
    assert math.isnan(report["time_to_goal"])  # no agent got there


def test_contacts_are_counted_by_hand():
    """2 scenes, 4 steps, 2 agents. The agents meet in step 1 and part after 2; agent 3 hits the obstacle in 2 and 4."""
    t = still_life(
        **contacts(
            agent_contact=[(0, 1, 2, 5), (0, 1, 3, 5), (0, 2, 2, 15), (0, 2, 3, 15)],
            agent_events=[(0, 1, 2, 1), (0, 1, 3, 1)],
            solid_contact=[(0, 2, 3, 1), (0, 4, 3, 2)],
            solid_events=[(0, 2, 3, 1), (0, 4, 3, 2)],
        )
    )
    report = values(t)
    assert report["contact_steps_any"] == 3 / 8  # steps 1, 2 and 4 of 8 scene-steps
    assert report["contact_steps_agent"] == 2 / 8
    assert report["contact_steps_obstacle"] == 2 / 8
    assert report["agent_contact_steps_any"] == 5 / 16  # both in steps 1 and 2, one in step 4
    assert report["ever_touching_trajectories_any"] == 1 / 2
    assert report["ever_touching_trajectories_agent"] == 1 / 2
    assert report["ever_touching_trajectories_obstacle"] == 1 / 2
    assert report["ever_touching_agents_any"] == 2 / 4
    assert report["events_per_trajectory_agent"] == 2 / 2  # two agents that meet are two events
    assert report["events_per_trajectory_obstacle"] == 3 / 2


def test_contacts_before_the_first_step_do_not_count():
    report = values(still_life(**contacts(agent_contact=[(0, 0, 2, 9)], agent_events=[(0, 0, 2, 9)])))
    assert report["contact_steps_any"] == 0
    assert report["events_per_trajectory_agent"] == 0


def test_contacts_en_route_and_near_the_goal_are_told_apart():
    t = still_life(**contacts(agent_contact=[(0, 1, 2, 1), (0, 4, 2, 1), (0, 4, 3, 1)]))
    t.position[0, 3:, 2] = 0, 14.9  # agent 2 is near the goal in steps 3 and 4 of scene 0
    report = values(t)
    assert report["agent_contact_steps_near_goal"] == 1 / 2
    assert report["agent_contact_steps_en_route"] == 2 / 14
    wide = values(t, reach=100.0)
    assert wide["agent_contact_steps_near_goal"] == 3 / 16
    assert math.isnan(wide["agent_contact_steps_en_route"])
    assert NEAR_GOAL == 15.0


def test_goal_distance_and_time_to_goal_by_hand():
    t = still_life()
    t.position[0, 2:, 2] = 3, 4  # agent 2 of scene 0 arrives at row 2: 1 s
    t.position[1, :, 3] = 0, 15  # agent 3 of scene 1 is there from the start: 0 s, and exactly at the border
    report = values(t)
    assert report["time_to_goal"] == pytest.approx((1.0 + 0.0) / 2)
    assert report["reached_goal"] == 2 / 4
    assert report["final_goal_distance"] == pytest.approx((5 + math.hypot(40, 10) + 40 + 15) / 4)


def test_deepest_penetration_and_clearance():
    t = still_life()
    t.position[1, 3, 3] = 0, 51.5  # 8.5 m from the obstacle's centre: 0.5 m between the surfaces
    assert values(t)["minimum_clearance"] == pytest.approx(0.5)
    t.depth[1, 2, 3], t.depth[0, 4, 2] = 0.25, 0.125
    report = values(t)
    assert report["deepest_penetration"] == 0.25
    assert report["minimum_clearance"] == -0.25  # between two control steps, where only physics looked


def test_absent_agents_count_nowhere():
    mask = np.ones((2, 5, 4), bool)
    mask[:, :, 3] = False
    t = still_life(mask=mask, **contacts(agent_contact=[(0, 1, 3, 7)], agent_events=[(0, 1, 3, 7)]))
    t.depth[:, :, 3] = 9
    t.position[:, :, 3] = 40, 0.5  # inside agent 2, were it there
    report = values(t)
    assert report["contact_steps_any"] == 0
    assert report["events_per_trajectory_agent"] == 0
    assert report["deepest_penetration"] == 0
    assert report["final_goal_distance"] == 40
    assert report["minimum_clearance"] == pytest.approx(math.hypot(40, 60) - 8)


def test_agents_that_leave_are_counted_while_they_are_there():
    mask = np.ones((2, 5, 4), bool)
    mask[:, 3:, 3] = False  # agent 3 is there for 2 of 4 steps
    t = still_life(mask=mask, **contacts(agent_contact=[(0, 1, 3, 1), (1, 4, 3, 1)]))
    assert values(t)["agent_contact_steps_any"] == 1 / (2 * (4 + 2))


def test_scenes_and_rows_without_a_goal_count_for_no_goal_figure():
    """Scene 0 as by hand, scene 1 without its goal: the figures are those of scene 0."""
    t = still_life()
    alone, mask = collision_report(t.take([0])), t.mask.copy()
    mask[1, :, 0] = False
    both = collision_report(replace(t, mask=mask))
    for name in ("final_goal_distance", "reached_goal", "agent_contact_steps_en_route"):
        assert both[name].value == alone[name].value, name
    mask[0, -1, 0] = False
    assert math.isnan(collision_report(replace(t, mask=mask))["final_goal_distance"].value)


def test_a_world_without_a_goal_has_no_goal_figures():
    t = make_trajectories(goals=0, obstacles=0, agents=3)
    assert not {"final_goal_distance", "time_to_goal", "agent_contact_steps_near_goal"} & set(collision_report(t))


def touching_scenes(scenes: int, share: float, seed: int) -> Trajectories:
    t = still_life(scenes=scenes)
    t.agent_contact[:, 1:, 2:] = (np.random.default_rng(seed).random((scenes, 1, 1)) < share) * 3
    return t


@settings(max_examples=20)
@given(st.integers(2, 60), st.floats(0.05, 0.95), st.integers(0, 1000))
def test_an_interval_holds_its_value_and_lies_between_the_extremes(scenes: int, share: float, seed: int):
    report = collision_report(touching_scenes(scenes, share, seed), seed=seed)
    for name, estimate in report.items():
        if estimate.low is not None and estimate.high is not None:
            assert estimate.low <= estimate.value + 1e-12, name
            assert estimate.value <= estimate.high + 1e-12, name
    touching = report["ever_touching_trajectories_any"]
    assert touching.low is not None
    assert touching.high is not None
    assert 0 <= touching.low <= touching.high <= 1


def test_an_interval_shrinks_with_the_square_root_of_the_scenes_and_depends_on_its_seed_alone():
    widths = []
    for scenes in (50, 5000):
        t = touching_scenes(scenes, 0.3, seed=1)
        estimate = collision_report(t)["ever_touching_trajectories_any"]
        assert collision_report(t)["ever_touching_trajectories_any"] == estimate
        widths.append(estimate.high - estimate.low)
        # The normal approximation of a share: +- 1.96 sqrt(p (1 - p) / n).
        p = estimate.value
        assert widths[-1] == pytest.approx(2 * 1.96 * math.sqrt(p * (1 - p) / scenes), rel=0.25)
    assert widths[1] < widths[0] / 5


def test_one_scene_has_an_interval_of_no_width():
    estimate = collision_report(touching_scenes(1, 1.0, 0))["contact_steps_any"]
    assert (estimate.value, estimate.low, estimate.high) == (1, 1, 1)


def test_figures_are_printed_with_interval_and_unit():
    assert str(Estimate(0.125, 0.1, 0.15, "share")) == "12.5 [10, 15] %"
    assert str(Estimate(0.25, None, None, "m")) == "0.25 m"
    assert str(Estimate(2.0, 1.0, 3.0, "")) == "2 [1, 3]"


def test_worst_scenes_by_contact_steps_then_depth_then_clearance():
    t = still_life(scenes=5)
    t.agent_contact[3, 1:3, 2] = 4  # two steps
    t.solid_contact[1, 2, 3] = 9  # one step, at 9 states
    t.agent_contact[2, 4, 2:] = 1  # one step of two agents, deeper
    t.depth[2, 4, 2] = 0.3
    t.depth[1, 2, 3] = 0.2
    t.position[4, 2, 3] = 40, 5  # near misses count last
    t.agent_contact[0, 0, 2] = 9  # not a step
    worst = worst_scenes(t, 4)
    assert [w.scene for w in worst] == [3, 2, 1, 4]
    assert [w.contact_steps for w in worst] == [2, 1, 1, 0]
    assert [w.deepest_penetration for w in worst] == pytest.approx([0, 0.3, 0.2, 0])
    assert worst[-1].minimum_clearance == 5 - 2
    assert [w.scene for w in worst_scenes(t, 99)] == [3, 2, 1, 4, 0]


def test_a_scene_of_absent_agents_is_the_least_bad():
    mask = np.ones((2, 5, 4), bool)
    mask[0, :, 2:] = False
    t = still_life(mask=mask, **contacts(agent_contact=[(0, 1, 3, 7)]))
    worst = worst_scenes(t, 2)
    assert [w.scene for w in worst] == [1, 0]
    assert worst[1].minimum_clearance == math.inf
    assert worst[1].contact_steps == 0
