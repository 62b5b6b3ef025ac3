"""Generalised advantage estimation (Schulman et al. 2016)."""

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from envs.record import Array


def gae(
    reward: Float[Array, "T *a"],
    value: Float[Array, "T1 *a"],
    discount: Float[Array, "T *#a"],
    follows: Bool[Array, "T *#a"],
    gae_lambda: float,
) -> Float[Array, "T *a"]:
    """Advantages `A_t = d_t + discount_t lambda follows_t A_{t+1}` with `d_t = r_t + discount_t V_{t+1} - V_t`.

    `value` holds T + 1 rows: V_{t+1} is that of the very state that step t led to, so a truncated step bootstraps from
    its last observation. `discount` is 0 where step t terminated; `follows` says whether row t + 1 goes on with the
    same episode.
    """
    delta = reward + discount * value[1:] - value[:-1]

    def back(after: Array, row: tuple[Array, Array]):
        delta, kept = row
        advantage = delta + kept * after
        return advantage, advantage

    kept = jnp.broadcast_to(discount * gae_lambda * follows, delta.shape)
    _, advantage = jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, kept), reverse=True)
    return advantage
