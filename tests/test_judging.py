"""`swarmnet evaluate`: any policy beside any reference, what is written, what is refused. Small scenes, few steps."""

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning import initial, quick_training, random_swarm, tiny

from envs.collective import UNITS
from envs.collisions import collision_report
from envs.config import SimulateConfig
from envs.contact_log import COLUMNS, load_log
from envs.estimates import Estimate
from envs.replay import replay
from envs.simulate import simulate_in_memory
from envs.storage import load, save
from gnn.checkpoint import Model
from gnn.decode import Integrator
from gnn.features import Scales
from swarm_mjcf.errors import SwarmError
from swarmnet.cli import main
from swarmnet.closed_loop import Stage, roll_out
from swarmnet.judge import judge_policy, scenes_seen
from swarmnet.policies import PolicyError, Source, find_policy

SMALL = ("--scenes", "6", "--steps", "10", "--videos", "0", "--engine", "native")
LAW = """
import numpy as np
def crowd(state, params, key):
    return 2 * (state.goal[:, None] - state.position) - state.velocity
def soon_nan(state, params, key):
    return np.where(state.step[:, None, None] > 3, np.nan, np.zeros(state.position.shape))
def wrong(state, params, key):
    return state.position[0]
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Iterator[Path]:
    """A working folder in which one policy has been judged: it drives everybody into one place, 8 agents to a scene."""
    with pytest.MonkeyPatch.context() as patch, quick_training():
        folder = tmp_path_factory.mktemp("judging")
        patch.chdir(folder)
        (folder / "law.py").write_text(LAW)
        arguments = (
            "evaluate",
            "--policy",
            "law:crowd",
            *SMALL,
            "--steps",
            "25",
            "--num-agents",
            "8",
            "--json",
            "e.json",
        )
        assert main(arguments) == 0
        yield folder


@pytest.fixture
def there(runs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(runs)
    return runs / "runs" / "evaluate-law-crowd"


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures and page take longer than all the rest; the tests above look at them."""
    monkeypatch.setattr("swarmnet.commands.evaluate.write_report", lambda folder: folder / "report.html")


def document(folder: Path) -> dict:
    return json.loads((folder / "evaluation.json").read_text())


def test_everything_is_measured_side_by_side(there: Path):
    found = document(there)
    assert (found["policy"], found["reference"], found["given"]["policy"]) == ("law:crowd", "expert", "law:crowd")
    assert (found["scenes"], found["steps"], found["prediction"]) == (6, 25, {})
    learned = load(there / "rollouts" / "learned.h5")
    for name, estimate in collision_report(learned).items():
        assert Estimate(**found["collisions"]["law:crowd"][name]) == estimate, name
    for reports in (found["collisions"], found["collective"]):
        assert list(reports) == ["expert", "law:crowd"]
        assert reports["expert"] != reports["law:crowd"]
    assert found["collisions"]["law:crowd"]["contact_steps_agent"]["value"] > 0.05
    assert (
        found["collective"]["law:crowd"]["spread_final"]["value"]
        < found["collective"]["law:crowd"]["spread_mean"]["value"]
    )
    expert = load(there / "rollouts" / "expert.h5")
    np.testing.assert_array_equal(expert.position[:, 0], learned.position[:, 0])


def test_results_have_rows_for_both(there: Path):
    rows = {(row["row"], row["column"]): row for row in json.loads(Path("e.json").read_text())["rows"]}
    for name in ("expert", "law:crowd"):
        for column in ("contact_steps_any", "contact_steps_any low", "polarisation_mean", "spread_final high"):
            assert (name, column) in rows
    assert rows["expert", "spread_mean"]["unit"] == "m"


def test_the_contact_log_is_that_of_the_policy(there: Path):
    log, learned = load_log(there / "contacts.csv"), load(there / "rollouts" / "learned.h5")
    solid = log.partner_kind == "obstacle"
    assert log.states[solid].sum() == learned.solid_contact.sum()
    assert solid.sum() == learned.solid_events.sum()
    touching = {(int(s), int(a)) for s, a in zip(log.scene, log.agent, strict=True)}
    touching |= {(int(s), int(p)) for s, p, o in zip(log.scene, log.partner, solid, strict=True) if not o}
    first = sum(learned.counts[:2])
    either = ((learned.agent_contact + learned.solid_contact) > 0).any(axis=1)[:, first:]
    assert touching == {(int(s), int(a)) for s, a in np.argwhere(either)}
    assert np.isfinite(log.impulse).all()
    assert (log.impulse > 0).any()
    assert log.depth.max() == pytest.approx(learned.depth.max(), abs=1e-5)


