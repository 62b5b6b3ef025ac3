"""The check of the engines: it passes sound engines, and a planted wrong flag does not escape it."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import scene_state

from envs.engines import make_engine
from swarmnet.engine_check import (
    BORDERLINE,
    COUNTS,
    SPEC,
    SUBSTEPS,
    Verdict,
    check_engines,
    gaps,
    judge_counts,
    judge_flags,
    random_scenes,
)  # fmt: skip

SCENES = 300
LONGER = replace(SPEC, dt=SUBSTEPS * SPEC.dt, substeps=SUBSTEPS)


@pytest.fixture(scope="module")
def stepped():
    """One control step of random dense scenes in the native engine: `(state, contacts)`."""
    state, acceleration = random_scenes(np.random.default_rng(1), SCENES)
    return jax.device_get(jax.jit(make_engine(SPEC, "native").step)(state, acceleration))


def judged(state, contacts) -> Verdict:
    judge_flags(state, contacts, SPEC, verdict := Verdict())
    return verdict


def test_sound_engines_have_no_wrong_flag_and_the_scenes_are_dense():
    seen = []
    verdicts, _ = check_engines(("native",), 500, progress=lambda done, total: seen.append((done, total)))
    verdict = verdicts["native"]
    assert verdict.scenes == 500
    assert verdict.wrong == 0
    assert verdict.touching_scenes >= 500 / 5
    assert 0 < verdict.on < verdict.flags
    assert verdict.borderline < verdict.flags / 100
    assert seen[-1] == (500, 500)
    assert verdict.wrong_counts == 0
    assert verdict.counts % len(COUNTS) == 0
    assert verdict.borderline_counts < verdict.counts / 20


def test_flags_are_counted_once_for_every_present_agent(stepped):
    state, contacts = stepped
    verdict = judged(state, contacts)
    assert verdict.scenes == SCENES
    assert verdict.flags == state.agent_present.sum() * 4  # the others, the walls, and two obstacles
    touching = (state.touching_agent, state.touching_wall, state.touching_obstacle)
    assert all(flag.any() for flag in touching)
    assert verdict.on == sum(flag.sum() for flag in touching)
    assert verdict.wrong == 0


def test_every_planted_wrong_flag_is_found(stepped):
    state, contacts = stepped
    rng = np.random.default_rng(0)
    clear = (np.abs(gaps(state, SPEC)) >= BORDERLINE) & state.agent_present[..., None]

    def places(column: int) -> np.ndarray:
        return rng.permutation(np.argwhere(clear[..., column]))[:5]

    for k in range(2):
        flipped = state.touching_obstacle.copy()
        for scene, agent in places(2 + k):
            flipped[scene, agent, k] ^= True
        assert judged(replace(state, touching_obstacle=flipped), contacts).wrong == 5
    for column, name in enumerate(("touching_agent", "touching_wall")):
        flipped = getattr(state, name).copy()
        for scene, agent in places(column):
            flipped[scene, agent] ^= True
        assert judged(replace(state, **{name: flipped}), contacts).wrong == 5


def test_distances_by_hand():
    """Agents of radius 1 in an arena of 16 m: 1 m between two, 2.5 m to a wall, 4 m to an obstacle of 7 m."""
    spec = replace(SPEC, num_agents=3, num_obstacles=1)
    state = scene_state(spec, [[[12.5, 0], [9.5, 0], [0, -15.5]]], obstacle=[[[0.5, 0]]], obstacle_present=[[True]])
    near = gaps(state, spec)[0]
    assert near[0] == pytest.approx([1, 2.5, 4])
    assert near[1] == pytest.approx([1, 5.5, 1])
    assert near[2] == pytest.approx([np.hypot(9.5, 15.5) - 2, -0.5, np.hypot(0.5, 15.5) - 8])
    assert (gaps(state, replace(spec, walls=False))[0, :, 1] == np.inf).all()


@pytest.mark.parametrize("name", COUNTS)
def test_a_count_that_leaves_out_a_substep_is_found(name):
    """An engine whose control steps forget a contact in every scene that has one."""
    state, acceleration = random_scenes(np.random.default_rng(2), 100)
    one, several = (jax.jit(make_engine(spec, "native").step) for spec in (SPEC, LONGER))

    def forgetful(state, acceleration):
        after, contacts = several(state, acceleration)
        return after, replace(contacts, **{name: np.maximum(np.asarray(getattr(contacts, name)) - 1, 0)})

    for step, least in ((several, 0), (forgetful, 10)):
        judge_counts(one, step, state, acceleration, SPEC, verdict := Verdict())
        assert (verdict.wrong_counts >= least) if least else verdict.wrong_counts == 0


def test_a_flag_of_an_absent_agent_is_wrong(stepped):
    state, contacts = stepped
    scene, agent = np.argwhere(~state.agent_present)[0]
    flipped = state.touching_obstacle.copy()
    flipped[scene, agent, 0] = True
    assert judged(replace(state, touching_obstacle=flipped), contacts).wrong == 1


def test_flags_and_counts_that_disagree_are_wrong(stepped):
    state, contacts = stepped
    scene, agent = np.argwhere(state.touching_agent)[0]
    counts = contacts.agent_states.copy()
    counts[scene, agent] = 0
    assert judged(state, replace(contacts, agent_states=counts)).wrong == 1


def test_a_shifted_world_is_found(stepped):
    """Flags of other positions than those returned: what a sensor one step late would give."""
    state, contacts = stepped
    assert judged(replace(state, position=state.position + state.velocity * 0.1), contacts).wrong > 10


def test_pairs_about_to_touch_are_borderline_and_never_wrong():
    """Two agents and an obstacle, each pair 5e-5 m from touching: geometry may not judge either answer."""
    spec = replace(SPEC, num_agents=2, num_obstacles=1, walls=False)
    position = [[[0, 0], [2 * spec.agent_radius + 5e-5, 0]]]
    obstacle = [[[0, spec.agent_radius + spec.obstacle_radius - 5e-5]]]
    state = scene_state(spec, position, obstacle=obstacle, obstacle_present=[[True]])
    contacts = jax.device_get(jax.jit(make_engine(spec, "native").step)(state, np.zeros((1, 2, 2), np.float32)))[1]
    none = replace(contacts, agent_states=np.zeros((1, 2), np.int32))
    for touching in (False, True):
        told = replace(state, touching_obstacle=np.full((1, 2, 1), touching) & np.array([[[True], [False]]]))
        verdict = Verdict()
        judge_flags(told, none, spec, verdict)
        assert verdict.wrong == 0
        assert verdict.borderline == 3


def test_an_engine_that_lies_is_told_from_one_that_does_not(monkeypatch):
    import swarmnet.engine_check as check

    class Liar:
        def __init__(self, engine):
            self.engine = engine

        def step(self, state, acceleration):
            after, contacts = self.engine.step(state, acceleration)
            return replace(after, touching_obstacle=after.touching_obstacle & False), contacts

    honest = check.make_engine
    monkeypatch.setattr(
        check, "make_engine", lambda spec, name: Liar(honest(spec, "native")) if name == "liar" else honest(spec, name)
    )
    verdicts, comparisons = check_engines(("native", "liar"), 200)
    assert verdicts["native"].wrong == 0
    assert verdicts["liar"].wrong > 50
    assert comparisons["native", "liar"].flags_apart == verdicts["liar"].wrong
    assert comparisons["native", "liar"].position_apart == 0
