"""Looking inside: networks made by hand have known messages, fields, probes and contributions."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from by_hand import COUNTS, FREE, LAW, by_hand, flock, linear, random_model
from learning import complete, quick_compiles, random_swarm, scales

from envs.config import SimulateConfig, make_world
from envs.experts.config import BoidsConfig, ChaserConfig, HelbingConfig, VicsekConfig
from envs.noise import ActuationNoise
from envs.simulate import simulate
from envs.storage import load, save
from gnn.baselines.config import PRESETS as RIVALS
from gnn.checkpoint import Model
from gnn.config import TrainConfig
from gnn.contributions import NOTHING, along, contributions, only_edges
from gnn.decode import network
from gnn.evaluate import prediction_error
from gnn.force_fields import ForceField, effect, force_field, r_squared, spans_of
from gnn.graph import EDGE_TYPES
from gnn.laws import LawError, law_predict, pair_force, same_rules
from gnn.messages import NoEdgeFunctionsError, acceleration, edge_kinds, messages, swarmnet_config
from gnn.probe import fit_linear, linear_probe
from gnn.train import train
from swarm_mjcf.errors import SpecError
from swarmnet.cli import main
from swarmnet.figures import svg
from swarmnet.figures_probe import contribution_figure, force_field_figure, png


@pytest.fixture(scope="module", autouse=True)
def quick():
    with quick_compiles():
        yield


# --- the true law of a pair ---


def test_the_pair_law_of_helbing_is_its_formula():
    config = HelbingConfig()
    receiver = np.array([[0, 0, 1, 0], [0, 0, 0, 0]], np.float32)
    sender = np.array([[4, 0, 0, 2], [0, -10, 0, 0]], np.float32)  # overlap by 2 m; apart by 4 m
    found = pair_force(config, "agent", receiver, sender)
    near = np.array([-np.exp(2 / 2) - 2 * 2, 2 * 2])  # away, and sideways with the other: 2 m times 2 m/s
    np.testing.assert_allclose(found, [near, [0, np.exp(-4 / 2)]], rtol=1e-5, atol=1e-6)
    wall = pair_force(config, "obstacle", receiver[1:], np.array([[15, 0, 0, 0]], np.float32))
    np.testing.assert_allclose(wall, [[-np.exp(-4 / 2), 0]], rtol=1e-5, atol=1e-6)


def test_the_pair_law_of_boids_has_no_walls_and_of_chasers_is_the_displacement():
    receiver, sender = np.array([[90, 0, 10, 0]], np.float32), np.array([[92, 0, 10, 1]], np.float32)
    found = pair_force(BoidsConfig(), "agent", receiver, sender)
    np.testing.assert_allclose(found, [[0.2 * 2 - 2 / 2, 0.2]], rtol=1e-5)
    np.testing.assert_allclose(pair_force(ChaserConfig(gain=2.0), "agent", receiver, sender), [[4, 0]], rtol=1e-6)
    far = np.array([[0, 50, 0, 0]], np.float32)
    np.testing.assert_allclose(pair_force(BoidsConfig(), "obstacle", receiver, far), [[0, 0]], atol=1e-6)


def test_experts_without_typed_rules_are_named():
    pair = np.zeros((1, 4), np.float32)
    with pytest.raises(LawError, match="chasers know no goal edges"):
        pair_force(ChaserConfig(), "goal", pair, pair)
    with pytest.raises(LawError, match="boids or helbing, not vicsek"):
        same_rules(VicsekConfig(), ("agent",))
    with pytest.raises(SpecError, match="goal, obstacle, agent"):
        same_rules(BoidsConfig(), ("wall",))


# --- messages and norms ---


def test_messages_are_the_edge_functions_and_nothing_where_an_edge_is_off():
    model = by_hand()
    history, present, graph = random_swarm(1, COUNTS, absent=0.3)
    found = messages(model, history, graph)
    x = history[:, -1, 2:]
    for b, i, j in np.ndindex(3, 3, 3):
        apart = 0.3 * (x[b, j, :2] - x[b, i, :2]) + 0.2 * (x[b, j, 2:] - x[b, i, 2:])
        on = i != j and present[b, 2 + i] and present[b, 2 + j]
        np.testing.assert_allclose(found["agent"][b, i, j], apart if on else 0, atol=1e-5)
    assert set(found) == set(EDGE_TYPES)


def test_the_acceleration_of_a_state_change_is_that_of_the_velocity():
    model = random_model("thesis-ch3")
    history, _, graph = random_swarm(3, COUNTS, window=5)
    out = np.asarray(network(swarmnet_config(model), model.scales)(model.params, history, graph))
    np.testing.assert_allclose(acceleration(model, history, graph), out[:, 2:, 2:] / 0.1, rtol=1e-5)


def test_a_rival_has_nothing_to_look_into():
    name, config = next(iter(RIVALS.items()))
    model = Model(config, scales(), FREE, {}, {})
    with pytest.raises(NoEdgeFunctionsError, match=type(config).__name__):
        edge_kinds(model)
    assert name


# --- force fields ---


@pytest.mark.parametrize("over", ["position", "velocity"])
@pytest.mark.parametrize("kind", ["goal", "agent"])
def test_a_network_made_of_the_law_has_exactly_its_field(kind: str, over: str):
    field = force_field(by_hand(), kind, LAW, over=over, resolution=7)
    assert field.true is not None
    np.testing.assert_allclose(field.learned, field.true, atol=1e-4)
    assert field.r2 == pytest.approx(1, abs=1e-5)
    assert field.relative_error == pytest.approx(0, abs=1e-3)
    assert field.learned.shape == (7, 7, 2)


def test_a_field_by_hand():
    field = force_field(by_hand(), "agent", resolution=3, reach=6.0)
    np.testing.assert_allclose(field.learned, 0.3 * field.grid, atol=1e-5)
    assert field.true is None
    assert np.isnan(field.r2)
    assert np.isnan(field.relative_error)
    np.testing.assert_allclose(field.grid[0, 2], [6, -6])


def test_the_effect_is_what_the_edge_adds_beside_a_goal_too():
    receiver = np.array([[1, 2, 3, 4]], np.float32)
    sender = np.array([[5, 5, 0, 0]], np.float32)
    alone = effect(by_hand(own_speed=0.4), "agent", receiver, sender)
    np.testing.assert_allclose(alone, [[0.3 * 4 - 0.2 * 3, 0.3 * 3 - 0.2 * 4]], rtol=1e-5)
    beside = effect(by_hand(own_speed=0.4), "agent", receiver, sender, goal=jnp.asarray([0.0, 60.0]))
    np.testing.assert_allclose(beside, alone, atol=1e-5)


@pytest.mark.parametrize("name", ["thesis-ch3", "thesis-ch5", "best"])
def test_the_effect_is_a_difference_of_accelerations_in_a_world_of_two(name: str):
    model = random_model(name)
    receiver, sender = np.array([[1, 2, 0, 0]], np.float32), np.array([[-3, 1, 0, 0]], np.float32)
    nodes = np.broadcast_to(np.stack([0 * sender, 0 * sender, receiver, sender], axis=1)[:, None], (
        1, model.config.window, 4, 4))  # fmt: skip
    here = np.array([[False, False, True, True]])
    two, one = complete(here, (1, 1, 2)), complete(here & [True, True, True, False], (1, 1, 2))
    difference = acceleration(model, nodes, two) - acceleration(model, nodes, one)
    np.testing.assert_allclose(effect(model, "agent", receiver, sender), difference[:, 0], rtol=1e-3, atol=1e-4)


def test_fields_are_compared_within_the_limit_of_acceleration():
    grid = np.zeros((2, 2, 2), np.float32)
    learned, true = (np.array([[[x, 0], [0, 1]], [[0, 0], [0, 0]]], np.float32) for x in (5, 80))
    made = ForceField(
        kind="agent", over="position", grid=grid, velocity=grid[0, 0], learned=learned, true=true, limit=5.0
    )
    assert made.r2 == pytest.approx(1)
    assert replace(made, limit=float("inf")).relative_error == pytest.approx(75 / np.sqrt(80**2 + 1), rel=1e-4)


def test_impossible_fields_are_refused():
    with pytest.raises(SpecError, match="position or velocity"):
        force_field(by_hand(), "agent", over="time")
    with pytest.raises(SpecError, match="goal, obstacle, agent"):
        force_field(by_hand(), "wall")
    with pytest.raises(SpecError, match="None for goal edges"):
        force_field(by_hand(), "goal", goal=(0.0, 1.0))
    with pytest.raises(LawError):
        force_field(by_hand(), "goal", ChaserConfig())


def test_the_figure_of_fields_shows_them_beside_the_law_with_their_numbers():
    fields = [
        force_field(by_hand(), "goal", LAW, resolution=5),
        force_field(by_hand(), "agent", resolution=5),
    ]
    figure = force_field_figure(fields)
    titles = [ax.get_title() for ax in figure.axes]
    assert "goal → agent, learned\nR² 1.000, error 0%" in titles
    assert "goal → agent, true law\n" in titles
    assert "agent → agent, learned" in titles
    shown = figure.axes[0].collections[0].get_array()
    assert shown is not None
    np.testing.assert_allclose(np.asarray(shown).ravel(), np.linalg.norm(fields[0].learned, axis=-1).ravel(), rtol=1e-6)
    assert png(figure).startswith(b"\x89PNG")


# --- linear probe ---


def test_messages_that_are_a_linear_image_of_the_force_have_r2_of_1_and_shuffled_forces_0():
    model = by_hand()
    mixed = np.random.default_rng(3).normal(size=(2, 2)).astype(np.float32)
    layer = model.params["edge"]["agent"]["layer0"]
    layer["kernel"], layer["bias"] = layer["kernel"] @ mixed, np.array([3, -1], np.float32)
    probe = linear_probe(model, flock(60), LAW, pairs=600, ridge=0.0)
    assert probe.r2 == pytest.approx(1, abs=1e-4)
    assert abs(probe.shuffled) < 0.05
    np.testing.assert_allclose(mixed @ probe.kernel, np.eye(2), atol=1e-3)
    assert probe.fitted >= 600


def test_messages_that_do_not_tell_the_force_have_r2_of_0():
    model = by_hand()
    # Of the receiver's own velocity alone: cohesion, which is most of the force, cannot be read off.
    model.params["edge"]["agent"]["layer0"]["kernel"] = linear(0, 1, 0)
    probe = linear_probe(model, flock(60), replace(LAW, alignment=0.0), pairs=600)
    assert abs(probe.r2) < 0.05


def test_least_squares_by_hand():
    x = np.random.default_rng(0).normal(size=(50, 3))
    kernel, bias = fit_linear(np.concatenate([x, np.ones((50, 1))], axis=1), x[:, :2] * [2, -3] + [1, 5])
    np.testing.assert_allclose(kernel, [[2, 0], [0, -3], [0, 0], [0, 0]], atol=1e-8)
    np.testing.assert_allclose(bias, [1, 5], atol=1e-8)
    assert r_squared(np.array([[0.0, 1], [2, 3]]), np.array([[0.0, 1], [2, 3]])) == 1
    assert r_squared(np.array([[0.0, 0], [2, 0]]), np.array([[1.0, 0], [1, 0]])) == 0


# --- contributions ---


@pytest.mark.parametrize("name", ["thesis-ch3", "thesis-ch5", "best"])
def test_parts_add_up_and_follow_the_agents(name: str):
    model = random_model(name)
    history, present, graph = random_swarm(4, COUNTS, window=model.config.window, absent=0.2)
    parts = contributions(model, history, graph)
    full, none = acceleration(model, history, graph), acceleration(model, history, only_edges(graph, ()))
    assert list(parts) == [NOTHING, *EDGE_TYPES]
    np.testing.assert_allclose(parts[NOTHING], none, atol=1e-6)
    np.testing.assert_allclose(sum(parts.values()), full, rtol=1e-4, atol=1e-5)
    assert np.abs(full - none).max() > 1e-2
    order = np.array([2, 0, 1])
    nodes = np.concatenate([[0, 1], 2 + order])
    again = contributions(model, history[:, :, nodes], complete(present[:, nodes], COUNTS))
    for kind, part in parts.items():
        np.testing.assert_allclose(again[kind], np.asarray(part)[:, order], rtol=1e-3, atol=1e-4)


def test_parts_of_a_sum_of_forces_are_the_forces():
    model = by_hand(own_speed=0.1)
    scenes = flock(2, 6)
    parts = along(model, scenes, 1)
    p, v, goal = scenes.position[1, :, 2:], scenes.velocity[1, :, 2:], scenes.position[1, :, :1]
    np.testing.assert_allclose(parts[NOTHING], -0.1 * v, atol=1e-5)
    np.testing.assert_allclose(parts["goal"], 0.5e-3 * (goal - p) - 0.4 * v, atol=1e-4)
    np.testing.assert_allclose(parts["obstacle"], 0 * v, atol=1e-5)
    others = 0.3 * (p.sum(1, keepdims=True) - 3 * p) / 2 + 0.2 * (v.sum(1, keepdims=True) - 3 * v) / 2
    np.testing.assert_allclose(parts["agent"], others, atol=1e-4)
    figure = contribution_figure(parts, dt=0.1, agents=(0, 2))
    lines = {line.get_gid(): line for line in figure.axes[1].lines}
    np.testing.assert_allclose(np.asarray(lines["agent"].get_ydata()), np.linalg.norm(others[:, 2], axis=-1), rtol=1e-3)
    np.testing.assert_allclose(np.asarray(lines["agent"].get_xdata()), 0.1 * np.arange(6))
    assert set(lines) == {"all", NOTHING, *EDGE_TYPES}
    assert "agent 3" in svg(figure) or figure.axes[1].get_title(loc="left") == "agent 3"


@pytest.mark.parametrize("preset", ["published", "helbing"])
def test_the_law_as_a_predictor_continues_recordings(preset: str, tmp_path):
    simulate(SimulateConfig(preset=preset, scenes=12, num_agents=4, steps=24, mixed=True), tmp_path / "data.h5")
    found = prediction_error(law_predict(make_world(preset)), {}, load(tmp_path / "data.h5"), window=1, horizons=(20,))
    assert found.published_mean[0] < 1e-6


def test_the_noise_of_a_law_has_the_size_asked_for():
    """One step without limits: noise u of standard deviation s changes the velocity by u dt, the position by u dt^2."""
    world, s = make_world("published"), 0.05
    world = replace(world, scene=replace(world.scene, max_speed=np.inf, max_acceleration=np.inf))
    history, _, graph = random_swarm(0, (1, 1, 4), batch=500)
    quiet = law_predict(world)({}, history, graph, horizon=1)
    loud = law_predict(world, ActuationNoise(std=s))({}, history, graph, horizon=1)
    off, dt = np.asarray(loud - quiet)[:, 0], world.scene.dt
    assert not off[:, :2].any()
    done = off[:, 2:, 2:] / dt
    np.testing.assert_allclose(off[:, 2:, :2], done * dt**2, atol=1e-4)
    np.testing.assert_allclose(done.std(), s, rtol=0.05)
    np.testing.assert_allclose(done.mean(), 0, atol=0.004)


def test_the_law_of_chasers_is_no_predictor():
    with pytest.raises(LawError, match="chasers"):
        law_predict(make_world("chaser"))


# --- the command ---


def test_fields_of_recordings_reach_what_people_keep_between_them():
    """By hand: median speed 1.2, of the fastest 2 m/s; median distance 0.8 m."""
    seen = {"agents": np.ones(3), "speed": np.asarray([1.0, 1.2, 2.0]), "spacing": np.asarray([0.5, 0.8, 3.0])}
    span = spans_of(seen)
    assert (span.speed, span.apart) == (1.2, 0.8)
    assert span.velocity == pytest.approx(2 * (1.2 + 0.98 * 0.8))
    assert (span.agents, span.others, *span.goal) == pytest.approx((4.0, 8.0, 0.0, 12.0))
    assert spans_of(seen | {"spacing": np.zeros(0)}).apart == pytest.approx(0.8 * 1.2)  # 4 m at 5 m/s
    standing = seen | {
        "speed": np.append(seen["speed"], np.zeros(9)),
        "spacing": np.append(seen["spacing"], np.zeros(9)),
    }
    assert spans_of(standing) == span, "who stands and who is not apart has no scale"


def test_a_probe_looks_anew_and_leaves_no_picture_of_another_network(tmp_path, capsys):
    """Of a recording at some metres per second, whose figure 5.1 of another network goes; then of a simulated world."""
    config = SimulateConfig(scenes=6, steps=8, num_agents=3, num_obstacles=0, seed=3)
    simulate(config, tmp_path / "d.h5")
    slow = load(tmp_path / "d.h5")
    slow = replace(slow, position=slow.position / 8, velocity=slow.velocity / 8, provenance={"import": {}})
    save(tmp_path / "slow.h5", slow)
    training = TrainConfig(model="best", horizons=(1,), stage_steps=(2,), chunk=2, batch=4)
    run = tmp_path / "r"
    train(training, load(tmp_path / "d.h5"), run)
    figures = run / "figures"
    figures.mkdir(exist_ok=True)
    for name in ("figure-5.1.svg", "prediction.svg"):
        (figures / name).write_text("old")
    assert main(("probe", str(run), "--data", str(tmp_path / "slow.h5"))) == 0
    assert "what law made these trajectories is not known" in capsys.readouterr().out
    drawn = {path.name for path in figures.iterdir()}
    assert drawn == {"probe-position.svg", "probe-velocity.svg", "probe-contributions.svg", "prediction.svg"}
    near = (figures / "probe-velocity.svg").read_bytes()
    assert main(("probe", str(run), "--data", str(tmp_path / "d.h5"), "--seed", "9")) == 0
    assert (figures / "figure-5.1.svg").exists()
    assert (figures / "probe-velocity.svg").read_bytes() != near
    save(tmp_path / "still.h5", replace(slow, velocity=np.zeros_like(slow.velocity)))
    before = {path.name: path.read_bytes() for path in figures.iterdir()}
    assert main(("probe", str(run), "--data", str(tmp_path / "still.h5"))) == 2
    assert "nobody moves in the 6 scenes" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in figures.iterdir()} == before, "nothing is lost"