def test_worst_scenes_and_report(there: Path):
    found, page = document(there), (there / "report.html").read_text()
    steps = [scene["contact_steps"] for scene in found["worst"]]
    assert steps == sorted(steps, reverse=True)
    assert steps[0] > 0
    assert "Worst scenes of the policy" in page
    assert "Collective motion" in page
    assert "<code>law:crowd</code> was judged on 6 scenes" in page
    assert "Prediction error" not in page
    assert "contacts.csv" in page
    assert "--policy law:crowd" in page
    figures = {path.name for path in (there / "figures").iterdir()}
    assert {"collective.svg", "collective-polarisation.png", "goal.svg", "contacts.svg"} <= figures
    assert (there / "figures" / "collective-spread.png").read_bytes().startswith(b"\x89PNG")


def test_a_recording_is_replayed_beside_a_policy_from_its_own_starts(there: Path, no_report, capsys):
    """What the engine recorded, judged by its positions; the expert starts where the recording does."""
    recorded = load(there / "rollouts" / "learned.h5")
    save("mine.h5", recorded)
    assert main(("evaluate", "--policy", "mine.h5", "--log", "parquet", "--videos", "0", "--engine", "native")) == 0
    assert "contacts from positions, 6 scenes" in capsys.readouterr().out
    folder = Path("runs/evaluate-mine")
    found = document(folder)
    assert (found["policy"], found["reference"], found["scenes"], found["steps"]) == ("mine", "expert", 6, 25)
    for name, estimate in collision_report(replay(recorded)).items():
        assert Estimate(**found["collisions"]["mine"][name]) == estimate, name
    expert = load(folder / "rollouts" / "expert.h5")
    np.testing.assert_allclose(expert.position[:, 0], recorded.position[:, 0], atol=1e-6)
    assert "replay" in expert.provenance, "both are judged in the same way"
    assert found["by_geometry"]
    log = load_log(folder / "contacts.parquet")
    assert np.isnan(log.impulse).all()
    assert len(log) > 0


def test_a_recording_of_nowhere_is_judged_alone(there: Path, capsys):
    from test_replay import passing

    save("swap.h5", passing())
    assert main(("evaluate", "other", "--policy", "swap.h5", "--videos", "1")) == 0
    out = capsys.readouterr().out
    assert "judged without a reference: the recording does not say in which world it was made" in out
    found = document(Path("other"))
    assert (found["reference"], list(found["collisions"])) == (None, ["swap"])
    assert not (Path("other") / "rollouts" / "expert.h5").exists()
    assert list((Path("other") / "videos").glob("worst-1-scene-0000.*"))
    assert "replayed from recorded positions of 1 scenes" in (Path("other") / "report.html").read_text()


def test_two_recordings_are_compared(there: Path, no_report, capsys):
    first = load(there / "rollouts" / "learned.h5")
    save("one.h5", first)
    save("two.h5", load(there / "rollouts" / "expert.h5"))
    both = ("evaluate", "pair", "--policy", "one.h5", "--reference", "two.h5", "--videos", "0")
    assert main(both) == 0
    assert list(document(Path("pair"))["collective"]) == ["two", "one"]
    before = (Path("pair") / "evaluation.json").read_bytes()
    save("short.h5", first.take([0, 1]))
    assert main(("evaluate", "pair", "--policy", "one.h5", "--reference", "short.h5", "--videos", "0")) == 2
    assert "cannot be compared: short has 2 scenes of 26 rows" in capsys.readouterr().err
    save("moved.h5", replace(first, position=first.position + 1))
    assert main(("evaluate", "pair", "--policy", "one.h5", "--reference", "moved.h5", "--videos", "0")) == 2
    assert "cannot be compared: they have other starts" in capsys.readouterr().err
    assert (Path("pair") / "evaluation.json").read_bytes() == before
    assert (Path("pair") / "contacts.csv").exists()


def test_a_policy_beside_itself_has_two_names(there: Path, no_report):
    assert main(("evaluate", "self", "--policy", "expert", *SMALL)) == 0
    found = document(Path("self"))
    names = ["expert (reference)", "expert"]
    assert list(found["collisions"]) == names
    np.testing.assert_equal(*(found["collisions"][name] for name in names))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "nothing to judge: give a run folder with a trained model, or --policy"),
        (("--policy", "nobody"), "policy 'nobody': not found"),
        (("--policy", "law:wrong"), "returned shape (5, 2)"),
        (("--policy", "law:soon_nan"), "is not finite in 6 of 6 scenes"),
        (("--policy", "expert", "--reference", "law:fly"), "law has no 'fly'"),
        (("--policy", "expert", "--preset", "moon"), "preset: 'moon' was given"),
        (("--policy", "expert", "--scenes", "0"), "scenes: 0 was given"),
        (("--policy", "gone.h5"), "gone.h5: does not exist"),
    ],
)
def test_what_cannot_be_judged_is_one_line(arguments: tuple[str, ...], said: str, there: Path, capsys):
    scenes = SMALL if "--scenes" not in arguments else SMALL[2:]
    assert main(("evaluate", "new", *arguments, *scenes) if arguments else ("evaluate",)) == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if line.startswith("swarmnet: "))
    assert said in line
    assert not Path("new").exists() or not list(Path("new").rglob("*.*"))


