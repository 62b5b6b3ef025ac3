"""`swarmnet repair`, `certify` and `evaluate --filter` from one end to the other, small; and docs/repair.md."""

import hashlib
import html
import json
import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import jax
import learning
import numpy as np
import pytest
from helpers import make_trajectories

import swarmnet.commands.repair as command
from envs.config import SimulateConfig
from envs.plain import plain
from envs.storage import save
from gnn.checkpoint import Checkpoints, describe, load_model
from gnn.config import PRESETS, TrainConfig
from gnn.decode import Integrator
from repair.config import LoopConfig
from repair.errors import Status
from repair.loop import Repaired
from repair.network import Situations
from repair.verify import Verification
from swarm_mjcf.errors import SwarmError
from swarmnet.cli import main, parse
from swarmnet.commands.certify import unpacked

ROOT = Path(__file__).parent.parent
WORLD = SimulateConfig(preset="clear", num_agents=3, num_obstacles=1, engine="native", scenes=4, steps=5)
SMALL = (
    "--rounds", "1", "--scenes", "8", "--steps", "5", "--descent.steps", "250", "--test-scenes", "0",
    "--engine", "native",
)  # fmt: skip
FEW = ("--scenes", "4", "--steps", "12", "--videos", "0", "--engine", "native")


@pytest.fixture(autouse=True, scope="module")
def _quickly():
    with learning.quick_compiles():
        yield


def write_model(folder: Path, preset: str, world: SimulateConfig = WORLD) -> Path:
    """A run folder with few random weights, as `swarmnet train` leaves it."""
    config = learning.tiny("best")
    if preset != "best":
        config = replace(PRESETS[preset], edge_hidden=(8, 8), message=6, node_hidden=(8, 8))
    history, _, graph = learning.random_swarm(3, (1, 1, 3))
    params, scene = learning.initial(config, learning.scales(), history, graph, 3), WORLD.world().scene
    motion = Integrator(scene.dt, scene.substeps, scene.max_speed, scene.max_acceleration)
    data = {"expert": "boids", "scenes": 4, "simulate": plain(world)}
    about = {"preset": preset, "data": data, "train": plain(TrainConfig(model=preset))}
    checkpoints = Checkpoints(folder / "checkpoints")
    state = {"params": jax.tree.map(jax.numpy.asarray, params)}
    checkpoints.save(700, state, about | describe(config, learning.scales(), motion))
    checkpoints.close()
    return folder


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> Path:
    """A trained model."""
    return write_model(tmp_path_factory.mktemp("repair") / "given", "thesis-ch5-small")


@pytest.fixture(scope="module")
def repaired(given: Path) -> Path:
    """Its repair, without judging."""
    run = given.parent / "repaired"
    assert main(("repair", str(given), "--run", str(run), *SMALL)) == 0
    return run


@pytest.fixture
def copy(repaired: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(repaired, tmp_path / "copy"))


