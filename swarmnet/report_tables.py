"""Numbers and tables of the report, as HTML: what a run's evaluation.json holds of policy and reference."""

import json
from html import escape

from envs.collective import UNITS
from repair.verify import clopper_pearson
from rl.config import MODES
from swarm_mjcf.errors import SwarmError
from swarmnet.figures_rl import WINDOW, final_return, smoothed
from swarmnet.report_facts import Facts


def collision_cells(evaluation: dict | None) -> dict[str, str]:
    """Cells of each figure of the collision report by its name; the template has a row for each (tested)."""
    reports = (evaluation or {}).get("collisions")
    if not reports:
        return {}
    figures = dict.fromkeys(figure for report in reports.values() for figure in report)
    cells = {figure: "".join(_cell(report.get(figure)) for report in reports.values()) for figure in figures}
    return cells | {"collisions": "".join(f"<th>{escape(name)}</th>" for name in reports)}


def collective_table(evaluation: dict | None) -> dict[str, str]:
    """Collective motion, mean over time and at the end, for reference and policy."""
    reports = (evaluation or {}).get("collective")
    if not reports:
        return {}
    head = "".join(f"<th>{escape(name)}<br>{when}</th>" for name in reports for when in ("mean", "at the end"))
    rows = [
        f"<tr><th><code>{measure}</code></th>"
        + "".join(_cell(report.get(f"{measure}_{when}")) for report in reports.values() for when in ("mean", "final"))
        + "</tr>"
        for measure in UNITS
    ]
    return {"collective": f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(rows)}</tbody>"}


def worst_table(evaluation: dict | None) -> dict[str, str]:
    """The policy's worst scenes with their numbers, and where its contact log is."""
    e = evaluation or {}
    if not e.get("worst"):
        return {}
    rows = [
        f"<tr><td>{w['scene']}</td><td>{w['contact_steps']}</td><td>{number(w['deepest_penetration'])}&nbsp;m</td>"
        f"<td>{number(w['minimum_clearance'])}&nbsp;m</td></tr>"
        for w in e["worst"]
    ]
    return {"worst": "".join(rows), "contact_log": escape(e.get("contact_log") or "")}


def ppo_table(facts: Facts) -> dict[str, str]:
    """How PPO improved a model: what it started from, what stayed as it was, what it gained, and its settings."""
    about, ppo, rows = facts.about or {}, facts.ppo, facts.metrics
    if not ppo:
        return {}
    began = about.get("initial")
    start = "Started from random weights."
    if began:
        where = f" in <code>{escape(str(facts.origin))}</code>" if facts.origin else ""
        start = (
            f"Started from the imitation policy{where}: weights <code>{escape(began['weights'])}</code>, preset "
            f"<code>{escape(str(began.get('preset')))}</code> at step {began.get('step')}."
        )
    patterns = ", ".join(f"<code>{escape(pattern)}</code>" for pattern in ppo["freeze"])
    kept = f"{patterns} {'stay as they were' if patterns else 'nothing stays as it was'}".strip()
    gained = (
        f" Mean return of an episode: {number(smoothed(rows[:WINDOW])[-1])} in the first {min(WINDOW, len(rows))} "
        f"iterations, {number(final_return(rows))} in the last tenth of {len(rows)}."
        if rows
        else ""
    )
    known = {name: value for name, value in ppo.items() if value is not None and name != "freeze"}
    cells = "".join(
        f"<tr><th>{escape(name)}</th><td>{escape(plain_words(value))}</td></tr>" for name, value in known.items()
    )
    return {"improved": f"{start} {mode_of(ppo).capitalize()}: {kept}.{gained}", "ppo": f"<tbody>{cells}</tbody>"}


