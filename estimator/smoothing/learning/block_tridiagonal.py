"""A block-tridiagonal precision: its Cholesky factor, means, and covariances near the diagonal.

Forward over the frames, H_t the precision of frame t given those before, J its coupling forward:

    L_t L_t^T = H_t,   M_t = J_t L_t^-T,   H_{t+1} -= M_t M_t^T

and backward, with the gain G_t = M_t L_t^-1, the covariances (Takahashi, Fagan, Chin, Proc. 8th
PICA Conf., 1973)

    S_t = (L_t L_t^T)^-1 + G_t^T S_{t+1} G_t,   S_{t+1,t} = -S_{t+1} G_t
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf, dtrtri

from telerig.arrays import Array


@dataclass(frozen=True)
class Chain:
    """upper : (F, D, D) L_t^T.

    sides : (F, S, D) what was joined to each frame, times L_t^-T.  following : (F - 1, D, D) M_t.
    """

    upper: Array
    sides: Array
    following: Array

    def log_det(self) -> float:
        """Half the logarithm of the precision's determinant."""
        return float(np.log(np.diagonal(self.upper, axis1=-2, axis2=-1)).sum())

    def means(self, sides: Array) -> Array:
        """(F, K, D) solutions for right sides (F, K, D) as in ``sides``."""
        inverse = inverses(self.upper)
        turned = np.swapaxes(inverse, -1, -2)
        out, gain = sides @ turned, self.following @ turned[:-1]
        part = np.empty(out.shape[1:])
        for t in range(len(gain) - 1, -1, -1):
            np.matmul(out[t + 1], gain[t], out=part)
            out[t] -= part
        return np.asarray(out)

    def moments(self, sides: Array) -> tuple[Array, Array, Array]:
        """As `means`, and covariances (F, D, D), (F - 1, D, D) of states with the ones before."""
        inverse = inverses(self.upper)
        turned = np.swapaxes(inverse, -1, -2)
        size = self.upper.shape[-1]
        gain = self.following @ turned[:-1]
        back = np.swapaxes(gain, -1, -2)
        both = np.concatenate([inverse @ turned, sides @ turned], 1)
        own, mean = both[:, :size], both[:, size:]
        carried = np.empty((len(gain), *both.shape[1:]))
        part = np.empty((size, size))
        for t in range(len(gain) - 1, -1, -1):
            product = carried[t]
            np.matmul(both[t + 1], gain[t], out=product)
            np.matmul(back[t], product[:size], out=part)
            own[t] += part
            mean[t] -= product[size:]
        return mean, own, -carried[:, :size]


def eliminated(own: Array, following: Array, sides: Array) -> Chain:
    """The factor of diagonal blocks (F, D, D) and those below (F - 1, D, D), with sides (F, S, D).

    Raises numpy's LinAlgError where the precision is not positive definite. The input is used up.
    """
    count = sides.shape[1]
    joined = np.zeros((len(own), count + own.shape[-1], own.shape[-1]))
    joined[:, :count], joined[:-1, count:] = sides, following
    eliminate_forward(own, joined)
    return Chain(own, joined[:, :count], joined[:-1, count:])


def eliminate_forward(own: Array, joined: Array) -> None:
    """Eliminate frame by frame, in place.

    own : (F, D, D), in: diagonal blocks, out: L_t^T.
    joined : (F, S + D, D), in: rows of the sides and of the next frame, out: the same times L_t^-T.
    Raises numpy's LinAlgError where the precision is not positive definite.
    """
    width, last = own.shape[-1], len(own) - 1
    after = joined.shape[1] - width
    product = np.empty(joined.shape[1:])
    for t in range(last + 1):
        if dpotrf(own[t].T, lower=1, clean=1, overwrite_a=1)[1]:
            raise np.linalg.LinAlgError(f"frame {t}")
        rows = joined[t]
        dtrsm(1.0, own[t].T, rows.T, lower=1, overwrite_b=1)
        if t < last:
            np.matmul(rows, rows[after:].T, out=product)
            own[t + 1] -= product[after:]
            joined[t + 1, :after] -= product[:after]


def inverses(upper: Array) -> Array:
    """(F, D, D) inverses of upper triangular blocks (F, D, D)."""
    out = upper.copy()
    for block in out:
        dtrtri(block.T, lower=1, overwrite_c=1)
    return out