def bytes_of(folder: Path) -> dict[str, str]:
    """A fingerprint of every file."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def fails(capsys, *arguments: str) -> str:
    """Runs a command that must exit with 2 and one line on stderr; returns the line."""
    assert main(arguments) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("swarmnet: ")
    return line


def test_the_noise_of_the_training_world_is_in_the_rounds_too(tmp_path: Path, monkeypatch):
    """The same weights from the same starts: only the noise takes them elsewhere."""
    ends = []

    def stopped(model, how, bodies, perform, **_):
        ends.append(perform(model.params, 0).nodes)
        raise SwarmError("enough")

    monkeypatch.setattr(command, "repair", stopped)
    for number, noise in enumerate((0.0, 0.5)):
        run = write_model(tmp_path / f"given-{number}", "thesis-ch5-small", replace(WORLD, actuation_noise=noise))
        assert main(("repair", str(run), "--run", str(tmp_path / f"run-{number}"), *SMALL)) == 2
    quiet, noisy = ends
    np.testing.assert_array_equal(quiet[:, 0], noisy[:, 0])
    apart = np.linalg.norm(quiet[:, 1, -3:, :2] - noisy[:, 1, -3:, :2], axis=-1)
    # One control step moves a position by c * noise, c = dt^2 (k + 1) / 2k = 0.048 s^2.
    assert 0.5 * 0.048 < apart.mean() / 0.5 < 2 * 0.048


def test_from_one_end_to_the_other(given: Path, tmp_path: Path, capsys):
    before, run = bytes_of(given), tmp_path / "fixed"
    asked = ("repair", str(given), "--run", str(run), *SMALL[:-4], "--test-scenes", "4", "--videos", "0")
    assert main((*asked, "--engine", "native")) == 0
    told = capsys.readouterr().out
    for words in ("status: ", "training decisions that broke the barrier without need", "with 95% confidence at most"):
        assert words in told
    assert "this is evidence about scenes like these, no proof for others" in told
    assert bytes_of(given) == before
    old, new = load_model(given / "checkpoints"), load_model(run / "checkpoints")
    changed = jax.tree.map(lambda a, b: bool((np.asarray(a) != b).any()), old.params, new.params)
    assert not any(jax.tree.leaves(changed["edge"]["goal"]))  # not among the free weights
    assert any(jax.tree.leaves(changed))
    assert new.about["step"] == 700  # gradient steps of imitation
    assert new.about["repair"]["status"] in ("feasible", "elastic")
    document = json.loads((run / "repair.json").read_text())
    assert document["settings"]["rounds"] == 1
    assert [row["round"] for row in document["rounds"]][:2] == [0, 1]
    assert document["fresh"]["scenes"] == 8
    assert document["fresh"]["lost"] == 0
    assert document["verification"]["holds_as_executed"] == (document["verification"]["avoidable"] == 0)
    report = re.sub(r"<[^>]*>", "", (run / "report.html").read_text())
    for words in ("What is guaranteed", "64-bit arithmetic", "What is evidence", "What is not claimed"):
        assert words in report
    assert "trained for 700 gradient steps" in report
    assert "A repair then changed its weights so that the barrier holds" in report
    commands = [html.unescape(line) for line in re.findall(r"swarmnet repair .*", report)]
    again = [word for word in shlex.split(commands[0].split("  #")[0])]
    config, wanted = parse(again[1:]), parse((*asked, "--test-scenes", "1000", "--videos", "3", "--engine", "auto"))
    assert config == wanted
    judged = json.loads((run / "evaluation.json").read_text())
    assert judged["scenes"] == 4
    assert len(judged["collisions"]) == 2
    assert {path.name for path in (run / "figures").glob("repair_*")} == {"repair_pareto.svg", "repair_rounds.svg"}


def test_scenes_that_were_lost_at_the_start_are_named():
    v = Verification(
        rows=9, violated=0, avoidable=0, violated_before_clip=0, introduced=0, mended=0, worst=1.0, deviation=0.1
    )
    nobody = Situations(own=np.zeros((0, 4)), senders={}, present={})
    found = Repaired({}, Status.FEASIBLE, 0, v, nobody, 1.0, history=[{"contact_steps": 0.1}])
    fresh = {"scenes": 1000, "trajectories": 0.003, "contact_steps": 0.001}
    some, none = (command.words(found, LoopConfig(), fresh | {"lost": lost}) for lost in (2, 0))
    assert "3 scenes with a contact (2 of them lost at the start, whatever anybody does), so with 95%" in some
    assert "3 scenes with a contact, so with 95%" in none


def test_what_is_done_is_not_done_again(given: Path, repaired: Path, monkeypatch, capsys):
    before = bytes_of(repaired)
    monkeypatch.setattr(command, "repair", None)
    assert main(("repair", str(given), "--run", str(repaired), *SMALL)) == 0
    assert "was repaired already" in capsys.readouterr().out
    assert bytes_of(repaired) == before


@pytest.mark.parametrize(
    ("more", "said"),
    [(("--rounds", "2"), "holds another repair"), (("--constraint.margin", "1"), "holds another repair")],
)
def test_another_repair_in_the_same_folder_is_refused(more, said: str, given: Path, repaired: Path, capsys):
    before = bytes_of(repaired)
    assert said in fails(capsys, "repair", str(given), "--run", str(repaired), *SMALL, *more)
    assert bytes_of(repaired) == before


def test_no_model_is_overwritten(given: Path, tmp_path: Path, capsys):
    before = bytes_of(given)
    assert "another folder than the one of the model" in fails(
        capsys, "repair", str(given), "--run", str(given / ".." / given.name), *SMALL
    )
    other = Path(shutil.copytree(given, tmp_path / "other"))
    assert "holds a model that no repair made" in fails(capsys, "repair", str(given), "--run", str(other), *SMALL)
    assert bytes_of(given) == bytes_of(other) == before


def test_an_interrupted_repair_goes_on_to_the_same_weights(given: Path, repaired: Path, tmp_path, monkeypatch, capsys):
    run, make = tmp_path / "cut", command.make_perform
    asked = ("repair", str(given), "--run", str(run), *SMALL)

    def interrupted(*arguments, **options):
        perform = make(*arguments, **options)

        def cut(params, number):
            if number == 1:
                raise KeyboardInterrupt
            return perform(params, number)

        return cut

    monkeypatch.setattr(command, "make_perform", interrupted)
    assert main(asked) == 130
    assert "the same command goes on" in capsys.readouterr().err
    assert {path.name for path in run.iterdir()} == {"rounds", "settings.json"}
    kept = bytes_of(run)
    monkeypatch.setattr(command, "make_perform", make)
    assert main(asked) == 0
    assert kept.items() <= bytes_of(run).items()
    weights = [load_model(folder / "checkpoints").params for folder in (run, repaired)]
    jax.tree.map(np.testing.assert_array_equal, *weights)


def test_damaged_files_are_named(given: Path, copy: Path, capsys):
    (copy / "repair.json").write_text('{"status": "feas')
    assert "repair.json: is damaged; `swarmnet repair` writes it anew" in fails(capsys, "report", str(copy))
    assert main(("repair", str(given), "--run", str(copy), *SMALL)) == 0
    assert json.loads((copy / "repair.json").read_text())["status"] in ("feasible", "elastic")
    load_model(copy / "checkpoints")
    assert main(("report", str(copy))) == 0
    (copy / "settings.json").write_text("{")
    line = fails(capsys, "repair", str(given), "--run", str(copy), *SMALL)
    assert f"{copy / 'settings.json'}: is damaged" in line


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--free", "edge/ball/*"), "free: 'edge/ball/*' was given, allowed is a pattern that matches some of"),
        (("--polish", "psi/*"), "psi/*"),
        (("--engine", "steam"), "engine: 'steam' was given"),
        (("--num-agents", "0"), "num_agents: 0 was given"),
        (("--method", "thesis", "--layers", "nose"), "layers: 'nose' was given"),
    ],
)
def test_what_makes_no_sense_leaves_nothing_behind(more, said: str, given: Path, tmp_path: Path, capsys):
    run = tmp_path / "never"
    assert said in fails(capsys, "repair", str(given), "--run", str(run), *SMALL[:-2], *more)
    assert not run.exists()


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--method", "last-layer"), "allowed is disc with method last-layer"),
        (("--method", "thesis", "--constraint.name", "disc"), "barrier or polygon or diamond with method thesis"),
        (("--price", "nan"), "price: nan was given"),
        (("--rounds", "-1"), "rounds: -1 was given"),
    ],
)
def test_settings_that_do_not_go_together_end_before_anything_is_read(more, said: str, tmp_path: Path, capsys):
    with pytest.raises(SystemExit) as ended:
        main(("repair", str(tmp_path / "nobody"), "--run", str(tmp_path / "never"), *more))
    assert ended.value.code == 2
    assert said in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert not (tmp_path / "never").exists()


def test_a_network_that_cannot_be_encoded_is_refused_by_name(tmp_path: Path, capsys):
    best, run = write_model(tmp_path / "best", "best"), tmp_path / "never"
    assert "preset best cannot be repaired" in fails(capsys, "repair", str(best), "--run", str(run), *SMALL)
    assert "preset best cannot be repaired" in fails(capsys, "certify", str(best))
    assert not run.exists()
    assert not (best / "certificate.json").exists()


# --- certify ---


def test_certify_writes_both_files(copy: Path, capsys):
    code = main(("certify", str(copy), "--distance", "4", "--goal", "20", "0", "--cells", "300", "--examples", "20"))
    told = capsys.readouterr().out
    document = json.loads((copy / "certificate.json").read_text())
    shares = [document[name] for name in ("proven", "refuted", "undecided", "unavoidable")]
    assert sum(shares) == pytest.approx(1)
    found = unpacked(copy / "counter-examples.npz")
    assert len(found) == document["counter_examples"] <= 20
    assert code == (1 if len(found) else 0)
    assert f"{document['proven']:8.3%} proven" in told
    assert document["step"] == 700
    again = document.copy()
    assert (
        main(("certify", str(copy), "--distance", "4", "--goal", "20", "0", "--cells", "300", "--examples", "20"))
        == code
    )
    document = json.loads((copy / "certificate.json").read_text())
    again.pop("seconds"), document.pop("seconds")
    assert again == document


def test_counter_examples_of_a_certificate_go_back_into_a_repair(given: Path, repaired: Path, tmp_path: Path, capsys):
    wrong, again = Path(shutil.copytree(given, tmp_path / "wrong")), tmp_path / "again"
    main(("certify", str(wrong), "--distance", "4", "--goal", "20", "0", "--cells", "300", "--examples", "20"))
    file = wrong / "counter-examples.npz"
    assert len(unpacked(file)) > 0
    asked = ("repair", str(given), "--run", str(again), *SMALL, "--examples", str(file))
    assert main(asked) == 0
    rows, without = (json.loads((run / "repair.json").read_text()) for run in (again, repaired))
    assert rows["verification"]["rows"] > without["verification"]["rows"]
    file.write_text("damaged")
    assert "holds no counter-examples" in fails(capsys, *asked)


# --- the filter ---

PUSH = """
import jax.numpy as jnp
def push(state, params, key):
    away = state.obstacle[:, :1] - state.position
    return 5.0 * away / jnp.maximum(jnp.linalg.norm(away, axis=-1, keepdims=True), 1e-6)
