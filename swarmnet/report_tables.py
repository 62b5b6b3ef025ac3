"""Numbers and tables of the report, as HTML: what a run's evaluation.json holds of policy and reference."""

from html import escape

from envs.collective import UNITS


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


def _cell(estimate: dict | None) -> str:
    return "<td></td>" if estimate is None else f"<td>{shown(estimate, interval=False)}<br>{interval_of(estimate)}</td>"


def number(value: float | int | None) -> str:
    """Three significant digits; a dash for what is not a number."""
    if value is None or value != value:
        return "–"
    if 1000 <= abs(value) < 1e6 or value == 0:
        return f"{value:.0f}"
    return f"{value:#.3g}".removesuffix(".") if abs(value) >= 1 else f"{value:.3g}"


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
