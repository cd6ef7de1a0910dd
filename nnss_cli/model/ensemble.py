"""Several NN-SS models as one: the mean of their simulated outputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Simulation
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors, write_model


@dataclass(frozen=True)
class Ensemble:
    """ŷ = the mean of the members' ŷ. The states shown are those of the first member."""

    members: tuple[NNSS, ...]
    """At least one, the best by validation first."""

    @property
    def channels(self) -> Channels:
        """Names and units."""
        return self.members[0].channels

    @property
    def Ts(self) -> float:
        """Sampling time [s]."""
        return self.members[0].Ts

    @classmethod
    def chosen(cls, candidates: Sequence[NNSS], data: FittingData) -> Ensemble:
        """The k candidates that validate best, with the k whose mean does.

        The error is the root mean square over all outputs in units of their deviation.
        """
        y = np.concatenate([record.y for record in data.val])
        simulated = [
            np.concatenate([model.simulate(record.u, record.y[0]).y for record in data.val]) for model in candidates
        ]

        def error(outputs: FloatArray) -> float:
            return float(np.sqrt(np.mean(((outputs - y) / data.scaling.y_std) ** 2)))

        ranked = sorted(range(len(candidates)), key=lambda i: error(simulated[i]))
        means = np.cumsum([simulated[i] for i in ranked], axis=0)
        best = min(range(len(ranked)), key=lambda k: error(means[k] / (k + 1)))
        return cls(tuple(candidates[i] for i in ranked[: best + 1]))

    def simulate(self, u: FloatArray, y0: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the first output sample (m,), physical units."""
        simulations = [member.simulate(u, y0) for member in self.members]
        return Simulation(np.mean([simulation.y for simulation in simulations], axis=0), simulations[0].x)

    def save(self, folder: Path) -> None:
        """Write model.json and model.safetensors into `folder`; tensors are named <member>/<name>."""
        parts = [member.to_file() for member in self.members]
        tensors = {f"{i}/{name}": array for i, (_, own) in enumerate(parts) for name, array in own.items()}
        write_model(folder, {"kind": "ensemble", "members": [description for description, _ in parts]}, tensors)

    @classmethod
    def from_file(cls, description: dict[str, Any], tensors: Tensors) -> Ensemble:
        """The inverse of `save`."""
        members = []
        for i, own in enumerate(description["members"]):
            prefix = f"{i}/"
            parts = {name.removeprefix(prefix): array for name, array in tensors.items() if name.startswith(prefix)}
            members.append(NNSS.from_file(own, parts))
        return cls(tuple(members))
