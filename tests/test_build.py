"""The built scene: plain MJCF that every MuJoCo loader takes, no solid meets a solid, addresses are found by name."""

import dataclasses
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from swarm_mjcf import names
from swarm_mjcf.build import build, compile_physics, compile_scene, to_xml
from swarm_mjcf.index import SceneIndex
from swarm_mjcf.spec import SceneSpec

SPEC = SceneSpec(num_agents=3, num_obstacles=2, agent_mass=2.5, walls=True)
specs = st.builds(
    SceneSpec,
    num_agents=st.integers(1, 12),
    num_obstacles=st.integers(0, 5),
    goal=st.booleans(),
    walls=st.booleans(),
    contacts=st.booleans(),
    agent_mass=st.sampled_from([0.1, 1.0, 30.0]),
)


def geom_names(model: mujoco.MjModel) -> list[str]:
    return [model.geom(i).name for i in range(model.ngeom)]


def may_collide(model: mujoco.MjModel, a: int, b: int) -> bool:
    """MuJoCo's own rule for a pair of geoms."""
    ab = model.geom_contype[a] & model.geom_conaffinity[b]
    return bool(ab | (model.geom_contype[b] & model.geom_conaffinity[a]))


def test_the_scene_holds_what_the_spec_says():
    model = compile_scene(SPEC)
    assert (model.nq, model.nv, model.nu) == (6, 6, 6)
    assert model.nmocap == 2 + 1
    assert model.opt.timestep == pytest.approx(0.3 / 30)
    np.testing.assert_array_equal(model.opt.gravity, 0)
    np.testing.assert_array_equal(model.dof_damping, 0)
    np.testing.assert_array_equal(model.body_mass[[model.body(names.agent(i)).id for i in range(3)]], 2.5)
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 2.5)  # so that a control is an acceleration
    for i in range(3):
        geom = model.geom(names.agent(i))
        assert (geom.type[0], geom.size[0]) == (mujoco.mjtGeom.mjGEOM_SPHERE, SPEC.agent_radius)
        assert (geom.condim[0], geom.margin[0], geom.gap[0]) == (1, 0, 0)
    for k in range(2):
        assert model.geom(names.obstacle(k)).size[0] == SPEC.obstacle_radius
        assert model.body(names.obstacle(k)).mocapid[0] >= 0
    assert model.body(names.GOAL).mocapid[0] >= 0


def test_a_control_is_an_acceleration_whatever_the_mass():
    model = compile_scene(replace(SPEC, agent_mass=7.0))
    data = mujoco.MjData(model)
    data.qpos[:] = [-40, 0, 0, 0, 40, 0]
    mocap = SceneIndex.of(model, SPEC).obstacle_mocap
    data.mocap_pos[mocap, :2] = [[0, 60], [0, -60]]
    data.ctrl[:] = [1, 2, -3, 4, 0.5, -6]
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    np.testing.assert_allclose(data.qacc, data.ctrl, rtol=1e-12)


@settings(max_examples=25)
@given(specs)
def test_agents_meet_agents_obstacles_and_walls_and_no_solid_meets_a_solid(spec: SceneSpec):
    model = compile_scene(spec)
    agents = {model.geom(names.agent(i)).id for i in range(spec.num_agents)}
    solids = {model.geom(names.obstacle(k)).id for k in range(spec.num_obstacles)}
    solids |= {model.geom(name).id for name in names.WALLS if spec.walls}
    colliding = {
        (min(a, b), max(a, b))
        for a in range(model.ngeom)
        for b in range(model.ngeom)
        if a < b and may_collide(model, a, b)
    }
    expected = {(min(a, b), max(a, b)) for a in agents for b in agents | solids if a != b}
    assert colliding == expected


@settings(max_examples=25)
@given(specs)
def test_addresses_agree_with_names(spec: SceneSpec):
    model = compile_scene(spec)
    data = mujoco.MjData(model)
    index = SceneIndex.of(model, spec)
    marks = np.arange(1.0, 2 * spec.num_agents + 1)
    data.qpos[index.qpos], data.qvel[index.dof], data.ctrl[index.control] = marks, 10 * marks, 100 * marks
    for i in range(spec.num_agents):
        for j, axis in enumerate(names.AXES):
            assert data.joint(names.joint(i, axis)).qpos[0] == marks[2 * i + j]
            assert data.joint(names.joint(i, axis)).qvel[0] == 10 * marks[2 * i + j]
            assert data.actuator(names.motor(i, axis)).ctrl[0] == 100 * marks[2 * i + j]
    rows = np.arange(model.nmocap)[index.obstacle_mocap]
    assert [model.body(names.obstacle(k)).mocapid[0] for k in range(spec.num_obstacles)] == rows.tolist()
    assert (index.goal_mocap is not None) == spec.goal
    if spec.goal:
        assert model.body(names.GOAL).mocapid[0] == index.goal_mocap
    data.sensordata[:] = np.arange(model.nsensordata)
    everything = np.concatenate([data.sensordata[a] for a in (index.touch, index.obstacle_touch, index.wall_touch)])
    assert sorted(everything) == list(range(model.nsensordata))
    for i in range(spec.num_agents):
        assert data.sensor(names.touch(i)).data.tolist() == [data.sensordata[index.touch][i]]
    others = [names.obstacle(k) for k in range(spec.num_obstacles)]
    for address, solids in ((index.obstacle_touch, others), (index.wall_touch, names.WALLS if spec.walls else ())):
        pairs = data.sensordata[address].reshape(len(solids), spec.num_agents, 2)
        for k, other in enumerate(solids):
            for i in range(spec.num_agents):
                assert data.sensor(names.touch_of(i, other)).data.tolist() == pairs[k, i].tolist()


