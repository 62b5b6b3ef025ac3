"""A SceneSpec is either usable or refused with the field, what was given and what is allowed."""

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.spec import MAX_TIMESTEP, SceneSpec

ROOT = Path(__file__).parents[1]
COUNTS = {"num_agents": 1, "num_obstacles": 0, "substeps": 1, "solver_iterations": 1, "solver_ls_iterations": 1}
POSITIVE = ("agent_radius", "obstacle_radius", "agent_mass", "goal_radius", "arena", "dt", "solref_dampratio")
LIMITS = ("max_speed", "max_acceleration")


def refused(**fields: object) -> SpecError:
    with pytest.raises(SpecError) as caught:
        SceneSpec(**fields)  # pyright: ignore[reportArgumentType]
    return caught.value


@pytest.mark.parametrize(
    ("field", "value"),
    [(field, value) for field, low in COUNTS.items() for value in (low - 1, -7)]
    + [(field, value) for field in POSITIVE for value in (0.0, -1.0, math.nan, math.inf, -math.inf)]
    + [(field, value) for field in LIMITS for value in (0.0, -1.0, math.nan, -math.inf)]
    + [("solref_timeconst", value) for value in (1.99, 0.0, -2.0, math.nan, math.inf)]
    + [("agent_radius", 100.0), ("obstacle_radius", 100.0), ("obstacle_radius", 250.0)],
)
def test_a_bad_value_is_refused_with_field_given_and_allowed(field: str, value: object):
    error = refused(**{field: value})
    assert error.field == field
    assert error.given is value
    assert error.allowed
    assert field in str(error)
    assert repr(value) in str(error)
    assert error.allowed in str(error)
    assert isinstance(error, SwarmError)
    assert isinstance(error, ValueError)


def test_only_bodies_that_there_are_must_fit_into_the_arena():
    assert SceneSpec(num_obstacles=0, arena=5.0).obstacle_radius == 7.0
    assert refused(num_obstacles=1, arena=5.0).field == "obstacle_radius"
    assert refused(num_obstacles=0, arena=0.5).field == "agent_radius"


def test_a_value_of_a_wrong_type_is_refused_too():
    """In a process of its own: here the type checker of the tests would be faster."""
    switches = [field.name for field in dataclasses.fields(SceneSpec) if isinstance(field.default, bool)]
    fields = [field.name for field in dataclasses.fields(SceneSpec) if field.name not in switches]
    assert set(switches) == {"goal", "walls", "contacts", "moving_obstacles"}
    code = f"""
from swarm_mjcf.spec import SceneSpec, SpecError
for field in {fields}:
    for value in ("3", None, True, [1]) + ((2.5, 3.0, float("nan")) if field in {list(COUNTS)} else ()):
        try:
            SceneSpec(**{{field: value}})
        except SpecError as error:
            assert error.field == field and error.given is value and error.allowed, error
        else:
            print("accepted", field, value)
for field in {switches}:
    for value in ("yes", None, 1, 0.0):
        try:
            SceneSpec(**{{field: value}})
        except SpecError as error:
            assert error.field == field and error.given is value and error.allowed == "True or False", error
        else:
            print("accepted", field, value)
SceneSpec(agent_radius=1, dt=1, max_speed=5, substeps=50)  # whole numbers are numbers
"""
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


@given(st.sampled_from(sorted(COUNTS) + list(POSITIVE) + list(LIMITS)), st.floats(), st.integers(-5, 200))
def test_any_number_is_accepted_or_refused_by_its_own_name(field: str, real: float, whole: int):
    """Without contacts nothing but the field itself (and the arena, which bounds the radii) can be at fault."""
    value = whole if field in COUNTS else real
    try:
        spec = SceneSpec(**{"contacts": False, field: value})  # pyright: ignore[reportArgumentType]
    except SpecError as error:
        assert error.field in ({field} if field != "arena" else {"arena", "obstacle_radius", "agent_radius"})  # noqa: PT017
        return
    assert getattr(spec, field) == value
    assert value >= COUNTS[field] if field in COUNTS else value > 0


@given(
    dt=st.floats(1e-3, 2),
    substeps=st.integers(1, 400),
    radius=st.floats(0.05, 5),
    speed=st.floats(0.1, 100),
)
def test_contacts_are_accepted_exactly_when_no_body_moves_a_quarter_radius_in_a_physics_step(
    dt: float, substeps: int, radius: float, speed: float
):
    fields = {"dt": dt, "agent_radius": radius, "max_speed": speed}
    longest = min(0.02, radius / (4 * speed))
    needed = math.ceil(dt / longest - 1e-9)
    if substeps >= needed:
        assert SceneSpec(substeps=substeps, **fields).timestep == dt / substeps
        return
    error = refused(substeps=substeps, **fields)
    assert error.field == "substeps"
    assert error.allowed.startswith(f"at least {needed} ")
    assert SceneSpec(substeps=needed, **fields).timestep <= longest * (1 + 1e-8)
    assert SceneSpec(substeps=substeps, contacts=False, **fields).contacts is False


def test_fifteen_substeps_are_enough_and_fourteen_are_refused_with_the_reason():
    assert SceneSpec(dt=0.3, agent_radius=1.0, max_speed=10.0, substeps=15).timestep == pytest.approx(0.02)
    error = refused(dt=0.3, agent_radius=1.0, max_speed=10.0, substeps=14)
    assert (error.field, error.given) == ("substeps", 14)
    for word in ("at least 15", "quarter", "1.0 m", "10.0 m/s", f"{MAX_TIMESTEP} s"):
        assert word in error.allowed


def test_the_smallest_body_that_can_collide_decides():
    small = {"obstacle_radius": 0.5, "agent_radius": 1.0, "max_speed": 10.0, "dt": 0.3}
    assert refused(substeps=23, **small).allowed.startswith("at least 24 ")  # 0.5 / 40 = 0.0125 s
    assert SceneSpec(substeps=15, num_obstacles=0, **small).num_obstacles == 0


def test_no_speed_limit_needs_contacts_off():
    assert refused(max_speed=math.inf).field == "max_speed"
    assert SceneSpec(max_speed=math.inf, max_acceleration=math.inf, contacts=False, substeps=1).max_speed == math.inf


def test_a_spec_is_frozen_and_comparable():
    spec = SceneSpec()
    with pytest.raises(dataclasses.FrozenInstanceError):
        spec.dt = 0.1  # pyright: ignore[reportAttributeAccessIssue]
    assert spec == SceneSpec()
    assert hash(spec) == hash(SceneSpec())
    assert dataclasses.replace(spec, substeps=31) != spec


@given(agents=st.integers(1, 60), obstacles=st.integers(0, 20), radius=st.floats(0.1, 20))
def test_absent_bodies_wait_outside_the_arena_and_clear_of_each_other(agents: int, obstacles: int, radius: float):
    spec = SceneSpec(num_agents=agents, num_obstacles=obstacles, obstacle_radius=radius, contacts=False)
    waiting_agents, waiting_obstacles = spec.parking()
    assert (len(waiting_agents), len(waiting_obstacles)) == (agents, obstacles)
    places = [(place, spec.agent_radius) for place in waiting_agents]
    places += [(place, spec.obstacle_radius) for place in waiting_obstacles]
    for i, (place, size) in enumerate(places):
        assert math.dist(place, (0, 0)) > 5 * spec.arena
        for other, other_size in places[:i]:
            assert math.dist(place, other) > 1.5 * (size + other_size)
