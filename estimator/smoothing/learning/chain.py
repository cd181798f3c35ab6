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
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
        inverse = self._inverse()
        turned = np.swapaxes(inverse, -1, -2)
        out, gain = sides @ turned, self.following @ turned[:-1]
        part = np.empty(out.shape[1:])
        for t in range(len(gain) - 1, -1, -1):
            np.matmul(out[t + 1], gain[t], out=part)
            out[t] -= part
        return np.asarray(out)

    def moments(self, sides: Array) -> tuple[Array, Array, Array]:
        """As `means`, and covariances (F, D, D), (F - 1, D, D) of states with the ones before."""
        inverse = self._inverse()
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

    def _inverse(self) -> Array:
        """(F, D, D) L_t^-T."""
        from scipy.linalg.lapack import dtrtri

        out = self.upper.copy()
        for block in out:
            dtrtri(block.T, lower=1, overwrite_c=1)
        return out


def eliminated(own: Array, following: Array, sides: Array) -> Chain:
    """The factor of diagonal blocks (F, D, D) and those below (F - 1, D, D), with sides (F, S, D).

    Raises numpy's LinAlgError where the precision is not positive definite. The input is used up.
    """
    from scipy.linalg.blas import dtrsm
    from scipy.linalg.lapack import dpotrf

    count = sides.shape[1]
    joined = np.zeros((len(own), count + own.shape[-1], own.shape[-1]))
    joined[:, :count], joined[:-1, count:] = sides, following
    product = np.empty(joined.shape[1:])
    ahead = np.swapaxes(joined[:, count:], -1, -2)
    last = len(own) - 1
    for t in range(last + 1):
        block, rows = own[t], joined[t]
        if dpotrf(block.T, lower=1, clean=1, overwrite_a=1)[1]:
            raise np.linalg.LinAlgError(f"frame {t}")
        dtrsm(1.0, block.T, rows.T, lower=1, overwrite_b=1)
        if t < last:
            np.matmul(rows, ahead[t], out=product)
            own[t + 1] -= product[count:]
            joined[t + 1, :count] -= product[:count]
    return Chain(own, joined[:, :count], joined[:-1, count:])
