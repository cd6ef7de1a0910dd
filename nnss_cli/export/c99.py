"""C99 for a microcontroller: one .c and one .h, static memory, no library function but exp."""

from __future__ import annotations

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
import textwrap
from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.elementary import Array, Node, Program
from nnss_cli.errors import InputError
from nnss_cli.export.facts import header
from nnss_cli.export.parity import Parity, ParityError, Trial, check, single_left_out
from nnss_cli.files import write_text
from nnss_cli.trained import TrainedModel

TOLERANCES = {"double": 1e-12, "float": 1e-5}
UNHELD = "#error single precision does not hold the signals of this model"
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O3")

_ROOT = """
static real root(real a)
{
  /* Heron's iteration on a number scaled into [1, 4); square root of an infinity or NaN is itself */
  real scale = 1, x;
  int i;
  if (!(a > 0) || a - a != 0) return a > 0 || a != a ? a : 0;
  while (a >= 4) { a *= (real)0.25; scale *= 2; }
  while (a < 1) { a *= 4; scale *= (real)0.5; }
  x = (real)0.5 * (1 + a);
  for (i = 0; i < 6; i++) x = (real)0.5 * (x + a / x);
  return scale * x;
}
"""
_SIGMOID = """
static real sigmoid(real a)
{
  return 1 / (1 + EXP(-a));
}
"""


def write_c(model: TrainedModel, facts: dict[str, Any], trial: Trial, folder: Path, name: str) -> list[Parity]:
    """<name>.h and <name>.c, compiled and checked in double and, where it holds the signals, in single precision.

    Raises:
        InputError: there is no C compiler to check them with.
        ParityError: they do not compile, or compute something else.
    """
    system, upper, left_out = model.system, name.upper(), single_left_out(model, trial)
    single = left_out or f"Compile with -D{upper}_FLOAT for single precision."
    head = ["/*", *_comment(header(facts))]
    sizes = {"STATES": system.size, "INPUTS": system.inputs, "OUTPUTS": system.outputs}
    write_text(folder / f"{name}.h", "\n".join([
        *head,
        " *",
        f" * {name}_initial(y0, u0, z);            the state from {system.starts_from}",
        f" * for each sample: {name}_step(z, u, y);  the output y of this sample, and z moves on to the next",
        " *",
        *_comment(textwrap.wrap(
            f"{single} Nothing is allocated; the working memory is static, so that two calls must not run at once. The "
            "only library function used is exp (expf).", 110
        )),
        " */",
        f"#ifndef {upper}_H",
        f"#define {upper}_H",
        "",
        f"#ifdef {upper}_FLOAT",
        f"typedef float {name}_real;" if not left_out else UNHELD,
        "#else",
        f"typedef double {name}_real;",
        "#endif",
        "",
        *(f"#define {upper}_{what} {size}" for what, size in sizes.items()),
        f"#define {upper}_TS {model.Ts!r} /* s */",
        "",
        "#ifdef __cplusplus",
        'extern "C" {',
        "#endif",
        f"void {name}_initial(const {name}_real *y0, const {name}_real *u0, {name}_real *z);",
        f"void {name}_step({name}_real *z, const {name}_real *u, {name}_real *y);",
        "#ifdef __cplusplus",
        "}",
        "#endif",
        "",
        "#endif",
        "",
    ]))  # fmt: skip
    emitter = _Emitter()
    bodies = [
        *emitter.function(f"void {name}_initial(const real *y0, const real *u0, real *z)", system.initial, {"z": "z"}),
        *emitter.function(f"void {name}_step(real *z, const real *u, real *y)", system.step, {"z_next": "z", "y": "y"}),
    ]
    write_text(folder / f"{name}.c", "\n".join([
        *head,
        " */",
        f'#include "{name}.h"',
        "#include <math.h>",
        "",
        f"#ifdef {upper}_FLOAT",
        "#define EXP expf",
        "#else",
        "#define EXP exp",
        "#endif",
        "",
        f"typedef {name}_real real;",
        "",
        *emitter.constants,
        f"static real work[{max(emitter.memory, 1)}];",
        *[_ROOT] * emitter.uses["root"],
        *[_SIGMOID] * emitter.uses["sigmoid"],
        *bodies,
        "",
    ]))  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="nnss-c-") as aside:
        return [
            _check(folder, name, kind, trial, Path(aside)) for kind in TOLERANCES if not (left_out and kind == "float")
        ]


