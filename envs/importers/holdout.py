"""What is kept out of training: whole runs, or people, or the last part in time; never single frames."""

from collections.abc import Sequence

import numpy as np

from envs.importers.config import ImportConfig
from envs.importers.samples import Samples
from envs.importers.tracks import ImportFailed
from swarm_mjcf.errors import SpecError


def held_out(runs: Sequence[Samples], config: ImportConfig) -> tuple[list[Samples], list[Samples], str]:
    """Training runs, held-out runs, and how they were divided, in words.

    By people: the held-out are the agents of a run who leave last. They are taken out of the training runs, and their
    own file begins when everybody else has left, so its scenes are complete and nobody in them was ever trained on.

    Raises ImportFailed (or SpecError for a share of runs that leaves none) when nothing would be left on either side.
    """
    if not config.holdout:
        return list(runs), [], "nothing held out"
    by = config.holdout_by
    if by == "auto":
        by = "run" if len(runs) > 1 else "people"
    if by == "run":
        kept = max(1, round(config.holdout * len(runs)))
        if kept >= len(runs):
            raise SpecError("holdout", config.holdout, f"a share that leaves some of {len(runs)} runs to train on")
        return list(runs[:-kept]), list(runs[-kept:]), f"the last {kept} of {len(runs)} runs held out"
    divide = _by_people if by == "people" else _by_time
    pairs = [divide(run, config.holdout) for run in runs]
    words = {
        "people": f"of each run the {config.holdout:.0%} of people who leave last held out, from when the others are "
        "gone; they are not in the training part",
        "time": f"the last {config.holdout:.0%} of each run's time held out; the same people may be in both parts",
    }
    return [train for train, _ in pairs], [held for _, held in pairs], words[by]


def _by_people(run: Samples, share: float) -> tuple[Samples, Samples]:
    last = np.full(len(run.tracks.labels), -1)
    np.maximum.at(last, run.person, run.row)
    agents = np.unique(run.person[run.agents])
    kept = max(1, round(share * len(agents)))
    by_leaving = agents[np.argsort(last[agents], kind="stable")]
    held, trained = by_leaving[-kept:], by_leaving[:-kept]
    gone = int(last[trained].max(initial=-1)) + 1
    late = (run.row >= gone) & ~np.isin(run.person, trained)
    if not len(trained) or len(np.unique(run.row[late & run.agents])) < 2:
        raise ImportFailed(
            f"{run.tracks.name}: nothing is left when all but {kept} of {len(agents)} people have gone, so people "
            "cannot be held out; hold out whole runs (several files, or a column run), or --holdout-by time"
        )
    early = ~np.isin(run.person, held) & (run.row < gone)
    return run.take(early), run.take(late, first=gone)


def _by_time(run: Samples, share: float) -> tuple[Samples, Samples]:
    cut = round(run.rows * (1 - share))
    early = run.row < cut
    for part in (early, ~early):
        if len(np.unique(run.row[part & run.agents])) < 2:
            raise ImportFailed(f"{run.tracks.name}: {run.rows} rows are too few to hold out {share:.0%} of them")
    return run.take(early), run.take(~early, first=cut)
