"""`swarmnet evaluate --data`: a model's prediction judged on recorded trajectories; `swarmnet learn`: all in one."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning import quick_training

from envs.importers import ImportConfig, import_files
from envs.importers.importing import holdout_path
from envs.storage import load, save
from envs.trajectories import AGENT
from gnn.checkpoint import load_model
from gnn.config import TrainConfig
from gnn.evaluate import constant_velocity, prediction_error
from gnn.ranges import figures_of
from gnn.train import train
from swarm_mjcf.errors import SwarmError
from swarmnet.commands import learn, probe
from swarmnet.commands.evaluate import run as evaluate
from swarmnet.config import Evaluate, Learn, Probe
from swarmnet.judge import Judgement, judge_recorded, training_world
from swarmnet.policies import Source, find_policy, model_source
from swarmnet.report import write_report

CONFIG = ImportConfig(unit="m", time_unit="s", holdout=0.5, segment=0.0)


def walkers(path: Path) -> Path:
    """Four runs of three people who turn slowly; they come and go at different times."""
    rng, rows = np.random.default_rng(0), []
    for run in range(4):
        for person in range(3):
            heading, x = rng.uniform(0, 6), rng.uniform(-2, 2, 2)
            for frame in range(rng.integers(0, 4), rng.integers(16, 20)):
                rows.append(f"{run},{0.2 * frame:.4g},{person},{x[0]:.6g},{x[1]:.6g}")
                heading += 0.1
                x = x + 0.2 * np.asarray([np.cos(heading), np.sin(heading)])
    path.write_text("run,t,id,x,y\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Iterator[Path]:
    """Imported walks with a hold-out, and a model of one state and one with a history, each trained for a moment."""
    with pytest.MonkeyPatch.context() as patch, quick_training():
        there = tmp_path_factory.mktemp("data")
        patch.chdir(there)
        import_files([walkers(there / "w.csv")], CONFIG, there / "w.h5", command="swarmnet import w.csv --out w.h5")
        data = load("w.h5")
        for model in ("thesis-ch5", "thesis-ch3"):
            config = TrainConfig(model=model, horizons=(1,), stage_steps=(2,), chunk=2, batch=4)
            train(config, data, there / model, validation=data)
        yield there


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


def judged(name: str, *, data: Path = Path("w_holdout.h5"), **about) -> Judgement:
    source = model_source(Path(name))
    assert source.model is not None
    source = replace(source, model=replace(source.model, about=source.model.about | about))
    return judge_recorded(source, data, Path("judged"))


@pytest.mark.parametrize("name", ["thesis-ch5", "thesis-ch3"])
def test_a_model_beside_the_baselines_with_or_without_a_history(name: str, here: Path):
    found = judged(name)
    held, window = load("w_holdout.h5"), {"thesis-ch5": 1, "thesis-ch3": 5}[name]
    assert list(found.prediction) == [f"swarmnet {name}", "constant velocity", "persistence"]
    expected = prediction_error(constant_velocity(0.2), {}, held, window=window)
    assert found.prediction["constant velocity"].ade == expected.ade
    assert expected.horizons == (1, 5, 10), "40 do not fit"
    assert (found.reference, found.collisions, found.worst, found.seed) == (None, {}, [], None)
    truth, predicted = (load(Path("judged") / "rollouts" / f"{k}.h5") for k in ("truth", "predicted"))
    assert truth.position.shape[1] == window + 10
    for what in ("position", "velocity", "mask"):
        np.testing.assert_array_equal(getattr(truth, what)[:, :window], getattr(predicted, what)[:, :window])
    throughout = truth.mask[:, :window].all(axis=1)
    np.testing.assert_array_equal(predicted.mask[:, window:], truth.mask[:, window:] & throughout[:, None])
    stays = (truth.mask & (truth.kind == AGENT)[:, None]).all(axis=1)
    assert stays.any(axis=1).all(), "somebody stays in each window that is shown"
    model = load_model(Path(name) / "checkpoints")
    assert model.config.window == window


def test_what_is_not_a_number_is_null_in_the_file(here: Path):
    found = judged("thesis-ch5")
    first = next(iter(found.prediction))
    broken = replace(found.prediction[first], ade=(float("nan"), float("inf"), 1.0))
    replace(found, prediction=found.prediction | {first: broken}).write(Path("judged"))
    text = (Path("judged") / "evaluation.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    assert json.loads(text)["prediction"][first]["ade"] == [None, None, 1.0]


def test_the_whole_command(here: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    shown = []
    monkeypatch.setattr("swarmnet.figures_recorded.make_video", lambda files, out, **how: shown.append((out, how)))
    assert evaluate(Evaluate(run=Path("thesis-ch5"), data=Path("w_holdout.h5"), videos=1, json=Path("e.json"))) == 0
    printed = capsys.readouterr().out
    for words in ("2 scenes of w_holdout.h5", "displacement of agents [m]", "1 steps  ADE / FDE", "report: thesis-ch5"):
        assert words in printed
    assert [out.name for out, _ in shown] == ["window-1.mp4"]
    document = json.loads((Path("thesis-ch5") / "evaluation.json").read_text())
    assert (document["data"], document["collisions"]) == ("w_holdout.h5", {})
    page = (Path("thesis-ch5") / "report.html").read_text()
    for words in (
        "judged by its prediction of 2 recorded scenes (w_holdout.h5)",
        "Displacement error [m]",
        "Predicted over recorded",
        "swarmnet import w.csv --out w.h5",
        "swarmnet evaluate thesis-ch5 --data w_holdout.h5",
    ):
        assert words in page
    assert "cannot steer agents" not in page
    assert "In closed loop" not in page
    rows = {(row["row"], row["column"]): row for row in json.loads(Path("e.json").read_text())["rows"]}
    assert rows["swarmnet thesis-ch5", "fde 10 steps"]["unit"] == "m"


def test_warnings_are_printed_and_in_the_report(here: Path, capsys):
    seen = figures_of(load("w.h5"))
    assert judged("thesis-ch5", range=seen).said == ()
    found = judged("thesis-ch5", range=seen | {"agents": [9.0] * 4})
    (line,) = found.said
    assert "trained on 9 (100% outside)" in line
    found.write(Path("judged"))
    assert line[1:] in write_report("judged").read_text()
    (own,) = judged("thesis-ch5", data=Path("w.h5")).said
    assert own == "w.h5 is what the model was trained on: its error says little about anybody else"


def test_what_cannot_be_judged_is_said(here: Path):
    held = load("w_holdout.h5")
    save("slow.h5", replace(held, dt=0.4))
    with pytest.raises(SwarmError, match=r"trained at dt 0.2 s .* has rows 0.4 s apart .* import .* --dt 0.2"):
        judged("thesis-ch5", data=Path("slow.h5"))
    kind = held.kind.copy()
    kind[:, 0] = 0
    save("goal.h5", replace(held, kind=kind))
    with pytest.raises(SwarmError, match=r"goal\.h5: has up to 1 goals, 0 obstacles and 2 agents, and the model"):
        judged("thesis-ch5", data=Path("goal.h5"))
    with pytest.raises(SwarmError, match="predicts nothing; --data needs a run folder with a trained model"):
        judge_recorded(find_policy("boids"), Path("w_holdout.h5"), Path("judged"))
    with pytest.raises(SwarmError, match=r"reference: 'none' was given.*nothing beside --data"):
        evaluate(Evaluate(run=Path("thesis-ch5"), data=Path("w_holdout.h5"), reference="none"))
    with pytest.raises(SwarmError, match=r"--data HOLDOUT.h5.*--preset"):
        training_world(load_model(Path("thesis-ch5") / "checkpoints"))


def test_learning_from_a_file_to_a_report(here: Path, monkeypatch: pytest.MonkeyPatch):
    seen: dict[str, object] = {}

    def trained(config: TrainConfig, data, run: Path, **more) -> None:
        seen.update(config=config, data=data, validation=more["validation"])

    def recorded(*given) -> Judgement:
        seen["judgement"] = judge_recorded(*given)
        return seen["judgement"]

    monkeypatch.setattr(learn, "train", trained)
    monkeypatch.setattr(learn, "model_source", lambda run: model_source(Path("thesis-ch5")))
    monkeypatch.setattr("swarmnet.commands.evaluate.write_report", lambda run: run)
    monkeypatch.setattr(learn, "judge_recorded", recorded)
    config = Learn(
        data=Path("w.h5"), run=Path("r"), model="thesis-ch5", horizons=(1, 3), stage_steps=(200, 100), scale=0.5,
        videos=0, json=Path("learned.json"),
    )  # fmt: skip
    assert learn.run(config) == 0
    rows = {(row["row"], row["column"]): row["value"] for row in json.loads(Path("learned.json").read_text())["rows"]}
    training, data, judgement = seen["config"], seen["data"], seen["judgement"]
    assert isinstance(training, TrainConfig)
    assert isinstance(judgement, Judgement)
    assert training.stage_steps == (100, 100)
    assert 4 <= training.batch <= 128
    assert data.position.shape[1] == 1 + 3  # pyright: ignore[reportAttributeAccessIssue]
    assert 1.0 < data.max_speed < 2.0, "half more than the 1 m/s of everybody"  # pyright: ignore[reportAttributeAccessIssue]
    assert judgement.data == "w_holdout.h5"
    assert rows["swarmnet thesis-ch5", "fde 10 steps"] == judgement.prediction["swarmnet thesis-ch5"].fde[-1]
    with pytest.raises(SwarmError, match=r"w_holdout_holdout.h5: does not exist; import with --holdout"):
        learn.run(Learn(data=holdout_path(Path("w.h5"))))


@pytest.mark.parametrize(("name", "window"), [("thesis-ch5", 1), ("thesis-ch3", 5)])
def test_a_probe_of_a_recording(name: str, window: int, here: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    held, drawn = load("w_holdout.h5"), {}
    assert len(held) == 2
    assert held.mask[0, 0].any(), "an import begins with the first row that somebody has a velocity in"
    assert not held.mask[0, 0].all(), "somebody comes later"
    monkeypatch.setattr(probe, "DRAWN", 2)
    figure = probe.contribution_figure
    monkeypatch.setattr(
        probe, "contribution_figure", lambda parts, **how: (drawn.update(how, parts=parts), figure(parts, **how))[1]
    )
    for old in Path(name).glob("figures/probe-*"):
        old.unlink()
    assert probe.run(Probe(run=Path(name), data=Path("w_holdout.h5"))) == 0
    printed = capsys.readouterr().out
    assert "no true laws, no linear probe, no figure 5.1: what law made these trajectories is not known" in printed
    assert "contributions: drawn for the first 2 of the 3 agents of scene 0" in printed
    assert json.loads((Path(name) / "probe.json").read_text())["scenes"] == 2
    for what in ("position", "velocity", "contributions"):
        assert "</svg>" in (Path(name) / "figures" / f"probe-{what}.svg").read_text()
    assert (drawn["agents"], drawn["first_row"]) == ((0, 1), window - 1)
    rows = held.mask.shape[1] - window + 1
    there = np.all([held.mask[0, k : k + rows] for k in range(window)], axis=0)
    assert set(drawn["parts"]) == {"nothing", "agent"}
    for part in drawn["parts"].values():
        np.testing.assert_array_equal(np.isfinite(part).all(axis=-1), there)
    assert there.any()
    assert not there.all()


def test_what_a_probe_of_a_recording_cannot_draw_is_said(here: Path, capsys):
    held = load("w_holdout.h5")
    short = held.mask & (np.arange(held.mask.shape[1]) < 4)[:, None]  # and the model sees 5
    save("short.h5", replace(held, mask=short))
    (Path("thesis-ch3") / "figures" / "probe-contributions.svg").unlink(missing_ok=True)
    assert probe.run(Probe(run=Path("thesis-ch3"), data=Path("short.h5"))) == 0
    said = "no contributions: no agent of scene 0 is there for as many rows as the model sees, 5\n"
    assert said in capsys.readouterr().out
    assert not (Path("thesis-ch3") / "figures" / "probe-contributions.svg").exists()
    kind = held.kind.copy()
    kind[:, 0] = 0
    save("goals.h5", replace(held, kind=kind))
    with pytest.raises(SwarmError, match=r"goals\.h5: has up to 1 goals, 0 obstacles and 2 agents, and the model"):
        probe.run(Probe(run=Path("thesis-ch5"), data=Path("goals.h5")))
    with pytest.raises(SwarmError, match=r"scenes: 0 was given.*at least 1"):
        probe.run(Probe(run=Path("thesis-ch5"), data=Path("w_holdout.h5"), scenes=0))


def test_a_probe_takes_the_recording_that_a_run_learned_from(here: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    model, named = load_model(Path("thesis-ch5") / "checkpoints"), Probe(run=Path("thesis-ch5"), scenes=1)
    with pytest.raises(SwarmError, match=r"--data HOLDOUT.h5"):
        probe.run(named)

    def learned(data: str) -> None:
        about = model.about | {"data": model.about["data"] | {"learn": {"data": data}}}
        monkeypatch.setattr(probe, "load_model", lambda folder: replace(model, about=about))

    learned("gone.h5")
    with pytest.raises(SwarmError, match=r"--data HOLDOUT.h5"):
        probe.run(named)
    learned("w.h5")
    assert probe.run(named) == 0
    assert "scenes of w.h5, which the model learned from" in capsys.readouterr().out
    assert json.loads((Path("thesis-ch5") / "probe.json").read_text())["scenes"] == 1


def test_predictions_that_scenes_are_too_short_for_are_not_learned():
    training = TrainConfig(horizons=(1, 5, 20), stage_steps=(300, 200, 100))
    assert learn.fitting(training, 20) == training
    assert learn.fitting(training, 19) == replace(training, horizons=(1, 5), stage_steps=(300, 200))
    assert learn.fitting(training, 0) == training, "what is too short for everything is refused by who cuts"


def test_training_and_validation_share_no_rows(here: Path):
    data = load("w.h5")
    scenes = data.take(np.arange(40) % len(data))
    first, last = learn.apart(scenes, 3)
    assert (len(first), len(last)) == (35, 2)
    assert learn.apart(data, 3) == (data, data)


def test_a_model_that_stored_no_range_says_nothing(here: Path):
    assert judged("thesis-ch3", range=None).said == ()
    assert Source(given="x", name="x").model is None
