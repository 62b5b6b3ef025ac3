"""RUN/report.html: one self-contained page of what a run folder holds. Its fixed words are in report.html."""

import base64
import json
import mimetypes
import platform
import re
import shlex
from dataclasses import fields, replace
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from envs.config import RewardConfig
from envs.plain import plain
from envs.trajectories import versions
from gnn.config import TrainConfig
from repair.config import LoopConfig
from swarm_mjcf.errors import SwarmError
from swarmnet.config import RL
from swarmnet.figures import FigureFile, make_figures
from swarmnet.figures_collective import make_collective_figures
from swarmnet.figures_recorded import make_recorded_figures
from swarmnet.figures_repair import make_repair_figures
from swarmnet.figures_rl import make_rl_figures
from swarmnet.report_commands import commands, render_command, two_recordings
from swarmnet.report_facts import Facts, gather
from swarmnet.report_tables import (
    collective_table,
    collision_cells,
    interval_of,
    mode_of,
    number,
    plain_words,
    ppo_table,
    prediction_tables,
    repair_table,
    shown,
    worst_table,
)
from swarmnet.results import commit, hardware, write_whole
from swarmnet.videos import VideoFile, find_videos

_FIGURES = (make_repair_figures, make_rl_figures, make_figures, make_collective_figures, make_recorded_figures)


def write_report(run: str | Path) -> Path:
    """Writes RUN/report.html from whatever is there, with the figures renewed; names the commands that make the rest.

    Raises:
      SwarmError: there is no such folder, or a file in it cannot be read or written.
    """
    run = Path(run)
    if not run.is_dir():
        raise SwarmError(f"{run}: no such run folder; `swarmnet demo` makes one")
    facts = gather(run)
    page = _filled(
        {
            "title": escape(f"Run {run.resolve().name}"),
            "run": escape(shlex.quote(str(run))),
            "css": resources.files("swarmnet").joinpath("report.css").read_text(encoding="utf-8"),
            "lead": _lead(facts),
            "tiles": _tiles(facts),
            **_missing(facts),
            "figures": "".join(_figure(figure) for make in _FIGURES for figure in make(run)),
            "windows" if facts.recorded else "videos": "".join(
                _video(video, first=not k) for k, video in enumerate(find_videos(run))
            ),
            **ppo_table(facts),
            **repair_table(facts),
            **prediction_tables(facts.evaluation, facts.model),
            **collision_cells(facts.evaluation),
            **collective_table(facts.evaluation),
            **worst_table(facts.evaluation),
            "settings": _settings(facts),
            "again": "\n".join(f"{escape(line)}  <i># {escape(why)}</i>" for line, why in _again(facts)),
            **_notes(facts),
        }
    )
    write_whole(run / "report.html", page)
    return run / "report.html"


def _filled(values: dict[str, str]) -> str:
    """The template with its values; sections, rows and items whose id has none are left out."""
    text = resources.files("swarmnet").joinpath("report.html").read_text(encoding="utf-8")
    for tag in ("section", "tr", "li"):
        blocks = re.compile(rf'<{tag} id="(\w+)">.*?</{tag}>\n', re.DOTALL)
        text = blocks.sub(lambda block: block[0] if values.get(block[1]) else "", text)
    return Template(text).substitute(values)


