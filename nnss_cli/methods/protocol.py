"""What a method is, what it returns, and what a model can do: all that the rest of the bench knows of either."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Presets, Simulation
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.options import NoOptions, chosen_options
from nnss_cli.modelfile import Tensors

Settings = dict[str, Any]


class Model(Protocol):
    """A fitted model: physical units in and out."""

    @property
    def channels(self) -> Channels:
        """Names and units."""
        ...

    @property
    def Ts(self) -> float:
        """Sampling time [s]."""
        ...

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the x(0) that explains the first w ≥ 1 output samples (w, m) best."""
        ...

    def save(self, folder: Path) -> None:
        """Write the model into `folder` (`nnss_cli.modelfile.write_model`); `load_model` reads it."""
        ...


ModelReader: TypeAlias = Callable[[dict[str, Any], Tensors], Model]
"""model.json and the tensors beside it → the model. Raises KeyError, TypeError or ValueError on what it cannot read."""


@dataclass(frozen=True)
class Fit:
    """What fitting gave: a model, or the reason why there is none."""

    model: Model | None
    """The fitted model; None when the fit failed."""
    epochs: int = 0
    """Epochs that were run; 0 for methods that have none."""
    diverged: str = ""
    """Why an iterative method was given up, or ""."""
    history: dict[str, list[float]] = field(default_factory=dict)
    """Values per epoch, by name."""
    remarks: tuple[str, ...] = ()
    """What a reader of the result must know of how it came about, such as a start that was refused."""
    best_epoch: int = 0
    """Epoch of the model kept, from 1; 0 for methods that have none, and where the start was kept."""


class Method(ABC):
    """A way to get a model of a given order from data.

    A subclass needs `name`, `seeded` and `fit`; what it can be told stands in `options`.
    """

    name: str
    """Name on the command line and in tables."""
    seeded: bool
    """Whether the result depends on the seed; others run once, as seed 0."""
    version: str = "1"
    """To be raised whenever the same settings give other numbers: runs of different versions are not mixed."""
    members: str = ""
    """Name of the method whose runs it combines; "" for one that fits by itself."""
    position: int = 100
    """Place in tables among the built-in methods; plug-ins follow by name."""

    @property
    def options(self) -> type[Any]:
        """What it can be told: a frozen dataclass with a default and a docstring for each field."""
        return NoOptions

    @property
    def models(self) -> Mapping[str, ModelReader]:
        """The kinds of model of its own, as model.json names them, and who reads them."""
        return {}

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Every option of a fit, resolved: it is kept with the run and decides whether one can be reused.

        Raises:
            InputError: an override that this method has is out of range. Others are ignored.
        """
        return asdict(self.options(**chosen_options(self.options, overrides)))

    def current(self, settings: Settings) -> Settings:
        """Settings as an older nnss kept them with a run, in today's names; by default nothing was renamed."""
        return settings

    def paper_settings(self, presets: Presets, order: int) -> Settings | None:
        """The settings with which the paper uses this method; None where it does not."""
        return None

    def prepare(self, settings: Settings) -> None:  # noqa: B027 - nothing is a sound default
        """Do once what is no part of a fit's time: compile, import."""

    @abstractmethod
    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Fit a model.

        Args:
            data: train and validation records in physical units; there is no test in it.
            order: number of states n.
            seed: of all that is drawn at random.
            settings: what `settings` gave.
            on_epoch: to be told epoch, loss and validation error after each epoch, where there are any.

        Raises:
            ValueError, ArithmeticError, RuntimeError, LinAlgError: the data cannot be fitted; this is a result too.
        """
        ...

    def combine(self, members: Sequence[Any], data: FittingData) -> Fit:
        """One model of the models of several seeds, at least one; only asked of a method with `members`."""
        del members, data
        raise NotImplementedError(f"{self.name} combines no runs")
