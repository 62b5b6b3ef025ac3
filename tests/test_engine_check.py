"""The check of the engines: it passes sound engines, and a planted wrong flag does not escape it."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from helpers import scene_state

from envs.engines import make_engine
from swarmnet.engine_check import BORDERLINE, SPEC, Verdict, check_engines, gaps, judge_flags, random_scenes

SCENES = 300


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


def test_flags_are_counted_once_for_every_present_agent(stepped):
    state, contacts = stepped
    verdict = judged(state, contacts)
    assert verdict.scenes == SCENES
    assert verdict.flags == state.agent_present.sum() * 3  # the others, and two obstacles
    assert verdict.on == state.touching_agent.sum() + state.touching_obstacle.sum()
    assert verdict.wrong == 0


def test_every_planted_wrong_flag_is_found(stepped):
    state, contacts = stepped
    rng = np.random.default_rng(0)
    to_agent, to_obstacle = gaps(state, SPEC)
    clear = np.concatenate([np.abs(to_agent.min(axis=2))[..., None], np.abs(to_obstacle)], axis=-1) >= BORDERLINE
    clear &= state.agent_present[..., None]
    for k in range(2):
        flipped = state.touching_obstacle.copy()
        places = rng.permutation(np.argwhere(clear[..., 1 + k]))[:5]
        for scene, agent in places:
            flipped[scene, agent, k] ^= True
        assert judged(replace(state, touching_obstacle=flipped), contacts).wrong == 5
    flipped = state.touching_agent.copy()
    for scene, agent in rng.permutation(np.argwhere(clear[..., 0]))[:5]:
        flipped[scene, agent] ^= True
    assert judged(replace(state, touching_agent=flipped), contacts).wrong == 5


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
    spec = replace(SPEC, num_agents=2, num_obstacles=1)
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
