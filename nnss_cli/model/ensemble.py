"""Several NN-SS models as one: the mean of their outputs, or one of which those far from the others are clipped first.

    clipped: ŷ = ỹ + mean of clip(ŷᵢ − ỹ, ±5 s),   ỹ = median of the ŷᵢ,   s = median of |ŷᵢ − ỹ|

at each sample, for each output. Where the members agree that is their mean. Fewer than half of them that go astray, as
some do under inputs unlike those of their training, move it by no more than a few times what the others differ by.
Where any of them leaves the finite range, so does the ensemble. Of one or two members both rules are the mean.

Source: P. Huber, "Robust Statistics", 1981, 6.7 (a one-step estimate with the median deviation as scale).
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
from nnss_cli.system import FAR, System, system_of

Rule: TypeAlias = Literal["clipped", "mean"]


@dataclass(frozen=True)
class Ensemble:
    """ŷ = the mean of the members' ŷ, by a rule. The states shown are those of the first member."""

    members: tuple[NNSS, ...]
    """At least one, the best by validation first."""
    rule: Rule = "mean"
    """Whether outputs are clipped before the mean is taken."""

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
    def clips(self) -> bool:
        """Whether outputs are clipped: of two or fewer none is far from the others."""
        return self.rule == "clipped" and len(self.members) > 2

    def together(self, each: FloatArray) -> FloatArray:
        """The output of all from that of each member (members, …)."""
        if not self.clips:
            return np.asarray(np.mean(each, axis=0))
        with np.errstate(over="ignore", invalid="ignore"):
            centre = np.median(each, axis=0)
            off = each - centre
            limit = FAR * np.median(np.abs(off), axis=0)
            found = centre + np.mean(np.clip(off, -limit, limit), axis=0)
        return np.where(np.isfinite(each).all(axis=0), found, np.nan)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the first output samples (w, m), physical units."""
        simulations = [member.simulate(u, y_init) for member in self.members]
        return Simulation(self.together(np.stack([simulation.y for simulation in simulations])), simulations[0].x)

    def elementary(self) -> System:
        """All members in elementary operations and physical units, float64; z holds the states of all of them."""
        return system_of([member.elementary_parts() for member in self.members], self.scaling, self.clips)

    def save(self, folder: Path) -> None:
        """Write model.json and model.safetensors into `folder`; tensors are named <member>/<name>."""
        parts = [member.to_file() for member in self.members]
        tensors = {f"{i}/{name}": array for i, (_, own) in enumerate(parts) for name, array in own.items()}
        members = [description for description, _ in parts]
        write_model(folder, {"kind": "ensemble", "rule": self.rule, "members": members}, tensors)

    @classmethod
    def from_file(cls, description: dict[str, Any], tensors: Tensors) -> Ensemble:
        """The inverse of `save`; without a rule the file is of an older nnss, which knew the mean alone."""
        rule = description.get("rule", "mean")
        if rule not in get_args(Rule):
            raise unknown("rule of an ensemble", str(rule), get_args(Rule))
        members = []
        for i, own in enumerate(description["members"]):
            prefix = f"{i}/"
            parts = {name.removeprefix(prefix): array for name, array in tensors.items() if name.startswith(prefix)}
            members.append(NNSS.from_file(own, parts))
        return cls(tuple(members), rule)