def test_a_world_of_other_nodes_and_nothing_to_judge_are_one_line(tmp_path: Path):
    """A mean over the types of edges has another width where a type is missing."""
    world = SimulateConfig(num_agents=3, num_obstacles=1)
    motion = Integrator(dt=0.3, substeps=15, max_speed=10.0, max_acceleration=5.0)
    config = tiny("best")
    history, _, graph = random_swarm(1, (1, 1, 3))
    model = Model(config, Scales.ones(), motion, initial(config, Scales.ones(), history, graph), {"data": {}})
    source = Source(given="r", name="r", model=model)
    motion = world.world().scene
    source = replace(source, model=replace(model, integrator=replace(model.integrator, substeps=motion.substeps)))
    with pytest.raises(PolicyError, match=r"this world: has up to 1 goals, 0 obstacles and 3 agents"):
        judge_policy(source, None, Stage.of(replace(world, num_obstacles=0)), tmp_path)
    still = replace(model, config=tiny("thesis-ch3"))
    (tmp_path / "rollouts").mkdir()
    (tmp_path / "rollouts" / "learned.h5").write_text("of before")
    with pytest.raises(SwarmError, match="nothing to judge without a reference"):
        judge_policy(replace(source, model=still), None, Stage.of(world), tmp_path)
    assert (tmp_path / "rollouts" / "learned.h5").read_text() == "of before"


def test_scenes_of_ppo_and_of_repair_are_not_unseen():
    data = {"mixed": [{"simulate": {"seed": 3, "preset": "clear"}}, {"recorded": "elsewhere"}]}
    about = {"data": data, "repair": {"scene_seed": 2_000_005}, "initial": {"data": data, "rl": {"seed": 8}}}
    motion = Integrator(dt=0.3, substeps=30, max_speed=10.0, max_acceleration=10.0)
    model = Model(tiny("best"), Scales.ones(), motion, {}, about)
    assert scenes_seen(model) == {(3, "clear"), (8, "clear"), (2_000_005, "clear")}
    assert scenes_seen(replace(model, about={"data": data})) == {(3, "clear")}


def test_every_name_is_defined(there: Path):
    text = (Path(__file__).parent.parent / "docs" / "definitions.md").read_text()
    named = set(re.findall(r"`([a-z_]+)`", text))
    for report in document(there)["collisions"].values():
        for name in report:
            assert name in named or any(name == f"{stem}{end}" for stem, end in shortened(text)), name
    assert set(UNITS) | set(COLUMNS) <= named


def shortened(text: str) -> list[tuple[str, str]]:
    """(`stem`, `_end`) of table rows that name several figures at once: `stem_any`, `_agent`, ..."""
    found = []
    for line in text.splitlines():
        if line.startswith("| `") and "`, `_" in line:
            first, *ends = re.findall(r"`([a-z_]+)`", line.split("|")[1])
            stem = first.rsplit("_", 1)[0]
            found += [(stem, end) for end in (first.removeprefix(stem), *ends)]
    return found


def test_the_noise_of_the_world_is_on_whoever_is_judged():
    config = SimulateConfig(preset="published", scenes=4, steps=5, num_agents=3, actuation_noise=2.0, engine="native")
    noisy = roll_out(Stage.of(config), find_policy("expert"), title="noisy")
    np.testing.assert_allclose(noisy.position, simulate_in_memory(config).position, atol=1e-3)
    quiet = roll_out(Stage.of(replace(config, actuation_noise=0.0)), find_policy("expert"), title="quiet")
    assert np.abs(noisy.position - quiet.position).max() > 0.1


@pytest.mark.parametrize("option", ["num-agents", "num-obstacles", "perception-noise", "actuation-noise"])
def test_options_that_a_recording_cannot_follow_are_refused(option: str, there: Path, capsys):
    recorded = str(there / "rollouts" / "learned.h5")
    assert main(["evaluate", "--policy", recorded, f"--{option}", "1"]) == 2
    assert f"{option.replace('-', '_')}: 1" in capsys.readouterr().err
