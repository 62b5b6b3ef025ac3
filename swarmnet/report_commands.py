"""The commands that make again what a report shows."""

import shlex
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from swarmnet.config import Demo, Evaluate, Learn, Simulate, Train
from swarmnet.report_facts import Facts


def commands(facts: Facts) -> list[tuple[str, str]]:
    """(command, what it makes) for everything on the page, in order; all of them parse."""
    run, about, e = facts.run, facts.about or {}, facts.evaluation
    data = run / "data.h5"
    found = []
    if facts.demo and {"name", "scenes", "test_scenes"} <= set(facts.demo):
        known = {k: v for k, v in facts.demo.items() if k != "videos"}
        found.append((["swarmnet", "demo", *_flags(Demo, known)], "everything on this page"))
    elif "simulate" in about.get("data", {}):
        simulated = {k: v for k, v in about["data"]["simulate"].items() if k not in ("threads", "chunk")}
        found.append((["swarmnet", "simulate", *_flags(Simulate, simulated | {"out": data})], "training data"))
        all_scenes, kept = simulated["scenes"], simulated["scenes"] - about["data"]["scenes"]
        train: dict[str, Any] = about["train"] | {"run": run}
        if 0 < kept < all_scenes and kept != max(1, round(0.05 * all_scenes)):
            train["validation"] = kept / all_scenes
        about_it = "model and learning curves"
        if about.get("initial"):
            train["freeze"] = about.get("freeze") or ()
            about_it += "; tuned: add --init with the run that it began from"
        found.append((["swarmnet", "train", str(data), *_flags(Train, train)], about_it))
    elif command := about.get("data", {}).get("import", {}).get("command"):
        found.append((shlex.split(command), "training data"))
        if learned := about["data"].get("learn"):
            given = about["train"] | {"run": run}
            found.append((["swarmnet", "learn", learned["data"], *_flags(Learn, given)], "all else on this page"))
    if e and facts.recorded:
        judged = {"data": facts.recorded} | {k: v for k, v in _given(facts).items() if k != "reference"}
        found.append((["swarmnet", "evaluate", str(run), *_flags(Evaluate, judged)], "tables, figures, videos"))
    elif e:
        judged = {
            key: e[key] for key in ("scenes", "steps", "seed", "preset", "nearest", "radius") if key in e
        } | _given(facts)
        if e.get("preset") == about.get("data", {}).get("simulate", {}).get("preset"):
            judged.pop("preset", None)  # the model's training world, whatever else was set there
        elif facts.counts and judged.get("preset"):
            judged |= dict(zip(("num_obstacles", "num_agents"), facts.counts[1:], strict=True))
        judged |= e.get("asked", {})
        found.append((["swarmnet", "evaluate", str(run), *_flags(Evaluate, judged)], "rollouts, tables, figures"))
    found.append((["swarmnet", "report", str(run)], "this page and figures/"))
    lines = [(shlex.join(words), comment) for words, comment in found]
    return [*lines, (render_command(run), "one video")] if two_recordings(run) else lines


def two_recordings(run: Path) -> bool:
    """Whether reference and policy were recorded."""
    return all((run / "rollouts" / f"{name}.h5").exists() for name in ("expert", "learned"))


def _given(facts: Facts) -> dict[str, str]:
    """Policy and reference as they were named; a run's own model needs no name."""
    given = (facts.evaluation or {}).get("given")
    if not given:
        return {}
    named = {"reference": given["reference"] or "none"}
    own = facts.evaluation and facts.evaluation["prediction"] and Path(given["policy"]).resolve() == facts.run.resolve()
    return named if own else named | {"policy": given["policy"]}


def render_command(run: Path) -> str:
    """The command for a video of scene 0."""
    rollouts = run / "rollouts"
    words = ["swarmnet", "render", str(rollouts / "expert.h5"), str(rollouts / "learned.h5")]
    return shlex.join([*words, "--scene", "0", "--out", str(run / "videos" / "mine.mp4")])


def _flags(kind: type, values: dict[str, Any]) -> list[str]:
    """Command-line flags for the values that differ from a configuration's defaults; None means the default."""
    words: list[str] = []
    for field in fields(kind):
        value = values.get(field.name)
        value = tuple(value) if isinstance(value, list) else value
        if value is None or field.default is MISSING or value == field.default:
            continue
        flag = field.name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", *(str(item) for item in (value if isinstance(value, tuple) else (value,)))]
    return words