def test_an_index_of_another_models_elements_is_refused():
    with pytest.raises(KeyError, match="agent3_x"):
        SceneIndex.of(compile_scene(SPEC), replace(SPEC, num_agents=4))


def test_an_axis_of_a_joint_moves_the_body_along_that_axis():
    model = compile_scene(SPEC)
    data = mujoco.MjData(model)
    index = SceneIndex.of(model, SPEC)
    places = np.array([[3.0, -4.0], [5.0, 6.0], [-7.0, 8.0]])
    data.qpos[index.qpos] = places.ravel()
    mujoco.mj_kinematics(model, data)
    for i, place in enumerate(places):
        np.testing.assert_allclose(data.body(names.agent(i)).xpos, [*place, 0])


@settings(max_examples=15)
@given(specs)
def test_the_xml_gives_the_same_model_in_plain_mujoco(spec: SceneSpec):
    plain, ours = mujoco.MjModel.from_xml_string(to_xml(spec)), compile_scene(spec)
    for field in (
        "body_mass",
        "geom_contype",
        "geom_conaffinity",
        "geom_size",
        "sensor_adr",
        "geom_solref",
        "body_mocapid",
    ):
        np.testing.assert_array_equal(getattr(plain, field), getattr(ours, field), err_msg=field)
    assert plain.names == ours.names
    assert plain.opt.timestep == ours.opt.timestep


def test_the_mjspec_can_be_written_and_read_again():
    text = build(SPEC).to_xml()
    again = mujoco.MjModel.from_xml_string(text)
    assert geom_names(again) == geom_names(compile_scene(SPEC))


def test_the_xml_gives_the_same_model_in_dm_control():
    from dm_control import mjcf

    ours = compile_scene(SPEC)
    physics = mjcf.Physics.from_mjcf_model(mjcf.from_xml_string(to_xml(SPEC)))
    theirs = physics.model
    for i in range(SPEC.num_agents):
        name = names.agent(i)
        assert theirs.body_mass[theirs.name2id(name, "body")] == ours.body(name).mass[0]
    for name in geom_names(ours):
        there, here = theirs.name2id(name, "geom"), ours.geom(name)
        assert theirs.geom_contype[there] == here.contype[0], name
        assert theirs.geom_conaffinity[there] == here.conaffinity[0], name
        np.testing.assert_array_equal(theirs.geom_size[there], here.size, err_msg=name)
    sensors = [ours.sensor(i).name for i in range(ours.nsensor)]
    assert [theirs.id2name(i, "sensor") for i in range(theirs.nsensor)] == sensors
    assert theirs.nsensordata == ours.nsensordata
    # Two agents that overlap by half a metre, an obstacle out of reach, one step: the sensors speak there too.
    index = SceneIndex.of(ours, SPEC)
    with physics.reset_context():
        physics.data.qpos[index.qpos] = [0, 0, 1.5, 0, 30, 30]
        physics.data.mocap_pos[index.obstacle_mocap, :2] = [[60, 60], [-60, -60]]
    assert physics.data.sensordata[index.touch].tolist() == [1, 1, 0]
    physics.step()
    assert physics.data.qvel[index.dof][0] < 0 < physics.data.qvel[index.dof][2]


def test_the_sensors_say_who_touches_whom():
    model = compile_scene(SPEC)
    data = mujoco.MjData(model)
    index = SceneIndex.of(model, SPEC)
    # Agent 0 is 0.25 m inside obstacle 1, agent 1 is 0.5 m inside agent 0, agent 2 is 0.125 m inside the north wall.
    data.qpos[index.qpos] = [0, 0, -1.5, 0, 50, 99.125]
    data.mocap_pos[index.obstacle_mocap, :2] = [[0, -50], [7.75, 0]]
    mujoco.mj_forward(model, data)
    assert data.sensordata[index.touch].tolist() == [2, 1, 1]
    obstacle = data.sensordata[index.obstacle_touch].reshape(2, 3, 2)
    assert obstacle[..., 0].tolist() == [[0, 0, 0], [1, 0, 0]]
    assert obstacle[1, 0, 1] == pytest.approx(-0.25, abs=1e-12)
    wall = data.sensordata[index.wall_touch].reshape(4, 3, 2)
    assert wall[..., 0].tolist() == [[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0]]
    assert wall[1, 2, 1] == pytest.approx(-0.125, abs=1e-12)


