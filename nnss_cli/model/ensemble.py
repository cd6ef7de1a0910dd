"""Several NN-SS models as one: the mean of their outputs at each sample, without the lowest and the highest ones.

A quarter of the members is left out at each end, one at least; two or fewer are all kept. A member that goes astray on
an input unlike those it was trained on does not take the mean along, as long as most of the others do not.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray, Scaling, Simulation
from nnss_cli.errors import unknown
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors, write_model
from nnss_cli.system import System, system_of

Rule: TypeAlias = Literal["middle", "mean"]


@dataclass(frozen=True)
class Ensemble:
    """ŷ = the mean of the middle ones of the members' ŷ. The states shown are those of the first member."""

    members: tuple[NNSS, ...]
    """At least one, the best by validation first."""
    rule: Rule = "middle"
    """Which outputs are averaged: the middle ones, or those of all members (mean), as nnss did before it trimmed."""

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

    @property
    def trimmed(self) -> int:
        """How many of the lowest outputs are left out at a sample, and of the highest."""
        k = len(self.members)
        return 0 if self.rule == "mean" or k < 3 else max(1, k // 4)

    def together(self, each: FloatArray) -> FloatArray:
        """The output of all from that of each member (members, …)."""
        kept = slice(self.trimmed, len(each) - self.trimmed)
        return np.asarray(np.mean(np.sort(each, axis=0)[kept] if self.trimmed else each, axis=0))

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the first output samples (w, m), physical units."""
        simulations = [member.simulate(u, y_init) for member in self.members]
        return Simulation(self.together(np.stack([simulation.y for simulation in simulations])), simulations[0].x)

    def elementary(self) -> System:
        """All members in elementary operations and physical units, float64; z holds the states of all of them."""
        return system_of([member.elementary_parts() for member in self.members], self.scaling, self.trimmed)

    def save(self, folder: Path) -> None:
        """Write model.json and model.safetensors into `folder`; tensors are named <member>/<name>."""
        parts = [member.to_file() for member in self.members]
        tensors = {f"{i}/{name}": array for i, (_, own) in enumerate(parts) for name, array in own.items()}
        members = [description for description, _ in parts]
        write_model(folder, {"kind": "ensemble", "rule": self.rule, "members": members}, tensors)

    @classmethod
    def from_file(cls, description: dict[str, Any], tensors: Tensors) -> Ensemble:
        """The inverse of `save`; without a rule the file is of an nnss that knew the mean alone."""
        rule = description.get("rule", "mean")
        if rule not in get_args(Rule):
            raise unknown("rule of an ensemble", str(rule), get_args(Rule))
        members = []
        for i, own in enumerate(description["members"]):
            prefix = f"{i}/"
            parts = {name.removeprefix(prefix): array for name, array in tensors.items() if name.startswith(prefix)}
            members.append(NNSS.from_file(own, parts))
        return cls(tuple(members), rule)
