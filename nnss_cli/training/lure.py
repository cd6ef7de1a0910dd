"""An incrementally stable layer in the fast engine: plain matrices and their derivatives by the free weights, cached.

The matrices are few and the same for all samples, so they are made and differentiated once for all, and the loops over
samples know nothing of the weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.model.architecture import Architecture
from nnss_cli.training import lure_kernels as kernels
from nnss_cli.training.lure_matrices import Layout

Arrays = tuple[FloatArray, ...]


class CompiledLure:
    """Compiled loops for weights that change in place."""

    def __init__(self, architecture: Architecture, views: Mapping[str, FloatArray]) -> None:
        """`views` are the layer's weights by name, which are read anew at each call."""
        self.architecture, self.views = architecture, views
        self.layout = Layout(architecture)
        self.dtype = np.dtype(architecture.dtype)
        self._seen: FloatArray = np.empty(0)
        self._plain: Arrays = ()
        self._slopes: FloatArray | None = None

    @property
    def size(self) -> int:
        """Number of free weights."""
        return sum(view.size for view in self.views.values())

    def _vector(self) -> FloatArray:
        return np.concatenate([view.ravel() for view in self.views.values()]).astype(np.float64)

    def plain(self) -> Arrays:
        """A, B, F, G, H, b, C, D, E of the weights as they are, in the model's precision."""
        vector = self._vector()
        if not self._plain or not np.array_equal(vector, self._seen):
            flat = self.layout.matrices(vector)
            self._seen, self._slopes, self._plain = vector, None, self.cut(flat.astype(self.dtype))
        return self._plain

    def cut(self, flat: FloatArray) -> Arrays:
        """All matrices as one vector → the matrices."""
        a = self.architecture
        n, r, m, q = a.order, a.inputs, a.outputs, a.hidden[0]
        shapes = ((n, n), (n, r), (n, q), (q, n), (q, r), (q,), (m, n), (m, r), (m, q))
        ends = np.cumsum([np.prod(shape) for shape in shapes])
        return tuple(part.reshape(shape) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True))

    def slopes(self) -> FloatArray:
        """Derivatives of all matrices, row after row, by the free weights, at those as they are."""
        self.plain()
        if self._slopes is None:
            self._slopes = self.layout.pulled_back(self._seen, np.eye(sum(part.size for part in self._plain)))
        return self._slopes

    def free_run(self, u: FloatArray, x0: FloatArray, y: FloatArray, x: FloatArray) -> None:
        """Simulations side by side: y (K, m, b) and x (K, n, b) are written, from u (K, r, b) and x0 (n, b)."""
        kernels.free_run(*self.plain(), x0, u, y, x)

    def loss_and_gradient(
        self, encoder: FloatArray, shift: FloatArray, consistency: float, u: FloatArray, y: FloatArray,
        seen: FloatArray, gradient: FloatArray, d_encoder: FloatArray, d_shift: FloatArray,
    ) -> float:  # fmt: skip
        """Loss of windows of one length; see `nnss_cli.model.kernels.loss_and_gradient`."""
        plain = self.plain()
        by_plain = [np.zeros_like(part) for part in plain]
        d_encoder[:], d_shift[:] = 0, 0
        loss = kernels.loss_and_gradient(*plain, encoder, shift, consistency, u, y, seen, *by_plain, d_encoder, d_shift)
        towards = np.concatenate([part.ravel() for part in by_plain]).astype(np.float64)
        gradient[: self.size] = self.layout.pulled_back(self._seen, towards[None])[0]
        return float(loss)

    def sensitivities(
        self, x0: FloatArray, u: FloatArray, stretch: int
    ) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """Outputs (k, m), states (k, n) and the outputs' derivatives (k, m, p + n) by weights and x0, in stretches."""
        slopes = self.slopes().astype(self.dtype)
        matrices = len(slopes)
        for y, x, J in plain_sensitivities(self.plain(), x0, u, stretch):
            by_weights = (J[:, :, :matrices].reshape(-1, matrices) @ slopes).reshape(*y.shape, -1)
            yield y, x, np.concatenate([by_weights, J[:, :, matrices:]], axis=2)


def plain_sensitivities(
    plain: Arrays, x0: FloatArray, u: FloatArray, stretch: int
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Outputs (k, m), states (k, n) and the outputs' derivatives (k, m, P + n) by all matrices and x0, in stretches.

    Args:
        plain: A, B, F, G, H, b, C, D, E.
        x0: initial state (n,).
        u: inputs (K, r).
        stretch: k, samples at most.
    """
    dtype, n, m, matrices = plain[0].dtype, len(plain[0]), len(plain[6]), sum(part.size for part in plain)
    state, S = np.array(x0, dtype), np.zeros((n, matrices + n), dtype)
    S[:, matrices:] = np.eye(n)
    for start in range(0, len(u), stretch):
        part = np.ascontiguousarray(u[start : start + stretch])
        k = len(part)
        y, x, J = np.empty((k, m), dtype), np.empty((k, n), dtype), np.empty((k, m, matrices + n), dtype)
        kernels.sensitivities(*plain, state, part, S, y, x, J)
        yield y, x, J