def test_without_contacts_bodies_pass_through_each_other():
    spec = replace(SPEC, contacts=False)
    model = compile_scene(spec)
    data = mujoco.MjData(model)
    data.qpos[:] = [0, 0, 0.5, 0, 1, 0]
    mujoco.mj_step(model, data)
    assert data.ncon == 0
    np.testing.assert_array_equal(data.qvel, 0)


def test_a_viewer_finds_cameras_a_light_and_visible_bodies():
    model = compile_scene(SPEC)
    assert {model.camera(i).name for i in range(model.ncam)} == {names.TOP_CAMERA, names.TILTED_CAMERA}
    assert model.nlight >= 1
    shown = {name for i, name in enumerate(geom_names(model)) if model.geom_group[i] < 3 and model.geom_rgba[i, 3] > 0}
    bodies = [names.agent(i) for i in range(3)] + [names.obstacle(k) for k in range(2)] + [names.GOAL]
    assert {names.disc(name) for name in bodies} <= shown
    assert set(names.WALLS) <= shown
    colors = {tuple(model.geom_rgba[model.geom(names.disc(names.agent(i))).id]) for i in range(3)}
    assert len(colors) == 3
    top = model.camera(names.TOP_CAMERA)
    covered = top.pos[2] * np.tan(np.radians(top.fovy[0] / 2))
    assert covered >= SPEC.arena


def test_a_thousand_agents_compile():
    spec = SceneSpec(num_agents=1000, num_obstacles=1)
    model = compile_scene(spec)
    assert model.nu == 2000
    assert SceneIndex.of(model, spec).qpos == slice(0, 2000)


NAMED_ELEMENTS = [
    names.agent(0),
    names.joint(0, names.AXES[0]),
    names.motor(0, names.AXES[1]),
    names.obstacle(0),
    names.touch(0),
    names.touch_of(0, names.obstacle(0)),
    names.disc(names.agent(0)),
    *names.WALLS,
]


def spelled_in(source: str) -> list[str]:
    """Element names, written out (`"agent0"`) or as a format (`f"agent{i}"`), in a source's string literals."""
    number = r"(?:\d+|\{[^}]*\})"
    spelling = re.compile(
        rf"""["'](?:agent|obstacle){number}(?:\w|\{{[^}}]*\}})*["']|["']wall_(?:east|north|west|south)["']"""
    )
    return spelling.findall(source)


def test_the_search_for_spelled_names_finds_every_kind_of_name():
    for name in NAMED_ELEMENTS:
        assert spelled_in(f"x = '{name}'"), name
    for source in ('f"agent{i}"', 'f"agent{i}_{axis}"', "f'obstacle{k}'", 'f"agent{i}_touch_{other}"'):
        assert spelled_in(source), source
    assert not spelled_in('"agents"; "agent_radius"; f"{count} agents"; "obstacle"')


def test_only_names_py_spells_element_names():
    root = Path(__file__).parents[1]
    sources = [
        p
        for package in ("swarm_mjcf", "envs", "gnn", "rl", "repair", "swarmnet")
        for p in (root / package).rglob("*.py")
    ]
    spelling = {str(path.relative_to(root)): spelled_in(path.read_text()) for path in sources}
    assert {path for path, found in spelling.items() if found} == {"swarm_mjcf/names.py"}


@pytest.mark.parametrize("walls", [False, True])
def test_the_model_for_stepping_alone_has_the_same_physics_and_addresses(walls):
    spec = SceneSpec(num_agents=6, num_obstacles=2, walls=walls, arena=30.0, obstacle_radius=3.0)
    full, lean = compile_scene(spec), compile_physics(spec)
    assert lean.ngeom < full.ngeom
    assert lean.ncam == lean.nlight == 0
    for field in dataclasses.fields(SceneIndex):
        np.testing.assert_array_equal(
            np.r_[getattr(SceneIndex.of(full, spec), field.name)], np.r_[getattr(SceneIndex.of(lean, spec), field.name)]
        )
    data, index = [mujoco.MjData(model) for model in (full, lean)], SceneIndex.of(full, spec)
    rng = np.random.default_rng(0)
    start, speed, pull = rng.uniform(-8, 8, 12), rng.uniform(-10, 10, 12), rng.uniform(-5, 5, 12)
    touched = 0
    for d, model in zip(data, (full, lean), strict=True):
        d.qpos[index.qpos], d.qvel[index.dof], d.ctrl[index.control] = start, speed, pull
        d.mocap_pos[index.obstacle_mocap, :2] = [[5, 5], [-5, -5]]
        for _ in range(200):
            mujoco.mj_step(model, d)
            touched += d.ncon
    assert touched > 20
    for field in ("qpos", "qvel", "qacc", "sensordata"):
        np.testing.assert_array_equal(getattr(data[0], field), getattr(data[1], field))


def test_engines_settings_become_custom_numbers_and_nothing_else():
    model = compile_physics(SPEC, {"max_contact_points": 12.0})
    assert model.numeric("max_contact_points").data.tolist() == [12]
    assert compile_physics(SPEC).nnumeric == 0
    np.testing.assert_array_equal(model.geom_size, compile_physics(SPEC).geom_size)