def _lead(facts: Facts) -> str:
    """One paragraph in plain words."""
    said = []
    if facts.about:
        name = f"A SwarmNet (preset <code>{escape(facts.about['preset'])}</code>)"
        said.append(f"{name} {_watched(facts) if facts.imitation else 'began with random weights'}.")
    if facts.about and facts.ppo:
        steps = f", {facts.metrics[-1]['env_steps']:.0f} env-steps" if facts.metrics else ""
        said.append(
            f"PPO then improved it in {facts.about['step']} iterations{steps}{_minutes(facts)} ({mode_of(facts.ppo)})."
        )
    if facts.repair:
        said.append(
            f"A repair then changed its weights so that the {escape(facts.repair['settings']['constraint']['name'])} "
            "holds; what that guarantees stands below."
        )
    if facts.evaluation:
        e, (_, obstacles, agents) = facts.evaluation, facts.counts or (0, 0, 0)
        crowd = f", {agents} agent{'s' * (agents != 1)} and {obstacles} obstacle{'s' * (obstacles != 1)} in each"
        rows, who = e["prediction"], _who(facts.reference)
        recorded = str(e.get("given", {}).get("policy")).endswith(".h5")
        judged = f"judged on {e['scenes']} scenes that it had never seen (seed {e['seed']})"
        judged = f"replayed from recorded positions of {e['scenes']} scenes" if recorded else judged
        if facts.recorded:
            judged = f"judged by its prediction of {e['scenes']} recorded scenes ({escape(facts.recorded)})"
        said.append(
            f"{'It' if rows else _who(facts.model)} was {judged}, {e['steps']} {'' if facts.recorded else 'control '}"
            f"steps of {e['dt']:g} s each{crowd if agents else ''}."
        )
        if both := facts.pair("final_goal_distance"):
            said.append(
                f"{'It' if recorded else 'Steering the agents itself in MuJoCo, it'} ends {shown(both[0])} from the "
                f"goal on average; {who}, from the same starts, {shown(both[1])}{_overlap(*both, who)}."
            )
        if both := facts.pair("contact_steps_any"):
            said.append(
                f"Something touches in {shown(both[0])} of its control steps, in {shown(both[1])} of those of {who}"
                f"{_overlap(*both, who)}."
            )
        first, *others = rows or [""]
        near = [h for h in (5, 40) if rows and h in rows[first]["horizons"]]
        if near:
            parts = [
                f"{number(_error(rows[first], h))} at {h} steps ("
                + ", ".join(f"{escape(name)} {number(_error(rows[name], h))}" for name in others) + ")"
                for h in near
            ]  # fmt: skip
            said.append("Predicting without ever being corrected, its normalized error is " + " and ".join(parts) + ".")
        if facts.recorded:
            ends = [f"{number(row['fde'][-1])} m ({escape(name)})" for name, row in rows.items()]
            seconds = rows[first]["horizons"][-1] * e["dt"]
            said.append(f"After {seconds:.3g} s it is {ends[0]} off on average; {' and '.join(ends[1:])}.")
    return " ".join(said) or "This folder holds no trained model and no evaluation yet."


def _watched(facts: Facts) -> str:
    """What was imitated."""
    about = facts.imitation or {}
    data, horizons = about["data"], about["train"]["horizons"]
    source = f"the {data['expert'].title()} expert" if "expert" in data else "recorded agents"
    world = f" in the world <code>{escape(str(data['simulate']['preset']))}</code>" if "simulate" in data else ""
    return (
        f"watched {data['scenes']} scenes of {escape(source)}{world} and was trained for {about['step']} gradient "
        f"steps{'' if facts.ppo else _minutes(facts)}, on predictions of up to {max(horizons)} steps"
    )


def _minutes(facts: Facts) -> str:
    """Time spent in gradient steps and validation, or in iterations of PPO, from the metrics."""
    if facts.ppo:
        seconds = facts.metrics[-1]["spent"] if facts.metrics else 0.0
    else:
        before = [0, *(row["step"] for row in facts.metrics)]
        seconds = sum((r["step"] - b) / r["steps_per_second"] for b, r in zip(before, facts.metrics, strict=False))
    return f" ({seconds / 60:.1f} minutes)" if seconds >= 60 else f" ({seconds:.0f} seconds)" if seconds else ""


def _who(name: str) -> str:
    return "the expert" if name == "expert" else f"<code>{escape(name)}</code>"


def _overlap(one: dict, other: dict, who: str) -> str:
    if None in (one["low"], one["high"], other["low"], other["high"]):
        return ""
    if one["low"] <= other["high"] and other["low"] <= one["high"]:
        return " (the 95% intervals overlap)"
    return f" (the 95% intervals are apart: {'more' if one['low'] > other['high'] else 'less'} than {who})"