def _comment(lines: Sequence[str]) -> list[str]:
    """Lines within a comment, which they cannot end; what compilers warn of there (`/*`, a trigraph) is parted."""
    text = (f" * {line}".replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ?/") for line in lines)
    return [line.rstrip() for line in text]


class _Emitter:
    """Functions that share constants and working memory."""

    def __init__(self) -> None:
        self.constants: list[str] = []
        self.memory = 0
        self.uses = {"root": False, "sigmoid": False}
        self._names: dict[tuple[Any, bytes], str] = {}

    def constant(self, value: Array) -> str:
        """The name of an array, the same for equal ones."""
        key = (value.shape, value.tobytes())
        if key not in self._names:
            name = self._names[key] = f"c{len(self._names)}"
            numbers = [_number(x) for x in value.ravel()]
            lines = [", ".join(numbers[i : i + 6]) for i in range(0, len(numbers), 6)]
            self.constants += [
                f"static const real {name}[{len(numbers)}] = {{",
                *(f"  {line}," for line in lines),
                "};",
            ]
        return self._names[key]

    def function(self, signature: str, program: Program, results: dict[str, str]) -> list[str]:
        """A function's text.

        Args:
            signature: with a parameter for each argument, by its name.
            program: what it computes.
            results: the parameter that gets each result; it may be an argument, which is read before.
        """
        # A product with a constant runs over its columns, which keeps the sums independent of each other.
        transposed = {
            number: program.nodes[node.of[0]].value
            for number, node in enumerate(program.nodes)
            if node.operation == "product" and node.shape[1] == 1
        }
        places = _Memory(program, set(results))
        lines = [
            f"  (void){name};"
            for name, number in program.inputs.items()
            if not any(number in n.of for n in program.nodes)
        ]
        of: dict[int, str] = {number: name for name, number in program.inputs.items()}
        for number, node in enumerate(program.nodes):
            if node.operation == "input":
                continue
            if node.value is not None:
                users = program.users(number)
                if program.is_plain_number(number):
                    of[number] = f"(real){_number(node.value[0, 0])}"
                elif number in program.outputs.values() or not all(
                    _by_columns(transposed, i, number, n) for i, n in users
                ):
                    of[number] = self.constant(node.value)
                continue
            base = places.alias[number]
            if base is not None:
                source, offset = base
                of[number] = of[source] if not offset else f"({of[source]} + {offset})"
                continue
            target = f"(work + {places.offset[number]})"
            of[number] = target
            weight = transposed.get(number)
            if weight is not None:
                lines += _by_column(target, self.constant(np.ascontiguousarray(weight.T)), of[node.of[1]], weight.shape)
                continue
            lines += self._loops(node, target, [of[i] for i in node.of], [program.nodes[i].shape for i in node.of])
        self.memory = max(self.memory, places.size)
        for result, parameter in results.items():
            number = program.outputs[result]
            lines.append(_each(prod(program.nodes[number].shape), f"{parameter}[i] = {of[number]}[i];"))
        return ["", signature, "{", "  int i, j, k;", *lines, "  (void)i; (void)j; (void)k;", "}"]

    def _loops(self, node: Node, to: str, of: Sequence[str], shapes: Sequence[tuple[int, int]]) -> list[str]:
        p, q = node.shape
        operation = node.operation
        signs = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/", "less": "<"}
        if operation in signs:
            a, b = (_entry(x, shape) for x, shape in zip(of, shapes, strict=True))
            return [_each(p * q, f"{to}[i] = {a} {signs[operation]} {b};")]
        if operation in self.uses:
            self.uses[operation] = True
            return [_each(p * q, f"{to}[i] = {operation}({of[0]}[i]);")]
        if operation == "sum":
            return [f"  {to}[0] = 0;", _each(prod(shapes[0]), f"{to}[0] += {of[0]}[i];")]
        if operation == "transpose":
            return [f"  for (i = 0; i < {p}; i++) for (j = 0; j < {q}; j++) {to}[i * {q} + j] = {of[0]}[j * {p} + i];"]
        if operation == "product":
            inner = shapes[0][1]
            return [
                _each(p * q, f"{to}[i] = 0;"),
                f"  for (i = 0; i < {p}; i++) for (k = 0; k < {inner}; k++) for (j = 0; j < {q}; j++)",
                f"    {to}[i * {q} + j] += {of[0]}[i * {inner} + k] * {of[1]}[k * {q} + j];",
            ]
        if operation == "part":
            first, _, left, _ = node.part
            width = shapes[0][1]
            return [
                f"  for (i = 0; i < {p}; i++) for (j = 0; j < {q}; j++)",
                f"    {to}[i * {q} + j] = {of[0]}[(i + {first}) * {width} + j + {left}];",
            ]
        if operation == "rows":
            lines, at = [], 0
            for x, shape in zip(of, shapes, strict=True):
                lines.append(_each(prod(shape), f"{to}[i + {at}] = {x}[i];"))
                at += prod(shape)
            return lines
        assert operation == "columns", operation
        lines, at = [], 0
        for x, (_, width) in zip(of, shapes, strict=True):
            lines += [
                f"  for (i = 0; i < {p}; i++) for (j = 0; j < {width}; j++)",
                f"    {to}[i * {q} + j + {at}] = {x}[i * {width} + j];",
            ]
            at += width
        return lines


def _by_columns(transposed: dict[int, Array | None], i: int, constant: int, node: Node) -> bool:
    """Whether node i uses this constant as the weight of a product by columns only."""
    return transposed.get(i) is not None and node.of[0] == constant and node.of[1] != constant


def _by_column(to: str, weight: str, vector: str, shape: tuple[int, ...]) -> list[str]:
    return [
        _each(shape[0], f"{to}[i] = 0;"),
        f"  for (j = 0; j < {shape[1]}; j++) for (i = 0; i < {shape[0]}; i++)",
        f"    {to}[i] += {weight}[j * {shape[0]} + i] * {vector}[j];",
    ]


class _Memory:
    """Where each result lies: beside those that are still needed, in the place of those that are not."""

    def __init__(self, program: Program, results: set[str]) -> None:
        nodes = program.nodes
        self.alias: dict[int, tuple[int, int] | None] = {}
        owner: dict[int, int] = {}
        for number, node in enumerate(nodes):
            self.alias[number] = _alias(node, nodes)
            base = self.alias[number]
            owner[number] = number if base is None else owner[base[0]]
        last = {owner[number]: number for number in range(len(nodes))}
        for number, node in enumerate(nodes):
            for i in node.of:
                last[owner[i]] = max(last[owner[i]], number)
        for result in results:
            last[owner[program.outputs[result]]] = len(nodes)
        self.offset: dict[int, int] = {}
        self.size = 0
        live: dict[int, tuple[int, int]] = {}
        for number, node in enumerate(nodes):
            live = {other: place for other, place in live.items() if last[other] >= number}
            if node.operation == "input" or node.value is not None or self.alias[number] is not None:
                continue
            need, at = prod(node.shape), 0
            for begin, end in sorted(live.values()):
                if begin - at >= need:
                    break
                at = max(at, end)
            self.offset[number] = at
            live[number] = (at, at + need)
            self.size = max(self.size, at + need)


def _alias(node: Node, nodes: Sequence[Node]) -> tuple[int, int] | None:
    """The node in whose memory this one lies already, and where: entries lie row by row."""
    if node.operation == "reshape" or (node.operation == "transpose" and 1 in node.shape):
        return node.of[0], 0
    if node.operation == "part":
        first, last, left, right = node.part
        width = nodes[node.of[0]].shape[1]
        if (left, right) == (0, width) or last - first == 1:
            return node.of[0], first * width + left
    return None


def _entry(x: str, shape: tuple[int, int]) -> str:
    if x.startswith("(real)"):
        return x
    return f"{x}[{'0' if shape == (1, 1) else 'i'}]"


def _each(count: int, body: str) -> str:
    return f"  for (i = 0; i < {count}; i++) {body}"


def _number(value: float) -> str:
    if not np.isfinite(value):
        raise ParityError(f"expected finite weights, found {value}")
    return f"{float(value)!r}"


def compiler() -> list[str]:
    """The C compiler, from the environment's CC or by the usual names.

    Raises:
        InputError: there is none.
    """
    named = shlex.split(os.environ.get("CC", ""))
    for command in ([named] if named else []) + [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    raise InputError(
        "export to c is checked by compiling it: no C compiler found: install gcc or clang, or name one in CC"
    )


def compile_c(sources: Sequence[Path], to: Path, *flags: str) -> None:
    """Compile as C99 with all warnings as errors.

    Raises:
        InputError: there is no compiler.
        ParityError: it does not compile; the first message is told.
    """
    command = [*compiler(), *FLAGS, *flags, *map(str, sources), "-o", str(to), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        told = next((line for line in done.stderr.splitlines() if "error" in line), done.stderr[:200])
        raise ParityError(f"the C code does not compile: {' '.join(told.split())}")


def _check(folder: Path, name: str, kind: str, trial: Trial, aside: Path) -> Parity:
    library = aside / f"{name}-{kind}.so"
    compile_c([folder / f"{name}.c"], library, "-shared", "-fPIC", *[f"-D{name.upper()}_FLOAT"] * (kind == "float"))
    functions = ctypes.CDLL(str(library))
    step, initial = (getattr(functions, f"{name}_{part}") for part in ("step", "initial"))
    dtype = np.float32 if kind == "float" else np.float64
    u = np.ascontiguousarray(trial.u, dtype=dtype)
    z: Array = np.array(trial.z, dtype=dtype, order="C")
    y: Array = np.empty(trial.y.shape, dtype=dtype)
    simulated, state = np.empty(trial.y.shape, dtype=dtype), z[0].copy()

    def call(function: Any, *arrays: Array) -> None:
        function(*(ctypes.c_void_p(array.ctypes.data) for array in arrays))

    for k in range(len(u)):
        call(step, z[k], u[k], y[k])
        call(step, state, u[k], simulated[k])
    started: Array = np.empty(len(trial.z0), dtype=dtype)
    call(initial, np.asarray(trial.y0, dtype=dtype), np.asarray(trial.u0, dtype=dtype), started)
    return check(f"C99, {kind}", trial, (z, y), simulated, TOLERANCES[kind], started)
