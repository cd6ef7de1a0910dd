"""ONNX graphs, in float32 and float64: the step, and a whole simulation as one Scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.elementary import Array, Node, Program
from nnss_cli.export.facts import certificate_lines, header
from nnss_cli.export.parity import Parity, Trial, check
from nnss_cli.files import write_bytes
from nnss_cli.system import System
from nnss_cli.trained import TrainedModel

TOLERANCES = {"float32": 1e-5, "float64": 1e-10}
OPSET = 17
IR_VERSION = 8
"""Those of 2022, which runtimes of today have."""


def write_onnx(model: TrainedModel, facts: dict[str, Any], trial: Trial, folder: Path, name: str) -> list[Parity]:
    """<name>_step_<type>.onnx (z, u → z_next, y) and <name>_simulate_<type>.onnx (u, z0 → y, z), checked.

    Those of a type that does not hold the signals are not written. Vectors are of one axis: z (N,), u (r,), y (m,); of
    the simulation u is (K, r), y (K, m) and z (K, N).
    """
    properties = {
        "Ts": repr(model.Ts), "inputs": ", ".join(facts["inputs"]), "outputs": ", ".join(facts["outputs"]),
        "states": ", ".join(facts["states"]), "certificate": " ".join(certificate_lines(facts)),
        "fingerprint": facts["fingerprint"] or "",
    }  # fmt: skip
    found = []
    for precision in filter(trial.holds, TOLERANCES):
        graphs = {"step": _step, "simulate": _simulate}
        for part, make in graphs.items():
            content = _model(make(model.system, precision), " ".join(header(facts)), properties)
            write_bytes(folder / f"{name}_{part}_{precision}.onnx", content)
        found.append(_check(folder, name, precision, trial))
    return found


class _Graph:
    """Nodes and constants of a graph that is being made."""

    def __init__(self, precision: str) -> None:
        self.precision = precision
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._names: dict[tuple[str, Any, bytes], str] = {}

    def constant(self, value: Array) -> str:
        """The name of a constant in the graph's precision; the same for equal ones."""
        return self._constant(np.asarray(value, dtype=self.precision))

    def whole(self, values: Sequence[int]) -> str:
        """The name of a constant of whole numbers."""
        return self._constant(np.array(values, dtype=np.int64))

    def _constant(self, array: Array) -> str:
        from onnx import numpy_helper

        key = (str(array.dtype), array.shape, array.tobytes())
        if key not in self._names:
            self._names[key] = f"c{len(self._names)}"
            self.constants.append(numpy_helper.from_array(np.ascontiguousarray(array), self._names[key]))
        return self._names[key]

    def add(self, operation: str, *of: str, **attributes: Any) -> str:
        """The name of a new node's result."""
        from onnx import helper

        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, list(of), [name], **attributes))
        return name

    def named(self, of: str, name: str) -> None:
        """Give a result the name of an output."""
        from onnx import helper

        self.nodes.append(helper.make_node("Identity", [of], [name]))

    def operations(self) -> Mapping[str, Callable[..., str]]:
        """Of `Program.run`."""

        def part(node: Node, a: str) -> str:
            i, j, k, l = node.part  # noqa: E741
            return self.add("Slice", a, self.whole([i, k]), self.whole([j, l]), self.whole([0, 1]))

        return {
            "add": lambda _, a, b: self.add("Add", a, b),
            "subtract": lambda _, a, b: self.add("Sub", a, b),
            "multiply": lambda _, a, b: self.add("Mul", a, b),
            "divide": lambda _, a, b: self.add("Div", a, b),
            "less": lambda _, a, b: self.add("Cast", self.add("Less", a, b), to=_type(self.precision)),
            "product": lambda _, a, b: self.add("MatMul", a, b),
            "transpose": lambda _, a: self.add("Transpose", a, perm=[1, 0]),
            "reshape": lambda node, a: self.add("Reshape", a, self.whole(node.shape)),
            "part": part,
            "rows": lambda _, *parts: self.add("Concat", *parts, axis=0),
            "columns": lambda _, *parts: self.add("Concat", *parts, axis=1),
            "sum": lambda _, a: self.add("ReduceSum", a, self.whole([0, 1]), keepdims=1),
            "root": lambda _, a: self.add("Sqrt", a),
            "sigmoid": lambda _, a: self.add("Sigmoid", a),
        }

    def program(self, program: Program, of: Mapping[str, str]) -> dict[str, str]:
        """Add a program's nodes; vectors get and lose their second axis."""
        columns = {
            name: self.add("Reshape", of[name], self.whole(program.nodes[number].shape))
            for name, number in program.inputs.items()
        }
        found = program.run(columns, self.operations(), lambda _, value: self.constant(value))
        return {name: self.add("Reshape", result, self.whole([-1])) for name, result in found.items()}


