"""What the methods share that give a linear model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from nnss_cli.datasets.record import FittingData
from nnss_cli.errors import unknown
from nnss_cli.methods.protocol import Model, Settings
from nnss_cli.modelfile import Tensors

if TYPE_CHECKING:
    from nnss_cli.baselines.statespace import LinearStateSpace

Horizon: TypeAlias = Literal["matlab", "auto"]
HORIZONS = get_args(Horizon)


def chosen_horizon(data: FittingData, overrides: Settings) -> str:
    """matlab under protocol paper, which repeats the paper's tables; auto elsewhere; or what the user says."""
    name = str(overrides.get("horizon", "matlab" if data.protocol == "paper" else "auto"))
    if name not in HORIZONS:
        raise unknown("horizon", name, HORIZONS)
    return name


def subspace_model(data: FittingData, order: int, horizon: str) -> LinearStateSpace:
    """N4SID in normalised units, with MATLAB's horizons or those that validate best."""
    from nnss_cli.baselines.n4sid import n4sid, n4sid_auto

    train, val = data.normalised()
    return n4sid(train, order) if horizon == "matlab" else n4sid_auto(train, val, order, data.init_window)[0]


def read_linear(description: dict[str, Any], tensors: Tensors) -> Model:
    """A linear model from its file."""
    from nnss_cli.baselines.linear_model import LinearModel

    return LinearModel.from_file(description, tensors)


LINEAR = {"linear": read_linear}
"""`Method.models` of a method whose model is linear."""
