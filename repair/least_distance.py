"""The smallest matrix on the inner side of half-planes, by its dual, with a bound that does not trust the solver."""

import numpy as np
import osqp
import scipy.sparse as sp
from jaxtyping import Float

SOLVER = {
    "eps_abs": 1e-7, "eps_rel": 1e-7, "max_iter": 4000, "adaptive_rho_interval": 50, "verbose": False,
}  # fmt: skip
"""Of OSQP. Its step size follows iterations, not seconds, so that runs are alike."""


def least_distance(
    psi: Float[np.ndarray, "M F"],
    normal: Float[np.ndarray, "M 2"],
    offset: Float[np.ndarray, " M"],
    price: Float[np.ndarray, " M"],
    start: Float[np.ndarray, " M"],
) -> tuple[float, Float[np.ndarray, "F 2"], Float[np.ndarray, " M"]]:
    """min |Z|^2 + price . violation, normal . (psi Z) >= offset - violation, by its dual.

    Returns a bound from below that holds whatever the solver did, the Z of its multipliers, and these. The bound is inf
    where no Z exists.
    """
    if not len(offset):
        return 0.0, np.zeros((psi.shape[1], 2)), offset
    kernel = (psi @ psi.T) * (normal @ normal.T)
    solver = osqp.OSQP()
    solver.setup(
        P=sp.csc_matrix(np.triu(kernel) / 2),
        q=-offset,
        A=sp.identity(len(offset), format="csc"),
        l=np.zeros(len(offset)),
        u=price,
        **SOLVER,
    )
    solver.warm_start(x=start)
    done = solver.solve(raise_error=False)
    # Where nothing is feasible the dual is unbounded, in the direction that proves it.
    unbounded = "dual infeasible" in done.info.status
    found = np.asarray(done.dual_inf_cert if unbounded else done.x, np.float64)
    multipliers = np.clip(np.nan_to_num(found), 0, price)
    z = psi.T @ (multipliers[:, None] * normal) / 2
    gain, square = float(offset @ multipliers), float(np.sum(z * z))
    if gain <= 0:
        return 0.0, np.zeros_like(z), np.zeros_like(multipliers)
    # The best multiple of the multipliers: of a certificate that nothing is feasible, a very large one.
    most = float(np.min(np.where(multipliers > 0, price / np.maximum(multipliers, 1e-300), np.inf)))
    scale = min(gain / (2 * max(square, 1e-300)), most)
    return scale * gain - scale * scale * square, scale * z, scale * multipliers