def repair_table(facts: Facts) -> dict[str, str]:
    """What a repair guarantees, in plain words, and each of its rounds."""
    path = facts.run / "repair.json"
    if not path.exists():
        return {}
    try:
        found = json.loads(path.read_text())
        rounds, v, how = found["rounds"], found["verification"], found["settings"]
        rule = how["constraint"]
        # The best round was chosen by its own scenes: what it is worth is for others to say.
        judged = found.get("fresh") or next(row for row in rounds if row["round"] == found["best_round"])
    except (ValueError, KeyError, TypeError, StopIteration) as error:
        raise SwarmError(f"{path}: is damaged; `swarmnet repair` writes it anew") from error
    left = v["avoidable"]
    once = how.get("method") in ("thesis", "last-layer")  # these take states whatever was decided there
    which = "could keep it" if once else "broke it without need while the policy was repaired"
    hold = "all of them keep it" if not left else f"{left} of them still break it"
    touched = round(judged["trajectories"] * judged["scenes"])
    _, most = clopper_pearson(touched, judged["scenes"])
    free = ", ".join(f"<code>{escape(pattern)}</code>" for pattern in how["free"])
    words = (
        f"Only {free} were changed, so that the {escape(rule['name'])} (margin {rule['margin']:g} m, "
        f"{100 * rule['share']:g}% of the brakes) holds. <b>What is guaranteed:</b> of {v['rows']} decisions that "
        f"{which}, {hold} now, checked in 64-bit arithmetic with the saved "
        "weights, limits and integrator. <b>What is evidence:</b> in "
        f"{judged['scenes']} scenes that it did not learn from, {touched} had a contact; with 95% confidence at most "
        f"{100 * most:.2g}% of scenes like these have one. <b>What is not claimed:</b> anything about other scenes. "
        f"Status: {escape(found['status'])}."
    )
    columns = {
        "round": ("round", 1), "contact_steps": ("contact steps [%]", 100),
        "contact_steps_agent": ("of agents [%]", 100), "contact_steps_obstacle": ("of obstacles [%]", 100),
        "trajectories": ("scenes with one [%]", 100),
        "avoidable": ("avoidable violations [% of decisions]", 100), "goal_distance": ("goal distance [m]", 1),
        "changed": ("change of actions [m/s²]", 1),
    }  # fmt: skip
    shown = {key: value for key, value in columns.items() if key in rounds[0]}
    head = "".join(f"<th>{title}</th>" for title, _ in shown.values())
    body = "".join(
        "<tr>" + "".join(f"<td>{number(factor * row[key])}</td>" for key, (_, factor) in shown.items()) + "</tr>"
        for row in rounds
    )
    return {"repaired": words, "repair": f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>"}


def mode_of(ppo: dict) -> str:
    """`mode 1`, or `no mode` for any other set of frozen parts."""
    return next((f"mode {mode}" for mode, kept in MODES.items() if list(kept) == list(ppo["freeze"])), "no mode")


def prediction_tables(evaluation: dict | None, model: str) -> dict[str, str]:
    """Prediction error in both normalisations and in metres; the row `model` stands out."""
    e = evaluation
    if not e or not e["prediction"]:
        return {}
    rows = e["prediction"]
    what = f"{e['scenes']} scenes of {escape(e['data'])}" if e.get("data") else f"{e['scenes']} unseen scenes"
    metres = all("ade" in row for row in rows.values())  # older evaluations have none
    return {
        "prediction": _error_table(rows, ("published_mean", "published_median", "windows"), model),
        "prediction_agents": _error_table(rows, ("agents_mean", "agents_median", "windows"), model),
        "displacement": _error_table(rows, ("ade", "fde", "paths"), model) if metres else "",
        "prediction_of": f"dt = {e['dt']:g} s, {what}",
    }


def _error_table(rows: dict[str, dict], columns: tuple[str, str, str], model: str) -> str:
    """A row for each predictor, a column for each horizon; two figures to a cell, their number of cases below."""
    horizons, (large, small, cases) = rows[model]["horizons"], columns
    head = "".join(f"<th>{h} step{'s' * (h > 1)}</th>" for h in horizons)
    lines = []
    for name, error in rows.items():
        pairs = zip(error[large], error[small], strict=True)
        cells = "".join(f"<td>{number(one)}<br><small>{number(other)}</small></td>" for one, other in pairs)
        kind = ' class="model"' if name == model else ""
        lines.append(f"<tr{kind}><th>{escape(name)}</th>{cells}</tr>")
    counted = "".join(f"<td><small>{count}</small></td>" for count in rows[model][cases])
    lines.append(f"<tr><td><small>{cases}</small></td>{counted}</tr>")
    table = f"<thead><tr><th></th>{head}</tr></thead><tbody>{''.join(lines)}</tbody>"
    return f'<div class="table"><table>{table}</table></div>'


def _cell(estimate: dict | None) -> str:
    return "<td></td>" if estimate is None else f"<td>{shown(estimate, interval=False)}<br>{interval_of(estimate)}</td>"


def number(value: float | int | None) -> str:
    """Three significant digits; a dash for what is not a number."""
    if value is None or value != value:
        return "–"
    if 1000 <= abs(value) < 1e6 or value == 0:
        return f"{value:.0f}"
    return f"{value:#.3g}".removesuffix(".") if abs(value) >= 1 else f"{value:.3g}"


def plain_words(value: object) -> str:
    """A setting as people write it."""
    if isinstance(value, list | tuple):
        return ", ".join(plain_words(item) for item in value) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def shown(estimate: dict, *, interval: bool = True) -> str:
    """An estimate as HTML: value, unit and, if wanted, interval."""
    share = estimate["unit"] == "share"
    value = number(None if estimate["value"] is None else estimate["value"] * (100 if share else 1))
    words = f"{value}&nbsp;{'%' if share else escape(estimate['unit'])}".removesuffix("&nbsp;")
    return f"{words} {interval_of(estimate)}".strip() if interval else words


def interval_of(estimate: dict) -> str:
    """The interval as HTML; nothing for an extreme."""
    if estimate["low"] is None or estimate["high"] is None:
        return ""
    scale = 100 if estimate["unit"] == "share" else 1
    return f"<span class=range>[{number(estimate['low'] * scale)}, {number(estimate['high'] * scale)}]</span>"
