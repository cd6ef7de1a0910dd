"""Several NN-SS models as one: the mean of their simulated outputs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray, Scaling, Simulation
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors, write_model
from nnss_cli.system import System, system_of


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

    @property
    def scaling(self) -> Scaling:
        """Between physical and normalised units; all members have the same."""
        return self.members[0].scaling

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the first output samples (w, m), physical units."""
        simulations = [member.simulate(u, y_init) for member in self.members]
        return Simulation(np.mean([simulation.y for simulation in simulations], axis=0), simulations[0].x)

    def elementary(self) -> System:
        """All members in elementary operations and physical units, float64; z holds the states of all of them."""
        return system_of([member.elementary_parts() for member in self.members], self.scaling)

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
