"""How good is a predictive distribution that is given as samples? Coverage, energy score, likelihood, sharpness.

Lower is better for the energy score and the negative log-likelihood (NLL); both are proper: no forecast has a better
expectation than the true law. Coverage and sharpness say why: wide bands are easy to stay in.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from envs.record import Array, record
from swarm_mjcf.errors import SpecError

LEVELS = (0.5, 0.9)
"""Central bands that are reported."""


def central_band(samples: Float[Array, "K *n"], level: float) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Lower and upper end of the band that holds a new draw of the same law with probability `level`.

    Order statistics at places p (K + 1), interpolated (Weibull's positions): for exchangeable draws these cover
    `level` exactly at every K, where the usual quantiles of K samples cover too little. Raises SpecError for a level
    that K samples cannot tell: `level` is at most (K - 1) / (K + 1).
    """
    count = samples.shape[0]
    if not 0 < level <= (count - 1) / (count + 1) + 1e-9:
        raise SpecError("level", level, f"above 0 and at most {(count - 1) / (count + 1):.3f} with {count} samples")
    ordered = jnp.sort(samples, axis=0)

    def at(share: float) -> Array:
        place = share * (count + 1) - 1
        below = min(max(int(np.floor(place)), 0), count - 2)
        return ordered[below] + (place - below) * (ordered[below + 1] - ordered[below])

    return at((1 - level) / 2), at((1 + level) / 2)


def energy_score(samples: Float[Array, "K *n D"], truth: Float[Array, "*n D"]) -> Float[Array, "*n"]:
    """E|X - y| - E|X - X'| / 2 in the unit of the samples (Gneiting and Raftery 2007, eq. 22), Euclidean norm.

    Pairs of different samples only (K (K - 1) of them), so its expectation does not depend on K. One dimension: CRPS.
    """
    count = samples.shape[0]
    if count < 2:
        raise SpecError("samples", count, "at least 2 for an energy score")
    miss = jnp.linalg.norm(samples - truth, axis=-1).mean(axis=0)

    def apart(total: Array, one: Array) -> tuple[Array, None]:
        return total + jnp.linalg.norm(samples - one, axis=-1).sum(axis=0), None

    total, _ = jax.lax.scan(apart, jnp.zeros_like(miss), jnp.asarray(samples))
    return miss - total / (2 * count * (count - 1))


def gaussian_nll(
    samples: Float[Array, "K *n D"], truth: Float[Array, "*n D"], *, floor: float = 1e-3
) -> Float[Array, "*n"]:
    """-log density [nats] of the truth under the normal law with the samples' mean and full covariance.

    Chosen over a kernel estimate because it has no bandwidth to tune, and is proper for the first two moments (Dawid
    and Sebastiani 1999); what it cannot see, several modes, the energy score does. `floor`: standard deviation [unit
    of the samples] that is added to the diagonal, so that equal samples have a density too.
    """
    count, size = samples.shape[0], samples.shape[-1]
    if count <= size:
        raise SpecError("samples", count, f"more than the {size} dimensions for a covariance")
    mean = samples.mean(axis=0)
    off = samples - mean
    covariance = (off[..., :, None] * off[..., None, :]).sum(axis=0) / (count - 1) + floor**2 * jnp.eye(size)
    root = jnp.linalg.cholesky(covariance)
    white = jax.scipy.linalg.solve_triangular(root, (truth - mean)[..., None], lower=True)[..., 0]
    log_det = 2 * jnp.log(jnp.diagonal(root, axis1=-2, axis2=-1)).sum(axis=-1)
    return 0.5 * (jnp.sum(white * white, axis=-1) + log_det + size * np.log(2 * np.pi))


@record
class ScoreSums:
    """Sums over present nodes at each horizon; add those of several batches, then `mean_scores`."""

    count: Float[Array, " h"]
    covered: Float[Array, "L h"]
    """Share of the coordinates inside each central band of `LEVELS`."""
    width: Float[Array, "L h"]
    """Width of the bands [m], mean over the coordinates."""
    energy: Float[Array, " h"]
    nll: Float[Array, " h"]
    square: Float[Array, " h"]
    """Squared distance from the samples' mean to the truth [m^2]."""


def score_sums(
    samples: Float[Array, "K B h V 4"], truth: Float[Array, "B h V 4"], mask: Bool[Array, "B h V"]
) -> ScoreSums:
    """Scores of predicted positions, one node at a time, summed over windows and nodes where `mask` is set."""
    samples, truth = jnp.asarray(samples)[..., :2], jnp.asarray(truth)[..., :2]

    def total(values: Float[Array, "B h V"]) -> Float[Array, " h"]:
        return jnp.where(mask, values, 0).sum(axis=(0, 2))

    bands = [central_band(samples, level) for level in LEVELS]
    return ScoreSums(
        count=mask.sum(axis=(0, 2)).astype(jnp.float32),
        covered=jnp.stack([total(((low <= truth) & (truth <= high)).mean(axis=-1)) for low, high in bands]),
        width=jnp.stack([total((high - low).mean(axis=-1)) for low, high in bands]),
        energy=total(energy_score(samples, truth)),
        nll=total(gaussian_nll(samples, truth)),
        square=total(jnp.sum((samples.mean(axis=0) - truth) ** 2, axis=-1)),
    )


@dataclass(frozen=True)
class Scores:
    """Mean scores of predicted agent positions by horizon; index 0 is one step ahead."""

    coverage_50: Float[np.ndarray, " h"]
    """Share of true coordinates inside the central 50% band; 0.5 is right."""
    coverage_90: Float[np.ndarray, " h"]
    """Share of true coordinates inside the central 90% band; 0.9 is right."""
    width_50: Float[np.ndarray, " h"]
    """Mean width of the band [m]: sharpness."""
    width_90: Float[np.ndarray, " h"]
    """Mean width of the band [m]: sharpness."""
    energy: Float[np.ndarray, " h"]
    """Energy score of a position [m]."""
    nll: Float[np.ndarray, " h"]
    """Negative log-likelihood of a position [nats], Gaussian fitted to the samples."""
    rmse: Float[np.ndarray, " h"]
    """Root mean square distance from the samples' mean to the truth [m]."""


def mean_scores(sums: ScoreSums) -> Scores:
    """Means from sums; NaN at a horizon at which nobody was present."""
    count = np.asarray(sums.count, np.float64)

    def mean(values: Array) -> np.ndarray:
        return np.divide(np.asarray(values, np.float64), count, out=np.full(count.shape, np.nan), where=count > 0)

    (coverage_50, coverage_90), (width_50, width_90) = (map(mean, part) for part in (sums.covered, sums.width))
    energy, nll, rmse = mean(sums.energy), mean(sums.nll), np.sqrt(mean(sums.square))
    return Scores(coverage_50, coverage_90, width_50, width_90, energy, nll, rmse)