def _tiles(facts: Facts) -> str:
    """The key numbers, large."""
    tiles = []

    def tile(label: str, value: str, beside: str) -> None:
        tiles.append(f'<div class="tile"><span>{label}</span><b>{value}</b><small>{beside}</small></div>')

    labels = {
        "final_goal_distance": "Distance to the goal at the end",
        "contact_steps_any": "Control steps with a contact",
    }
    for figure, label in labels.items():
        if both := facts.pair(figure):
            who = escape(facts.reference)
            tile(label, shown(both[0], interval=False), f"policy, {interval_of(both[0])}<br>{who} {shown(both[1])}")
    if rows := (facts.evaluation or {}).get("prediction"):
        name, *others = rows
        for horizon in (5, 40):
            if horizon in rows[name]["horizons"]:
                beside = "<br>".join(f"{escape(other)} {number(_error(rows[other], horizon))}" for other in others)
                label = f"Prediction error, {horizon} steps"
                tile(label, number(_error(rows[name], horizon)), beside)
        if facts.recorded:
            beside = "<br>".join(f"{escape(other)} {number(rows[other]['fde'][-1])} m" for other in others)
            seconds = rows[name]["horizons"][-1] * (facts.evaluation or {})["dt"]
            tile(f"Displacement after {seconds:.3g} s", f"{number(rows[name]['fde'][-1])} m", beside)
    return "".join(tiles)


def _missing(facts: Facts) -> dict[str, str]:
    """What is not there and could be."""
    steered = two_recordings(facts.run)
    found = {
        "no_model": "" if facts.about or (facts.evaluation and not facts.evaluation["prediction"]) else "yes",
        "no_evaluation": "" if facts.evaluation else "yes",
        "no_videos": escape(render_command(facts.run)) if steered and not find_videos(facts.run) else "",
    }
    return found | {"missing": "".join(found.values())}


def _video(video: VideoFile, *, first: bool) -> str:
    """A video in the page; the first one plays by itself, silently."""
    source, title = _data_uri(video.path), escape(video.title)
    if video.path.suffix == ".gif":
        picture = f'<img src="{source}" alt="{title}">'
    else:
        poster = f' poster="{_data_uri(video.poster)}"' if video.poster else ""
        options = f'controls muted loop playsinline{" autoplay" if first else ""} preload="metadata"{poster}'
        picture = f'<video {options} aria-label="{title}"><source src="{source}" type="video/mp4"></video>'
    return f"<figure>{picture}<figcaption>{title}</figcaption></figure>"


def _figure(figure: FigureFile) -> str:
    """A figure in the page, in the shape for the screen's width."""
    small = f'<source media="(max-width: 760px)" srcset="{_data_uri(figure.narrow)}">' if figure.narrow else ""
    image = f'<picture>{small}<img src="{_data_uri(figure.path)}" alt="{escape(figure.title)}"></picture>'
    parts = escape(figure.caption).split("`")
    caption = "".join(f"<code>{part}</code>" if number % 2 else part for number, part in enumerate(parts))
    kind = "plot wide" if figure.narrow else "plot"
    return f'<figure class="{kind}"><h3>{escape(figure.title)}</h3>{image}<figcaption>{caption}</figcaption></figure>'


def _settings(facts: Facts) -> str:
    """Everything that was set, as cards that open."""
    e, about, imitation = facts.evaluation or {}, facts.about or {}, facts.imitation or {}
    data = about.get("data", {})
    world = data.get("world", {})
    judged = {key: e.get(key) for key in ("data", "preset", "engine", "scenes", "steps", "dt", "seed", "contacts")}
    counts = dict(zip(("goals", "obstacles", "agents"), facts.counts or (), strict=False))
    software = {"commit": e.get("commit") or commit(), "python": platform.python_version()}
    cards: dict[str, dict[str, Any]] = {
        "Training data": {"scenes trained on": data.get("scenes"), "expert": data.get("expert")}
        | data.get("simulate", {}),
        "World: scene": world.get("scene", {}),
        "World: expert and start": world.get("expert", {}) | world.get("spawn", {}),
        "Model": {"preset": about.get("preset")} | about.get("model", {}),
        "Imitation" if facts.ppo else "Training": {"steps done": imitation.get("step")} | imitation.get("train", {}),
        "PPO: reward": about.get("reward", {}),
        "PPO: scenes": {key: about.get("task", {}).get(key) for key in ("horizon", "terminate_on_contact", "engine")},
        "Evaluation": judged | counts,
        "Software": software | (e.get("versions") or data.get("versions") or versions()),
        "Hardware" + ("" if "hardware" in e else " that wrote this page"): e.get("hardware") or hardware(),
    }
    shown = []
    for title, values in cards.items():
        known = {k: v for k, v in values.items() if v is not None}
        items = "".join(f"<dt>{escape(k)}</dt><dd>{escape(plain_words(v))}</dd>" for k, v in known.items())
        if items:
            shown.append(f'<details class="card"><summary>{escape(title)}</summary><dl>{items}</dl></details>')
    return "".join(shown)