"""


def test_the_filter_keeps_apart_who_is_pushed_together(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pushing.py").write_text(PUSH)
    asked = ("--policy", "pushing:push", "--reference", "pushing:push", "--preset", "clear", "--num-agents", "3")
    assert main(("evaluate", "r", *asked, "--num-obstacles", "1", "--filter", "barrier", *FEW, "--steps", "40")) == 0
    assert "pushing:push, filtered" in capsys.readouterr().out
    judged = json.loads((tmp_path / "r" / "evaluation.json").read_text())
    filtered, bare = judged["collisions"]["pushing:push, filtered"], judged["collisions"]["pushing:push"]
    assert bare["contact_steps_any"]["value"] > 0.05
    assert filtered["contact_steps_any"]["value"] < 0.2 * bare["contact_steps_any"]["value"]


def test_a_recording_cannot_be_filtered(tmp_path: Path, capsys):
    save(tmp_path / "some.h5", make_trajectories())
    line = fails(
        capsys, "evaluate", str(tmp_path / "r"), "--policy", str(tmp_path / "some.h5"), "--filter", "disc", *FEW
    )
    assert "filter: 'disc' was given, allowed is nothing beside" in line
    assert not (tmp_path / "r").exists()


# --- the page ---


def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs/repair.md").read_text(), re.DOTALL)
    assert len(blocks) >= 8
    scope: dict = {}
    for block in blocks:
        exec(compile(block, "docs/repair.md", "exec"), scope)
    assert "1440 decisions," in capsys.readouterr().out
    assert scope["checked"].rows == 4
    certificate = scope["certificate"]
    assert certificate.proven + certificate.refuted + certificate.undecided + certificate.unavoidable == pytest.approx(
        1
    )
