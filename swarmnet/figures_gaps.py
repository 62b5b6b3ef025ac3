"""How proofs grow with rows and box: seconds until 1% is proven, or the gap that is left."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from swarmnet.bench_repair import GAP, Proof
from swarmnet.figures import blank_figure
from swarmnet.sheets import STYLE


def gaps(proofs: Sequence[Proof]) -> Figure:
    """A panel for each family, seconds over rows, a colour for each box or margin; hollow, with the gap in percent,
    where time was up before 1% was proven."""
    families = list(dict.fromkeys(proof.family for proof in proofs))
    columns = min(2, max(len(families), 1))
    rows = -(-len(families) // columns)
    with mpl.rc_context(STYLE):
        figure = blank_figure(3.5 * columns, 2.7 * rows + 0.3)
        for number, family in enumerate(families):
            ax = figure.add_subplot(rows, columns, number + 1)
            of = [proof for proof in proofs if proof.family == family]
            values = sorted({proof.value for proof in of})
            colours = mpl.colormaps["viridis"](np.linspace(0, 0.85, len(values)))
            unit = " m" if of[0].setting == "margin" else ""
            for place, (value, colour) in enumerate(zip(values, colours, strict=True)):
                points = sorted((p for p in of if p.value == value), key=lambda p: p.rows)
                x, y = [p.rows for p in points], [p.seconds for p in points]
                ax.plot(x, y, "-", lw=0.9, color=colour, label=f"{of[0].setting} {value:g}{unit}")
                for point in points:
                    fill = colour if point.proven else "white"
                    ax.plot(point.rows, point.seconds, "o", ms=4.5, color=colour, mfc=fill)
                    if not point.proven:
                        words = f"{100 * point.gap:.2g}%" if np.isfinite(point.gap) else "no incumbent"
                        above = (-3, 5 + 7 * place) if len(values) > 1 else (0, 5)
                        ax.annotate(
                            words, (point.rows, point.seconds), above, textcoords="offset points", fontsize=6,
                            color=colour, ha="right",
                        )  # fmt: skip
            every = sorted({proof.rows for proof in of})
            ax.set(xscale="log", yscale="log", title=family, xlabel="rows", ylabel="seconds")
            ax.set_xticks(every, [str(count) for count in every])
            ax.minorticks_off()
            ax.margins(0.12, 0.1)
            if not all(proof.proven for proof in of):
                low, high = ax.get_ylim()
                ax.set_ylim(low, high * (high / low) ** 0.25)  # room for the gaps' words
            ax.legend(frameon=False, fontsize=6, loc="best")
        if families:
            figure.suptitle(
                f"time until a gap of {100 * GAP:g}% is proven; hollow: time was up, gap as written", fontsize=8
            )
    return figure
