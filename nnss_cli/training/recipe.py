"""Recipes: every number that a training needs. What a benchmark lays down for them stands with the benchmark."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

from nnss_cli.baselines.schur import EPSILON
from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.datasets.windows import SHORTEST
from nnss_cli.errors import InputError, unknown
from nnss_cli.iterative import PATIENCE_UNITS
from nnss_cli.model.architecture import FORMERLY, Architecture

ENGINES = ("fast", "reference")
OPTIMISERS = ("adam", "lbfgs", "gauss-newton")
RECIPES = ("best", "paper")
STARTS = ("auto", "random", "linear", "feedback", "cascade")
CHOICES = ("auto", "yes", "no")
JUDGES = ("validation", "blocks")
LONGEST = 60  # samples of a window of the cold alternative
UNITS = 16  # of a layer that is tried, at least: one has 2n weights and a few, where one of a generator has 5n²
MOST = 2000  # weights of a model whose width the recipe chooses; an iteration of Gauss–Newton costs their square


@dataclass(frozen=True)
class Recipe:
    """How an NN-SS model is built and trained."""

    hidden: tuple[int, ...] = (100,)
    """Widths of the generator's sigmoid layers."""
    encoder: tuple[int, ...] = (16, 16)
    """Widths of the encoder's linear layers before its output."""
    encoder_window: int = 1
    """Samples W from which the encoder tells x(0): y(0) alone, or the first W outputs and inputs."""
    scheduling: str = "x"
    """What the generator sees: x, x+u, x+y or x+u+y; auto for x, or x+u where validation prefers it."""
    stability: str = field(default="schur", metadata={"renamed": FORMERLY})
    """What holds by construction: schur (ρ(A) < γ), quadratic (‖A‖ < γ), incremental (trajectories come together at γ,
    and ρ(A) < γ) or none; auto for schur, or incremental where validation prefers it."""
    feedthrough: str = "no"
    """Whether there is a D(ρ)u: yes, no as in the paper, or auto, where validation decides."""
    integrator: str = "no"
    """Whether the outputs sum up what the LPV part gives: yes, no as in the paper, or auto (validation decides)."""
    lengthen: str = "no"
    """Whether Gauss–Newton on whole records begins on short windows that lengthen: yes, no, or auto (where these fit
    far better than whole records did; validation decides)."""
    gamma: float = 1.0
    """Bound on the spectral radius of A(ρ), on its norm (quadratic), or on how fast trajectories come together."""
    gain: float = 0.0
    """Bound on the incremental ℓ2 gain from u to y, both in deviations, with stability incremental; 0 for none."""
    epsilon: float = EPSILON
    """Added to S in the Schur parametrisation."""
    dtype: str = "float32"
    """float32 or float64."""
    window: int = 80
    """Window length L, samples; 0 for whole records."""
    stride: int = 2
    """Samples between the starts of neighbouring windows."""
    batch: int = 64
    """Windows in a mini-batch."""
    learning_rate: float = 1e-3
    """Step size of Adam."""
    consistency: float = 0.01
    """Weight λ of the state-consistency term."""
    epochs: int = 1000
    """Epochs at most."""
    patience: int = 400
    """Epochs or steps without a relative improvement of `improvement` before training stops."""
    patience_unit: str = "epochs"
    """What patience counts: epochs, or steps of the optimiser (mini-batches)."""
    improvement: float = 0.05
    """Relative improvement of the validation error that resets the patience."""
    optimiser: str = "adam"
    """adam on mini-batches; lbfgs or gauss-newton on all windows at once (an epoch is then an iteration)."""
    lead: int = 0
    """Samples with which Gauss–Newton on whole records begins, all together, then four times as many …; 0 for all."""
    refine: int = 0
    """Gauss–Newton iterations from the best epoch of Adam, at most, and at most `epochs`."""
    initial: str = "random"
    """Start: random weights, the linear model that SSEST finds, that with feedback through saturations (feedback), or
    two linear parts with units between them (cascade; with stability incremental). auto for feedback, or a cascade or
    deep cold model that validates better, where there are many samples or few."""
    fixed_encoder: bool = False
    """Leave the encoder as it starts."""
    engine: str = "fast"
    """fast (compiled) or reference (plain torch)."""
    budget: float = 0.0
    """Seconds after which no further candidate or epoch begins, and a feedback or cascade start ends with its step.
    0 for no bound. Results then depend on the machine."""

    judge: str = "validation"
    """What candidates are compared on: validation, or blocks of training and validation, each held out once."""
    threads: int = 1
    """Threads of a Gauss–Newton fit, 1 or 2: the second finds the next stretch's derivatives while the first sums up.
    The numbers are the same."""

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise unknown("engine", self.engine, ("auto", *ENGINES))
        if self.optimiser not in OPTIMISERS:
            raise unknown("optimiser", self.optimiser, OPTIMISERS)
        if self.patience_unit not in PATIENCE_UNITS:
            raise unknown("unit of patience", self.patience_unit, PATIENCE_UNITS)
        if self.initial not in STARTS:
            raise unknown("start", self.initial, STARTS)
        if self.initial == "cascade" and self.stability != "incremental":
            raise InputError(
                f"start cascade: expected stability incremental, whose units it sets, found {self.stability}: give "
                "--stability incremental, or another --start"
            )
        if self.judge not in JUDGES:
            raise unknown("judge", self.judge, JUDGES)
        for name in ("feedthrough", "integrator", "lengthen"):
            if getattr(self, name) not in CHOICES:
                raise unknown(name, getattr(self, name), CHOICES)
        if self.integrator == "yes" and not self.integrates:
            raise InputError(
                f"integrator: the fast engine trains one by gauss-newton alone, found optimiser {self.optimiser}"
                f"{' and refine' * (self.refine > 0)}: take gauss-newton, or --engine reference"
            )
        if self.lengthen == "yes" and not self.lengthens:
            raise InputError(
                "lengthen: expected gauss-newton on whole records (--optimiser gauss-newton --window 0) and no output "
                f"that schedules, found {self.optimiser}, window {self.window} and scheduling {self.scheduling}"
            )
        if self.gain and self.stability != "incremental":
            raise InputError(
                f"gain: expected stability incremental, which can promise one, found {self.stability}: give "
                "--stability incremental"
            )
        if not self.budget >= 0:
            raise InputError(f"budget: expected seconds, or 0 for no bound, found {self.budget}")
        if self.threads not in (1, 2):
            raise InputError(f"threads: expected 1 or 2, found {self.threads}; --jobs uses more cores, a run each")
        for name in ("stride", "batch", "epochs", "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, found {getattr(self, name)}")
        if self.window != 0 and self.window < SHORTEST:
            raise InputError(
                f"window: expected at least {SHORTEST} samples, or 0 for whole records, found {self.window}"
            )
        for name in ("refine", "lead"):
            if getattr(self, name) < 0:
                raise InputError(f"{name}: expected at least 0, found {getattr(self, name)}")
        if not self.learning_rate > 0 or self.consistency < 0:
            raise InputError(
                f"expected a positive learning rate and lambda ≥ 0, found {self.learning_rate} and {self.consistency}"
            )

    @property
    def integrates(self) -> bool:
        """Whether this optimiser and engine can train an integrator."""
        return self.engine == "reference" or (self.optimiser == "gauss-newton" and self.refine == 0)

    @property
    def lengthens(self) -> bool:
        """Whether there are whole records that windows can lengthen to, whose states are all there."""
        return self.optimiser == "gauss-newton" and self.window == 0 and "y" not in self.scheduling

    def architecture(self, order: int, inputs: int, outputs: int) -> Architecture:
        """The model that this recipe trains; the simplest where something is auto.

        Args:
            order: number of all states n; an integrator has m of them.
            inputs: r.
            outputs: m.

        Raises:
            InputError: a width, gamma, epsilon, scheduling or dtype is out of range, or no state is left.
        """
        integrator = self.integrator == "yes"
        if integrator and order <= outputs:
            raise InputError(
                f"integrator: {outputs} of the states integrate, so expected an order above, found {order}"
            )
        return Architecture(
            order - outputs * integrator, inputs, outputs, tuple(self.hidden), tuple(self.encoder),
            "x" if self.scheduling == "auto" else self.scheduling, self.gamma, self.epsilon, self.dtype,
            "schur" if self.stability == "auto" else self.stability, self.feedthrough == "yes", integrator, self.gain,
            self.encoder_window,
        )  # fmt: skip

    def check_encoder_window(self, data: FittingData) -> None:
        """Refuse an encoder that sees samples which are scored, or all of a training window; records are longer.

        Args:
            data: whose first `init_window` samples of a record are not scored.

        Raises:
            InputError: it does.
        """
        W, unscored = self.encoder_window, data.init_window
        if W <= 1:
            return
        if unscored < W:
            remedy = (
                f"take --encoder-window {unscored} or less" if unscored > 1 else
                "take a protocol that leaves some unscored, or give your data an init_window (docs/own-data.md)"
            )  # fmt: skip
            raise InputError(
                f"encoder window: expected at most the first {unscored} of a record's samples, since the others are "
                f"scored, found {W}: {remedy}"
            )
        if 0 < self.window <= W:
            raise InputError(
                f"encoder window: expected fewer samples than the {self.window} of a training window, found {W}: take "
                f"--encoder-window {self.window - 1} or less, or a longer --window"
            )

    def simplest(self) -> Recipe:
        """The first candidate: where something is auto, the paper's structure, and the feedback start."""
        plain = {
            "feedthrough": "no", "integrator": "no", "scheduling": "x", "stability": "schur", "initial": "feedback",
            "lengthen": "no",
        }  # fmt: skip
        return self.replace(**{name: value for name, value in plain.items() if getattr(self, name) == "auto"})

    def alternatives(self, shortest: int) -> dict[str, dict[str, Any]]:
        """What may be changed in the first candidate, one after the other, where something is auto: name → changes.

        Args:
            shortest: samples of the shortest training experiment.
        """
        window = max(SHORTEST, min(LONGEST, 3 * shortest // 5))
        layer = (max(UNITS, 2 * self.hidden[0]),)
        found: dict[str, dict[str, Any]] = {
            "feedthrough": {"feedthrough": "yes"},
            "integrator": {"integrator": "yes"},
            "both": {"feedthrough": "yes", "integrator": "yes"},
            "scheduling": {"scheduling": "x+u"},
            "lengthen": {"lengthen": "yes"},
            "stability": {"stability": "incremental", "hidden": layer},
            "cascade": {"stability": "incremental", "hidden": layer, "initial": "cascade"},
            "initial": {**_COLD, "lengthen": "no", "window": window, "stability": self.simplest().stability},
        }
        if len(self.hidden) > 1 or "y" in self.scheduling or self.optimiser != "gauss-newton":
            del found["stability"], found["cascade"]  # one layer, no output that schedules, and no second run of Adam
        if not self.lengthens:
            del found["lengthen"]
        if self.stability == "incremental" or self.encoder_window >= window:
            del found["initial"]  # its generator is deep, and its windows must go on where the encoder's end
        if self.gain:
            del found["integrator"], found["both"]
        several = {"both": ("feedthrough", "integrator"), "cascade": ("stability", "initial")}
        return {
            name: changes
            for name, changes in found.items()
            if all(getattr(self, field) == "auto" for field in several.get(name, (name,)))
        }

    def replace(self, **changes: Any) -> Recipe:
        """The recipe with what is not None in `changes`."""
        return dataclasses.replace(self, **{name: value for name, value in changes.items() if value is not None})


# The models that the paper's authors released stopped at epochs and errors that a patience of 400 mini-batches
# reproduces; with 400 epochs most train far longer and end well below (docs/recipes.md).
_PAPER = Recipe(patience_unit="steps")

# For records with fewer measured outputs than weights: depth and consistency act as a prior, and a warm start overfits.
_COLD = {
    "hidden": (120,) * 6, "encoder": (64,) * 4, "dtype": "float32", "stride": 10, "batch": 5, "initial": "random",
    "optimiser": "adam", "epochs": 1000, "patience": 400, "consistency": 0.3,
}  # fmt: skip
COLD = frozenset(_COLD) - {"initial"} | {"window"}
"""Fields that the cold alternative fixes: where one of them is asked for, it is not tried."""

# Found on validation (docs/recipes.md). Simulations of whole records, exact second-order steps
# from a good linear model, and so few weights that a full Jacobian is cheap: seconds a run.
_BEST = Recipe(
    hidden=(8,), encoder=(8,), dtype="float64", window=0, stride=1, batch=1, initial="auto",
    optimiser="gauss-newton", epochs=100, patience=100, consistency=0.0, feedthrough="auto", integrator="auto",
    lengthen="auto", stability="auto", lead=5000,
)  # fmt: skip
_RECIPES = {"best": _BEST, "paper": _PAPER}


def recipe_of(name: str, presets: Presets, order: int, outputs: int = 1, inputs: int = 1) -> Recipe:
    """The recipe `paper` or `best` for an order.

    The encoder of `best` lets all outputs through, and any state. Its generator has fewer hidden units where it would
    have more than `MOST` weights with all of them, one at least.

    Args:
        name: of the recipe.
        presets: what the benchmark lays down for it; at an order that it has not, that of the nearest.
        order: number of states n.
        outputs: number of outputs m.
        inputs: number of inputs r.

    Raises:
        InputError: there is no recipe of that name, or the order is none.
    """
    if name not in _RECIPES:
        raise unknown("recipe", name, RECIPES)
    by_order = presets.get(name, {})
    known = by_order[min(by_order, key=lambda known: (abs(known - order), known))] if by_order else {}
    recipe = _RECIPES[name].replace(**known)
    if name == "paper":
        return recipe
    recipe = recipe.replace(encoder=tuple(max(width, outputs, order) for width in recipe.encoder))
    while recipe.hidden[0] > 1 and recipe.simplest().architecture(order, inputs, outputs).weights > MOST:
        recipe = recipe.replace(hidden=(recipe.hidden[0] - 1,))
    return recipe
