"""TrajNet++ ndjson: a JSON object per line, `{"scene": {..., "fps": 2.5}}` or `{"track": {"f", "p", "x", "y"}}`."""

import json
from pathlib import Path

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.text import lines_of
from envs.importers.tracks import ImportFailed, Tracks, Update, frame_rate, height_fact, length, tracks_of


def read(path: Path, config: ImportConfig, update: Update) -> list[Tracks]:
    """One run: all tracks once, whatever scenes share them. Rows with a `prediction_number` are somebody's guesses.

    Positions are metres by the format's definition. `fps` counts annotated frames, whose numbers may advance by more
    than 1 (those of the video): the step is the usual one, the median over people's rows.
    """
    rows: list[tuple[float, float, float, float, float]] = []
    rates: set[float] = set()
    predicted = scenes = high = 0
    for number, line in enumerate(lines_of(path, update), 1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            if "scene" in entry:
                scenes += 1
                if (rate := entry["scene"].get("fps")) is not None:
                    rates.add(float(rate))
            elif "track" in entry:
                track = entry["track"]
                if any(track.get(key) is not None for key in ("prediction_number", "pred_number")):
                    predicted += 1
                    continue
                high += "z" in track
                rows.append((track["f"], track["p"], track["x"], track["y"], track.get("z", np.nan)))
            else:
                raise KeyError("scene or track")
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise ImportFailed(
                f"{path}: line {number} is neither a scene nor a track with f, p, x and y ({error})"
            ) from error
    if len(rates) > 1:
        raise ImportFailed(f"{path}: its scenes name several frame rates: {', '.join(f'{r:g}' for r in sorted(rates))}")
    if not rows:
        raise ImportFailed(f"{path}: no rows of data (tracks)")
    try:
        table = np.asarray(rows, np.float64)
    except (ValueError, TypeError) as error:
        raise ImportFailed(f"{path}: a track has f, p, x, y or z that is no number") from error
    step = _usual_step(table)
    rate, rate_fact = frame_rate(str(path), config, rates.pop() if rates else None, where="scene lines")
    scale, unit = length(str(path), config, "m", where="format")
    facts = {
        "format": "TrajNet++",
        "unit": unit,
        "frame rate": f"{rate_fact}, frame numbers advance by {step:g}",
        "scenes of the file": str(scenes),
        "prediction rows": f"{predicted} left out",
    }
    if high:
        facts["z"] = height_fact(str(path), table[:, 4] * scale, table[:, 1])
    position = table[:, 2:4] * scale
    return [tracks_of(path.name, time=table[:, 0] / (step * rate), id=table[:, 1], position=position, facts=facts)]


def _usual_step(table: np.ndarray) -> float:
    """Median difference of the frame numbers of a person's rows; 1 where nobody has two."""
    order = np.lexsort((table[:, 0], table[:, 1]))
    steps = np.diff(table[order, 0])[np.diff(table[order, 1]) == 0]
    step = float(np.median(steps)) if len(steps) else 1.0
    return step if step > 0 else 1.0
