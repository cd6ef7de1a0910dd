"""A linear model in physical units: a state-space system with its scaling."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Scaling, Simulation, first_outputs

from nnss_cli.modelfile import Tensors, write_model
from nnss_cli.system import Parts, System, system_of


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A system identified in normalised units, used in physical ones."""

    system: LinearStateSpace
    """x(k+1) = A x + B ũ, ỹ = C x + D ũ in normalised units."""
    scaling: Scaling
    """Between physical and normalised units."""
    channels: Channels
    """Names and units."""

    KIND = "linear"

    @classmethod
    def of(cls, system: LinearStateSpace, data: FittingData) -> LinearModel:
        """Attach the scaling and names of the data that the system was fitted to."""
        return cls(system, data.scaling, data.channels)

    @property
    def Ts(self) -> float:
        """Sampling time [s]."""
        return self.system.Ts

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation from the smallest x0 that explains the first outputs best in least squares.

        From one output sample this is x0 = C⁺(ỹ0 − D ũ0), as the paper scores linear models.

        Args:
            u: inputs (K, r), physical units.
            y_init: first output samples (w, m), or (m,) for one, physical units.

        Raises:
            InputError: there is no such sample, or there are more than inputs.
        """
        u_scaled = self.scaling.normalise_u(u)
        known = first_outputs(y_init, u, len(self.system.C))
        x0 = self.system.state_from_outputs(self.scaling.normalise_y(known), u_scaled)
        y, x = self.system.simulate(u_scaled, x0)
        return Simulation(self.scaling.restore_y(y), x)

    def elementary(self) -> System:
        """The model in elementary operations and physical units."""
        s = self.system
        inverse = np.linalg.pinv(s.C)
        parts = Parts(
            advance=lambda x, u, _: (
                x.constant(s.A) @ x + x.constant(s.B) @ u,
                x.constant(s.C) @ x + x.constant(s.D) @ u,
            ),
            initial=lambda y0, u0: y0.constant(inverse) @ y0 - y0.constant(inverse @ s.D) @ u0,
            frozen=lambda x, *_: tuple(x.constant(matrix) for matrix in (s.A, s.B, s.C, s.D)),
            n=s.order,
            keeps_output=False,
            feedthrough=bool(s.D.any()),
        )
        return system_of([parts], self.scaling)

    def save(self, folder: Path) -> None:
        """Write model.json and model.safetensors into `folder`."""
        tensors = {name: getattr(self.system, name) for name in ("A", "B", "C", "D")}
        description = {"kind": self.KIND, "Ts": self.Ts, "channels": asdict(self.channels)}
        write_model(folder, description, tensors | asdict(self.scaling))

    @classmethod
    def from_file(cls, description: dict[str, Any], tensors: Tensors) -> LinearModel:
        """The inverse of `save`."""
        system = LinearStateSpace(tensors["A"], tensors["B"], tensors["C"], tensors["D"], description["Ts"])
        scaling = Scaling(*(tensors[name] for name in ("u_mean", "u_std", "y_mean", "y_std")))
        channels = Channels(**{name: tuple(names) for name, names in description["channels"].items()})
        return cls(system, scaling, channels)