def _again(facts: Facts) -> list[tuple[str, str]]:
    """The commands; before PPO or a repair come those of the run that it started from."""
    lines, data = commands(facts), ("simulate", "train", "demo", "import", "learn")
    if not (facts.ppo or facts.repair):
        return lines
    begun = facts.origin or facts.run.with_name(f"{facts.run.name}-imitation")
    before = commands(
        replace(facts, run=begun, about=facts.imitation or facts.about, evaluation=None, metrics=[], demo=None)
    )
    return [
        *(line for line in before if line[0].split()[1] in data),
        (_repair_command(facts, begun), "repair") if facts.repair else (_rl_command(facts, begun), "PPO"),
        *(line for line in lines if line[0].split()[1] not in data),
    ]


def _repair_command(facts: Facts, begun: Path) -> str:
    """The command that repairs the model of `begun` in this way."""
    words = ["swarmnet", "repair", str(begun), "--run", str(facts.run)]
    given, usual = flat((facts.repair or {})["settings"]), flat(plain(LoopConfig()))
    told = facts.run / "settings.json"
    if told.exists():
        given |= {name: value for name, value in json.loads(told.read_text()).items() if name not in ("settings", "of")}
    for name, value in given.items():
        if value == usual.get(name) or value is None:
            continue
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        elif value != [] or usual.get(name):  # an empty list where the usual one is not: the flag alone
            words += [f"--{flag}", *map(str, value if isinstance(value, list) else [value])]
    return shlex.join(words)


def flat(settings: dict, before: str = "") -> dict:
    """Settings of settings as one level, `descent.steps`; tuples as lists, as JSON has them."""
    found = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            found |= flat(value, f"{before}{name}.")
        else:
            found[before + name] = list(value) if isinstance(value, tuple) else value
    return found


def _rl_command(facts: Facts, begun: Path) -> str:
    """The command that improves the model of `begun` in this way."""
    about, ppo = facts.about or {}, facts.ppo or {}
    words = ["swarmnet", "rl", str(begun), "--run", str(facts.run), "--iterations", str(about["step"])]
    words += [] if about.get("initial") else ["--scratch"]
    mode = mode_of(ppo).removeprefix("mode ")
    words += ["--mode", mode] if mode.isdigit() else ["--freeze", *ppo["freeze"]]
    usual = {field.name: field.default for field in fields(RL)}
    usual |= {f"reward.{name}": value for name, value in plain(RewardConfig()).items()}
    given = ppo | {name: about["task"][name] for name in ("horizon", "terminate_on_contact")}
    given |= {f"reward.{name}": value for name, value in about["reward"].items()}
    for name, value in given.items():
        if name != "freeze" and value is not None and value != usual.get(name):
            words += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    return shlex.join(words)


def _notes(facts: Facts) -> dict[str, str]:
    """Which of the template's notes hold, with their numbers."""
    e, about = facts.evaluation, None if facts.ppo else facts.about
    planned = sum(about["train"]["stage_steps"]) if about else 0
    full = TrainConfig().steps
    found = {
        "note_said": escape(" ".join(f"{line[:1].upper()}{line[1:]}." for line in (e or {}).get("said") or ())),
        "note_contacts_off": e and not e.get("contacts", True) and not facts.recorded,
        "note_cannot_steer": e and not e.get("collisions") and not facts.recorded,
        "note_one_seed": e and e["prediction"],
        "note_open_loop": e and e["prediction"] and e.get("collisions"),
        "note_unfinished": f"{about['step']} of {planned}" if about and about["step"] < planned else "",
        "note_short": f"{planned / full:.0%} of the full {full}" if planned and planned < full else "",
    }
    words = {name: value if isinstance(value, str) else "yes" if value else "" for name, value in found.items()}
    return words | {"notes": "".join(words.values())}


def _error(row: dict, horizon: int) -> float | None:
    """The published mean at a horizon."""
    return row["published_mean"][row["horizons"].index(horizon)] if horizon in row["horizons"] else None


def _data_uri(path: Path) -> str:
    kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"
