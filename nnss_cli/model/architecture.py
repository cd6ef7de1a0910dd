"""Sizes and fixed choices of an NN-SS model, checked without torch."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

from nnss_cli.baselines.schur import EPSILON
from nnss_cli.errors import InputError, unknown

SCHEDULING = ("x", "x+u", "x+y", "x+u+y")
DTYPES = ("float32", "float64")
STABILITIES = ("schur", "quadratic", "incremental", "none")
FORMERLY = {"contraction": "quadratic"}
"""Stability as older versions called it → its name today."""
COMBINATIONS = tuple(
    (stability, scheduling)
    for stability in STABILITIES
    for scheduling in SCHEDULING
    if stability != "incremental" or "y" not in scheduling  # y(k−1) is no input that two trajectories share
)
"""What goes with what."""
MAX_WEIGHTS = 100_000_000
"""Weights of a model: 0.8 GB of them, and several times that to train them."""


@dataclass(frozen=True)
class Architecture:
    """Sizes and fixed choices of an NN-SS model."""

    order: int
    """Number of states n of the LPV part: all there are, but for those of the integrator."""
    inputs: int
    """Number of inputs r."""
    outputs: int
    """Number of outputs m."""
    hidden: tuple[int, ...] = (100,)
    """Widths of the generator's sigmoid layers."""
    encoder: tuple[int, ...] = (16, 16)
    """Widths of the encoder's linear layers before its output."""
    scheduling: str = "x"
    """What the generator sees: x, x+u, x+y or x+u+y (y is the previous output)."""
    gamma: float = 1.0
    """Bound on the spectral radius of A(ρ), on its norm (quadratic), or on how fast trajectories come together
    (incremental), 0 < γ ≤ 1."""
    epsilon: float = EPSILON
    """Added to S in the Schur parametrisation."""
    dtype: str = "float32"
    """float32 or float64."""
    stability: str = "schur"
    """What holds by construction: schur, quadratic, incremental or none (docs/stability.md)."""
    feedthrough: bool = False
    """Whether there is a D(ρ): y = C(ρ) x + D(ρ) u instead of the paper's y = C(ρ) x."""
    integrator: bool = False
    """Whether each output sums up what the LPV part gives: y(k+1) = y(k) + C(ρ) x [+ D(ρ) u], m states more."""
    gain: float = 0.0
    """Bound on the incremental ℓ2 gain from u to y in normalised units, by construction (incremental); 0 for none."""
    encoder_window: int = 1
    """Samples W from which the encoder tells x(0): y(0) alone as in the paper, or the first W outputs and inputs."""

    def __post_init__(self) -> None:
        if self.scheduling not in SCHEDULING:
            raise unknown("scheduling", self.scheduling, SCHEDULING)
        if self.dtype not in DTYPES:
            raise unknown("dtype", self.dtype, DTYPES)
        if self.integrator and "y" in self.scheduling:  # it would close a loop around the integrator
            raise InputError(f"integrator: expected scheduling x or x+u, found {self.scheduling}")
        object.__setattr__(self, "stability", FORMERLY.get(self.stability, self.stability))  # of an older folder
        if self.stability not in STABILITIES:
            raise unknown("stability", self.stability, STABILITIES)
        if self.gain:
            self._check_gain()
        if self.stability == "incremental":
            if (self.stability, self.scheduling) not in COMBINATIONS:
                raise InputError(f"stability incremental: expected scheduling x or x+u, found {self.scheduling}")
            if len(self.hidden) != 1:
                raise InputError(
                    f"stability incremental: expected one hidden layer, found {len(self.hidden)}: give --hidden N"
                )
        if not 0 < self.gamma <= 1:
            raise InputError(f"gamma: expected 0 < gamma ≤ 1, found {self.gamma}")
        if self.encoder_window < 1:
            raise InputError(f"encoder window: expected at least 1 sample, found {self.encoder_window}")
        if not self.epsilon > 0:
            raise InputError(f"epsilon: expected a positive number, found {self.epsilon}")
        if min((self.order, *self.hidden, *self.encoder)) < 1 or not self.hidden:
            raise InputError(
                f"order and widths must be at least 1 and the generator needs a hidden layer: found order "
                f"{self.order}, hidden {self.hidden}, encoder {self.encoder}"
            )
        if self.weights > MAX_WEIGHTS:  # before any memory is taken
            raise InputError(
                f"expected at most {MAX_WEIGHTS:,} weights, found {self.weights:,} with order {self.order}, hidden "
                f"{self.hidden}, encoder {self.encoder}: take fewer or narrower layers"
            )

    def _check_gain(self) -> None:
        if not 0 < self.gain < math.inf:
            raise InputError(f"gain: expected a positive bound, or 0 for none, found {self.gain}")
        if self.stability != "incremental":
            raise InputError(f"gain: expected stability incremental, which can promise one, found {self.stability}")
        if self.integrator:
            raise InputError("gain: expected no integrator, whose gain has no bound")

    @property
    def driven_units(self) -> int:
        """Units of an incrementally stable layer that see u: the first ones."""
        if "u" not in self.scheduling:
            return 0
        return self.hidden[0] if self.feedthrough else (self.hidden[0] + 1) // 2

    @property
    def shown_units(self) -> int:
        """Units of an incrementally stable layer that y sees: the last ones, none that sees u where y must not."""
        return self.hidden[0] if self.feedthrough else self.hidden[0] - self.driven_units

    @property
    def gain_columns(self) -> int:
        """Columns of the matrix whose norm is bounded: u, x and the units."""
        return self.order + self.hidden[0] + self.inputs * (self.gain > 0)

    @property
    def weights(self) -> int:
        """Number of all weights and biases."""
        chains = [(self.encoder_inputs, *self.encoder, self.order)]
        found = 0
        if self.stability == "incremental":
            n, r, m, q = self.order, self.inputs, self.outputs, self.hidden[0]
            found = q * (n + 2) + n * (n + q + r) + self.driven_units * r + m * (n + self.shown_units)
            found += m * r * self.feedthrough
        else:
            chains.append((self.scheduling_size, *self.hidden, sum(self.parameter_sizes)))
        return found + sum((before + 1) * width for chain in chains for before, width in pairwise(chain))

    @property
    def encoder_inputs(self) -> int:
        """Length of what the encoder sees: y(0), or y(0) … y(W−1), u(0) … u(W−1)."""
        W = self.encoder_window
        return self.outputs if W == 1 else W * (self.outputs + self.inputs)

    def check_first(self, outputs: int) -> None:
        """Refuse to simulate from fewer first outputs than the encoder sees.

        Raises:
            InputError: there are fewer.
        """
        if outputs < self.encoder_window:
            raise InputError(
                f"y_init: expected the first {self.encoder_window} output samples or more, since the encoder of this "
                f"model sees as many, found {outputs}"
            )

    @property
    def states(self) -> int:
        """Number of all states: the integrator's are the last m."""
        return self.order + self.outputs * self.integrator

    @property
    def scheduling_size(self) -> int:
        """Length of the generator's input."""
        parts = self.scheduling.split("+")
        return self.order + self.inputs * ("u" in parts) + self.outputs * ("y" in parts)

    @property
    def parameter_sizes(self) -> tuple[int, int, int, int, int]:
        """Numbers of entries of W, V, B, C and D (0 without one): the generator's output is their concatenation."""
        n, r, m = self.order, self.inputs, self.outputs
        return 4 * n * n, n * n, n * r, m * n, m * r * self.feedthrough