def _value(name: str, precision: str, shape: Sequence[int | str]) -> Any:
    from onnx import helper

    return helper.make_tensor_value_info(name, _type(precision), list(shape))


def _type(precision: str) -> int:
    from onnx import TensorProto

    return {"float32": TensorProto.FLOAT, "float64": TensorProto.DOUBLE}[precision]


def _step(system: System, precision: str) -> Any:
    from onnx import helper

    graph = _Graph(precision)
    found = graph.program(system.step, {"z": "z", "u": "u"})
    for name in ("z_next", "y"):
        graph.named(found[name], name)
    return helper.make_graph(
        graph.nodes,
        "step",
        [_value("z", precision, [system.size]), _value("u", precision, [system.inputs])],
        [_value("z_next", precision, [system.size]), _value("y", precision, [system.outputs])],
        graph.constants,
    )


def _simulate(system: System, precision: str) -> Any:
    from onnx import helper

    graph = _Graph(precision)
    found = graph.program(system.step, {"z": "z_now", "u": "u_now"})
    for name, of in (("z_next", found["z_next"]), ("y_now", found["y"]), ("z_seen", "z_now")):
        graph.named(of, name)
    body = helper.make_graph(
        graph.nodes,
        "step",
        [_value("z_now", precision, [system.size]), _value("u_now", precision, [system.inputs])],
        [
            _value("z_next", precision, [system.size]),
            _value("y_now", precision, [system.outputs]),
            _value("z_seen", precision, [system.size]),
        ],
        graph.constants,
    )
    scan = helper.make_node("Scan", ["z0", "u"], ["z_end", "y", "z"], num_scan_inputs=1, body=body)
    return helper.make_graph(
        [scan],
        "simulate",
        [_value("u", precision, ["K", system.inputs]), _value("z0", precision, [system.size])],
        [
            _value("y", precision, ["K", system.outputs]),
            _value("z", precision, ["K", system.size]),
            _value("z_end", precision, [system.size]),
        ],
    )


def _model(graph: Any, text: str, properties: Mapping[str, str]) -> bytes:
    import onnx
    from onnx import helper

    model = helper.make_model(graph, producer_name="nnss", opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = IR_VERSION
    model.doc_string = text
    helper.set_model_props(model, dict(properties))
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString())


def _check(folder: Path, name: str, precision: str, trial: Trial) -> Parity:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    sessions = {
        part: onnxruntime.InferenceSession(
            str(folder / f"{name}_{part}_{precision}.onnx"), options, providers=["CPUExecutionProvider"]
        )
        for part in ("step", "simulate")
    }
    z, u = trial.z.astype(precision), trial.u.astype(precision)
    steps = [sessions["step"].run(["z_next", "y"], {"z": z[k], "u": u[k]}) for k in range(len(u))]
    (y,) = sessions["simulate"].run(["y"], {"u": u, "z0": z[0]})
    return check(
        f"ONNX, {precision}", trial, (np.array([step[0] for step in steps]), np.array([step[1] for step in steps])), y,
        TOLERANCES[precision],
    )  # fmt: skip
