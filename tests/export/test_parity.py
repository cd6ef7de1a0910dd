"""Every export computes what the model does, for every kind of model, and what does not is never kept."""

import itertools
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch
from conftest import slow_but
from nnss_cli.datasets.catalog import load as load_dataset
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.export import TARGETS, ParityError, c99, export, parity, write
from nnss_cli.export.facts import CERTIFIED, certificate_lines, facts_of
from nnss_cli.methods import select
from nnss_cli.model.architecture import COMBINATIONS, Architecture
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.trained import TrainedModel, load

# In deviations of the outputs, over a whole simulation. Single precision adds up: 2e-5 for the linear model of two
# tanks, whose slowest pole sums two hundred steps; a step is within 1e-6.
SINGLE = 5e-5
DOUBLE = {"control.nlsys": 1e-12, "CasADi": 1e-12, "ONNX, float64": 1e-12, "C99, double": 1e-12, "Octave": 1e-12}


EVERY = tuple((*kind, n, size) for kind, n, size in itertools.product(COMBINATIONS, range(1, 7), ((1, 1), (2, 3))))
"""Stability, scheduling, order, and numbers of inputs and outputs."""
FEW = (
    ("schur", "x+u+y", 4, (2, 3)), ("quadratic", "x", 5, (1, 1)), ("none", "x+y", 2, (2, 3)),
    ("schur", "x+u", 1, (1, 1)), ("incremental", "x+u", 4, (2, 3)),
)  # fmt: skip
"""Of these, each stability, each scheduling, and one with feedthrough; the rest are slow together."""


def names(kinds: tuple) -> list[str]:
    return [f"{stability}-{scheduling}-n{n}-{r}x{m}" for stability, scheduling, n, (r, m) in kinds]


def untrained(
    stability: str, scheduling: str, n: int, size: tuple[int, int], seed: int = 0, offset: float = 0.0, **more: Any
) -> TrainedModel:
    """An NN-SS model of random weights, of signals this far from zero; every second order has feedthrough."""
    r, m = size
    random = np.random.default_rng(seed)
    scaling = Scaling(
        offset + random.normal(size=r), random.uniform(0.5, 2, r), offset + random.normal(size=m),
        random.uniform(0.5, 2, m),
    )  # fmt: skip
    channels = Channels(
        tuple(f"u{i + 1}" for i in range(r)), tuple(f"y{i + 1}" for i in range(m)), ("V",) * r, ("m",) * m
    )
    choices = {"hidden": (6,), "encoder": (4,), "dtype": "float64", "gamma": 0.97, "feedthrough": n % 2 == 0} | more
    model = NNSS(Architecture(n, r, m, scheduling=scheduling, stability=stability, **choices), scaling, channels, 0.1)
    model.initialise(random)
    return TrainedModel(model)


@pytest.fixture(scope="session")
def tried() -> Callable[..., tuple[TrainedModel, dict[str, Any], parity.Trial]]:
    """A random model, its facts and its trial of 40 samples."""
    made: dict[tuple, tuple[TrainedModel, dict[str, Any], parity.Trial]] = {}

    def found(*kind: Any) -> tuple[TrainedModel, dict[str, Any], parity.Trial]:
        if kind not in made:
            model = untrained(*kind)
            made[kind] = model, facts_of(model), parity.trial_of(model)
        return made[kind]

    return found


def writer(target: str) -> Callable[..., list[parity.Parity]]:
    found = write._TARGETS[target]
    return getattr(import_module(found.module), found.writer)


@pytest.fixture(autouse=True)
def _short_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parity, "SAMPLES", 40)


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("kind", FEW, ids=names(FEW))
def test_parity(kind: tuple, target: str, tried: Callable, tmp_path: Path) -> None:
    for found in writer(target)(*tried(*kind), tmp_path, "model"):
        assert found.step <= DOUBLE.get(found.what, 2e-6)
        assert found.simulation <= DOUBLE.get(found.what, 1e-5)
        assert found.samples == 40


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(
    ("count", "size", "rule"),
    slow_but((1,), [(5, (2, 3), "clipped"), (3, (1, 1), "clipped"), (4, (1, 1), "clipped"), (3, (1, 1), "mean")]),
)
def test_parity_of_an_ensemble_that_clips(
    count: int, size: tuple[int, int], rule: str, target: str, tmp_path: Path, ensemble_of: Callable
) -> None:
    kinds = (("schur", "x"), ("incremental", "x+u"), ("schur", "x+y"), ("quadratic", "x"), ("schur", "x+u+y"))
    members = [untrained(*kind, 2 + number % 2, size, number).model for number, kind in enumerate(kinds[:count])]
    model = ensemble_of(members, rule)
    for found in writer(target)(model, facts_of(model), parity.trial_of(model), tmp_path, "model"):
        assert found.step <= DOUBLE.get(found.what, 2e-6)
        assert found.simulation <= DOUBLE.get(found.what, 1e-5)


def test_members_that_agree_but_for_rounding_are_exported_to_casadi(tmp_path: Path, ensemble_of: Callable) -> None:
    """Which of them counts at a sample is chance, and so is the slope: it is not compared there."""
    members = [untrained("schur", "x", 2, (1, 1), 0).model for _ in range(4)]
    for number, member in enumerate(members):
        for weight in member.parameters():
            weight.data *= 1 + number * 1e-15
    model = ensemble_of(members)
    assert writer("casadi")(model, facts_of(model), parity.trial_of(model), tmp_path, "model")


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("kind", EVERY, ids=names(EVERY))
def test_parity_of_every_kind(kind: tuple, target: str, tried: Callable, tmp_path: Path) -> None:
    """Some of these, that promise nothing, are unstable: what a step's error becomes there is the model's affair."""
    _, _, trial = tried(*kind)
    for found in writer(target)(*tried(*kind), tmp_path, "model"):
        assert found.step <= DOUBLE.get(found.what, 2e-6)
        assert found.simulation <= DOUBLE.get(found.what, 1e-5) * (trial.accumulation if kind[0] == "none" else 1)


QUICK = {"epochs": 3, "hidden": (8,), "encoder": (4,)}
TRAINED = {
    "quadratic": ("nnss", QUICK | {"stability": "quadratic", "gamma": 0.999, "initial": "random"}),
    "float32": ("nnss-paper", {"epochs": 2, "stride": 50, "hidden": (20,)}),
    "linear": ("ssest", {}),
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], TrainedModel]:
    """Models of the embedded record: NN-SS with a bound, one in float32, a linear one, and an ensemble."""
    dataset = load_dataset("twotank-sim", "strict")
    store = Store(tmp_path_factory.mktemp("trained"), dataset.name, dataset.protocol)

    @cache
    def model(name: str) -> TrainedModel:
        if name == "ensemble":
            one, other = model("quadratic"), model("float32")
            Ensemble((one.model, other.model)).save(folder := store.folder / "runs" / name)
            shutil.copy(one.folder / "signals.safetensors", folder)
            return load(folder)
        method, settings = TRAINED[name]
        (spec,) = plan(store, dataset, select([method]), [3], [0], settings, False).todo
        assert execute(spec, dataset, store).status == "ok"
        return load(store.run_folder(spec))

    return model


@pytest.mark.system
@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize(
    "name", ["linear", *(pytest.param(each, marks=pytest.mark.slow) for each in ("quadratic", "float32", "ensemble"))]
)
def test_trained_models_on_their_whole_test_record(
    name: str, target: str, trained: Callable[[str], TrainedModel], tmp_path: Path
) -> None:
    model = trained(name)
    done = export(model, target, tmp_path / "out")
    record = model.records()["test"][0]
    for found in done.parity:
        assert found.samples == len(record)
        assert found.source == "its test record"
        assert found.step <= DOUBLE.get(found.what, 1e-6)
        assert found.simulation <= DOUBLE.get(found.what, SINGLE)
    facts = json.loads((tmp_path / "out" / "model.json").read_text())
    assert facts["outputs"] == list(model.channels.outputs)
    assert facts["fingerprint"] == model.fingerprint
    assert [entry["what"] for entry in facts["parity"]] == [found.what for found in done.parity]
    certificate = facts["certificate"][0]
    assert (certificate["state_bound"] is not None) == (name in ("quadratic", "ensemble"))
    source = {"control": "model.py", "c": "model.c", "mat": "model_step.m"}.get(target)
    if source:
        text = (tmp_path / "out" / source).read_text()
        assert f"{certificate['box_radius']:.6g}" in text
        assert certificate["state_bound"] is None or f"{certificate['state_bound']:.6g}" in text


STATED = {
    "control": {"control.nlsys": 1e-12}, "casadi": {"CasADi": 1e-10}, "mat": {"Octave": 1e-12},
    "onnx": {"ONNX, float32": 1e-5, "ONNX, float64": 1e-10}, "c": {"C99, double": 1e-12, "C99, float": 1e-5},
}  # fmt: skip
"""As docs/api.md has them: of a step and of the start, in units of the larger of deviation and distance from the mean,
of states relative to 1 + |z|."""


@pytest.mark.system
@pytest.mark.parametrize(("target", "what"), [(target, what) for target, own in STATED.items() for what in own])
def test_an_export_is_refused_ten_times_the_stated_tolerance_away(
    target: str, what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The reference is moved, which is the same, at the output farthest from its mean and at the largest state."""
    model = untrained("schur", "x", 3, (2, 3))
    for weight in model.model.generator[-1].parameters():
        weight.data *= 20.0  # outputs leave their deviation
    facts, trial, s = facts_of(model), parity.trial_of(model), model.scaling
    module = import_module(write._TARGETS[target].module)
    if hasattr(module, "TOLERANCES"):  # the other precision would be refused first
        kind = what.split()[-1]
        monkeypatch.setattr(module, "TOLERANCES", {kind: module.TOLERANCES[kind]})
    distance = np.abs(trial.y - s.y_mean)
    assert (distance / s.y_std).max() > 2
    units = {
        "y": np.maximum(s.y_std, distance) * (distance == distance.max()),
        "z_next": (1 + np.abs(trial.z_next)) * (np.abs(trial.z_next) == np.abs(trial.z_next).max()),
        "z0": 1 + np.abs(trial.z0),
    }

    def written(share: float, *parts: str) -> list[parity.Parity]:
        moved = {part: getattr(trial, part) + share * STATED[target][what] * units[part] for part in parts}
        return writer(target)(model, facts, replace(trial, **moved), tmp_path, "model")

    (*checked,) = written(0.5, *units)
    kept = scipy.io.loadmat(tmp_path / "model.mat", simplify_cells=True)["trial"] if target == "mat" else {}
    if kept:  # for MATLAB, also where there is no Octave
        assert kept["step_tolerance"] == 1e-12
        assert kept["tolerance"] == pytest.approx(1e-12 * trial.accumulation)
    if not checked:
        assert target == "mat"
        return
    assert [(found.what, found.tolerance) for found in checked] == [(what, STATED[target][what])]
    for part in units:
        if part != "z0" or target != "onnx":  # which has no start
            with pytest.raises(ParityError, match="Octave" if target == "mat" else f"{what}.*no file was written"):
                written(10, part)


@pytest.mark.parametrize("target", ["c", "onnx", "control", "mat"])
def test_an_offset_is_allowed_the_rounding_that_it_makes(target: str, tmp_path: Path) -> None:
    """A float near 10,000 is 0.0005 off; a double near 10^8 is 1e-8 off, and no computation finds what is lost."""
    for offset, single in ((1e4, True), (1e8, False)):
        model = untrained("schur", "x+u+y", 3, (2, 2), offset=offset)
        trial = parity.trial_of(model)
        done = export(model, target, tmp_path / f"{offset:g}")
        for found in done.parity:
            eps = 1.2e-7 if "float" in found.what.replace("float64", "") else 2.2e-16
            assert found.step <= 5 * eps * offset
            assert max(1e-12, eps * offset) < found.tolerance < 20 * max(1e-11, eps * offset)
            assert ("rounding of the signals makes up to" in str(found)) == (eps * offset > 1e-4)
        assert trial.tolerance(1e-12) == pytest.approx(2 * 2.2e-16 * trial.rounding, rel=0.01)
        has = target in ("c", "onnx")
        kinds = [found.what.split()[-1] for found in done.parity]
        assert any(kind in ("float", "float32") for kind in kinds) == (has and single)
        assert bool(done.left_out) == (has and not single)
        assert json.loads((tmp_path / f"{offset:g}" / "model.json").read_text())["left_out"] == done.left_out
    if has:
        assert re.fullmatch(
            r"Single precision is not written: its rounding of the signals makes errors of more than 0\.01 deviations; "
            r"the largest offset is that of [uy][12] \[[Vm]\], 1e\+08 beside a deviation of [\d.]+\.",
            done.left_out,
        )
    if target == "onnx":
        assert not list((tmp_path / "1e+08").glob("*float32*"))


def test_c_without_single_precision_says_so_and_does_not_compile_for_it(nnss: Callable, tmp_path: Path) -> None:
    model = untrained("schur", "x+u+y", 3, (2, 2), offset=1e8)
    model.model.save(tmp_path / "model")
    done = nnss("export", tmp_path / "model", "--to", "c", "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert "\nSingle precision is not written: its rounding" in done.out
    header = " ".join((tmp_path / "out" / "model.h").read_text(encoding="utf-8").replace("\n *", "").split())
    assert "Single precision is not written: its rounding of the signals" in header
    source = tmp_path / "out" / "model.c"
    c99.compile_c([source], tmp_path / "double.so", "-shared", "-fPIC")
    with pytest.raises(ParityError, match="single precision does not hold the signals of this model"):
        c99.compile_c([source], tmp_path / "float.so", "-shared", "-fPIC", "-DMODEL_FLOAT")


def test_a_wrong_model_is_found_beside_an_offset(tmp_path: Path) -> None:
    """Off by a hundredth of a deviation, where single precision is allowed a thousandth."""
    model = untrained("schur", "x+u+y", 3, (2, 2), offset=1e4)
    trial, facts = parity.trial_of(model), facts_of(model)
    for part, off in (("y", 0.01 * trial.unit), ("z_next", 0.02 + 0.02 * np.abs(trial.z_next))):
        moved = replace(trial, **{part: getattr(trial, part) + off})
        for what in ("double", "float"):
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr(c99, "TOLERANCES", {what: c99.TOLERANCES[what]})
                with pytest.raises(ParityError, match=f"C99, {what}"):
                    c99.write_c(model, facts, moved, tmp_path, "model")


def test_a_start_that_enlarges_rounding_is_allowed_it(tmp_path: Path) -> None:
    """An encoder of outputs that are copies of each other may look at their difference, which is rounding."""
    model = untrained("schur", "x", 2, (1, 2))
    scale, first = torch.as_tensor(model.scaling.y_std), model.model.encoder[0]
    with torch.no_grad():
        first.weight += 1e4 * torch.tensor([1.0, -1.0]) * scale
        first.bias += 1e4 * float(np.diff(-model.scaling.y_mean)[0])
    trial = parity.trial_of(model)
    y0 = np.full(2, trial.y0[0])
    trial = replace(trial, y0=y0, z0=model.system.start(y0, trial.u0))
    trial = replace(trial, rounding=parity._rounding(model.system, trial))
    double, single = c99.write_c(model, facts_of(model), trial, tmp_path, "model")
    assert max(double.start, 1e-5) < single.start < single.tolerance < 0.01


def test_a_start_from_a_window_is_run_as_it_is_written(tmp_path: Path) -> None:
    model = untrained("schur", "x+y", 2, (2, 3), encoder_window=4)
    for target in ("control", "c", "casadi"):
        for found in writer(target)(model, facts_of(model), parity.trial_of(model), tmp_path, "model"):
            assert found.start is not None
            assert found.start <= (1e-6 if found.what == "C99, float" else 1e-13)


def test_the_certificate_in_words_tells_the_largest_radius() -> None:
    own = dict.fromkeys(CERTIFIED) | {"stability": "none", "radius": {"train": 0.5, "test": 0.75}, "box_radius": 0.875}
    (line,) = certificate_lines({"certificate": [own]})
    assert "spectral radius of A at most 0.75 along the records, 0.875 found in their box" in line


@pytest.mark.system
@pytest.mark.parametrize(
    "target", ["c", "mat", *(pytest.param(each, marks=pytest.mark.slow) for each in ("control", "casadi", "onnx"))]
)
def test_a_failed_check_leaves_no_file(
    target: str, tried: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kind = ("schur", "x", 2, (1, 1))
    model, _, trial = tried(*kind)
    other = untrained(*kind, seed=1)
    monkeypatch.setattr(write, "trial_of", lambda _: trial)
    if target == "mat":  # without Octave only the arrays are compared
        monkeypatch.setattr(
            "scipy.io.loadmat", lambda *_, **__: {"constants": dict.fromkeys(map("c{}".format, range(99)), 0)}
        )
    with pytest.raises(ParityError, match="no file was written"):
        export(other, target, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    monkeypatch.undo()
    assert export(model, target, tmp_path / "out").files
    left = {path.name for path in (tmp_path / "out").iterdir()}
    if target != "mat":  # whose header holds the time
        assert export(model, target, tmp_path / "out").files  # the same once more replaces nothing
    with pytest.raises(InputError, match="exists already"):
        export(other, target, tmp_path / "out")
    export(other, target, tmp_path / "out", force=True)
    assert {path.name for path in (tmp_path / "out").iterdir()} == left


def test_a_step_that_is_not_the_models_is_found(tried: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    model, *_ = tried("schur", "x", 3, (1, 1))
    other = untrained("schur", "x", 3, (1, 1), seed=1)
    wrong = other.system
    monkeypatch.setattr(type(model.model), "elementary", lambda _: wrong)
    with pytest.raises(ParityError, match="leaves the model's own simulation"):
        parity.trial_of(TrainedModel(model.model))


@pytest.mark.parametrize(("target", "package"), [("casadi", "casadi"), ("onnx", "onnx"), ("onnx", "onnxruntime")])
def test_a_missing_package_is_named(
    target: str, package: str, tried: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"needs the package {package}: pip install 'nnss\[{target}\]'"):
        export(tried("none", "x", 1, (1, 1))[0], target, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_other_wrong_exports_are_one_line(tried: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, *_ = tried("none", "x", 1, (1, 1))
    with pytest.raises(InputError, match="unknown target 'simulink': choose from control, casadi, onnx, c, mat"):
        export(model, "simulink", tmp_path)
    with pytest.raises(InputError, match="name: expected letters"):
        export(model, "c", tmp_path, name="../a")
    for target, names, told in (
        ("control", ("class", "numpy", "control", "math", "scipy"), "expected one of no Python module"),
        ("c", ("math", "stddef"), "math.h would be taken for it|stddef.h would"),
        ("mat", ("_x",), "must begin with a letter, found '_x'"),
        ("casadi", ("_x", "a__b"), "must begin with a letter, without '__'"),
    ):
        for name in names:
            with pytest.raises(InputError, match=told):
                export(model, target, tmp_path / "out", name=name)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(InputError, match="no C compiler found: install gcc or clang"):
        export(model, "c", tmp_path / "out")
    with pytest.raises(InputError, match=r"expected a model with `elementary\(\)`"):
        export(TrainedModel(type("Other", (), {"channels": model.channels, "Ts": 1.0})()), "c", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("target", ["c", "mat"])
def test_a_start_that_is_not_the_models_is_said(target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """x(0) of a model with an init window is searched for, which no export does."""
    model = untrained("schur", "x", 2, (1, 1), encoder_window=3)
    assert export(model, target, tmp_path / "plain").start == ""
    monkeypatch.setattr(TrainedModel, "init_window", 20)
    done = export(model, target, tmp_path / "out")
    for said in (
        "the model finds z(0) from the first 20 output samples", "a first guess, from the first 3 output samples",
        "Find z(0) in Python by model.initial_state(u, y_init), and start from it.",
    ):  # fmt: skip
        assert said in done.start
    for path in done.files:
        if path.suffix in (".c", ".m", ".json") and path.stem not in ("model_simulate", "model_check"):
            text = " ".join(path.read_text(encoding="utf-8").replace("\n *", "\n").replace("\n%", "\n").split())
            assert done.start in text, path
            assert "Start:" not in (tmp_path / "plain" / path.name).read_text(encoding="utf-8")


@pytest.mark.system
def test_c_uses_no_library_function_but_exp(tried: Callable, tmp_path: Path) -> None:
    for i, kind in enumerate([("quadratic", "x+u", 3, (1, 1)), ("schur", "x", 3, (2, 3))]):
        model, facts, trial = tried(*kind)
        c99.write_c(model, facts, trial, tmp_path, f"m{i}")
        subprocess.run([*c99.compiler(), "-O3", "-c", f"m{i}.c", "-o", f"m{i}.o"], cwd=tmp_path, check=True)
        listed = subprocess.run(
            ["nm", "-u", f"m{i}.o"], cwd=tmp_path, check=True, capture_output=True, text=True
        ).stdout
        used = {line.split()[-1].lstrip("_") for line in listed.splitlines()}
        assert used - {"memcpy", "memset", "GLOBAL_OFFSET_TABLE_", "stack_chk_fail"} == {"exp"}
        source = (tmp_path / f"m{i}.c").read_text()
        assert "malloc" not in source
        assert source.count("#include") == 2


@pytest.mark.parametrize("width", [8, pytest.param(100, marks=pytest.mark.slow)])
def test_c_takes_less_than_two_microseconds_a_step(width: int, tried: Callable, tmp_path: Path) -> None:
    """For n = 3 and the generators of both recipes; the quickest of many batches, since the machine may be busy."""
    model = untrained("schur", "x", 3, (1, 1), hidden=(width,))
    trial = parity.trial_of(model)
    c99.write_c(model, tried("schur", "x", 3, (1, 1))[1], trial, tmp_path, "model")
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include <time.h>\n#include "model.h"\n'
        "int main(void)\n{\n  double best = 1, sum = 0;\n  int b, k;\n"
        "  model_real z[MODEL_STATES] = {0}, u[MODEL_INPUTS] = {0}, y[MODEL_OUTPUTS];\n"
        "  for (b = 0; b < 200; b++) {\n    clock_t begin = clock();\n    double seconds;\n"
        "    for (k = 0; k < 2000; k++) { u[0] = (k % 7) * 0.1; model_step(z, u, y); sum += y[0]; }\n"
        "    seconds = (double)(clock() - begin) / CLOCKS_PER_SEC / 2000;\n"
        '    if (seconds < best) best = seconds;\n  }\n  printf("%g %g\\n", best, sum);\n  return 0;\n}\n'
    )
    c99.compile_c([tmp_path / "main.c", tmp_path / "model.c"], tmp_path / "run")
    done = subprocess.run([str(tmp_path / "run")], capture_output=True, text=True, check=True)
    assert float(done.stdout.split()[0]) < 2e-6


def test_comments_cannot_be_left(tmp_path: Path) -> None:
    """A channel's name is the user's: it may hold what ends a comment."""
    model = untrained("schur", "x", 1, (1, 1))
    model.model.channels = replace(model.channels, inputs=("u */ int x;\n#error\n",))
    for target in ("c", "control", "mat", "onnx"):
        assert export(model, target, tmp_path / target).files


@pytest.mark.parametrize("name", ["a/*b", "//*/ **/", f"{'u' * 60} {'v' * 34} ??/", "// back\\"])
def test_comments_of_c_hold_whatever_a_name_may_be(name: str, tmp_path: Path) -> None:
    """All warnings are errors: of "/*" within a comment, and of a trigraph that ends a line."""
    model = untrained("schur", "x", 1, (1, 1))
    model.model.channels = replace(model.channels, inputs=(name,), outputs=(f"{name}_",), output_units=(name[:20],))
    assert export(model, "c", tmp_path).files


@pytest.mark.system
def test_the_module_of_control_stands_alone(tried: Callable, tmp_path: Path) -> None:
    """In an interpreter that cannot import nnss."""
    model, facts, trial = tried("schur", "x+u+y", 4, (2, 3))
    writer("control")(model, facts, trial, tmp_path, "plant")
    code = (
        "import sys; sys.modules['nnss_cli'] = None\n"
        "import numpy as np, plant\n"
        "z = plant.initial(np.ones(3), np.ones(2)); print(repr(plant.step(z, np.ones(2))[1].tolist()))\n"
        "assert plant.system().noutputs == 3"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    z0 = model.initial_state(np.ones((1, 2)), np.ones((1, 3)))
    np.testing.assert_allclose(eval(done.stdout), model.system.advance(z0, np.ones(2))[1], rtol=1e-12)


@pytest.mark.skipif(not (shutil.which("octave-cli") or shutil.which("octave")), reason="there is no Octave here")
def test_octave_runs_the_functions(tried: Callable, tmp_path: Path) -> None:
    (found,) = writer("mat")(*tried("quadratic", "x+u+y", 3, (2, 3)), tmp_path, "model")
    assert found.what == "Octave"
    assert found.simulation <= 1e-12


@pytest.mark.system
def test_the_command_exports(
    nnss: Callable, trained: Callable[[str], TrainedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = trained("linear").folder
    done = nnss("export", folder, "--to", "c", "--out", "firmware", "--name", "tank")
    assert done.code == 0, done.err
    assert "C99, float: largest error" in done.out
    assert {path.name for path in Path("firmware").iterdir()} == {"tank.c", "tank.h", "tank.json"}
    again = nnss("export", folder, "--to", "c", "--out", "firmware", "--name", "tank")
    assert (again.code, again.out) == (0, done.out)  # the same files replace nothing
    Path("firmware/tank.c").write_text("mine")
    refused = nnss("export", folder, "--to", "c", "--out", "firmware", "--name", "tank")
    assert (refused.code, Path("firmware/tank.c").read_text()) == (2, "mine")
    assert "Start:" not in done.out
    told = json.loads(nnss("export", folder, "--to", "c", "--out", "other", "--json").out)
    assert told["files"] == [f"other/model.{suffix}" for suffix in ("c", "h", "json")]
    assert [each["what"] for each in told["parity"]] == ["C99, double", "C99, float"]
    monkeypatch.setattr(TrainedModel, "init_window", 20)
    done = nnss("export", folder, "--to", "mat", "--out", "matlab")
    assert done.code == 0, done.err
    assert "Octave" in done.out
    assert "\nStart: the model finds z(0) from the first 20 output samples." in done.out


@pytest.mark.system
def test_the_command_fails_where_the_check_does(
    nnss: Callable, trained: Callable[[str], TrainedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(c99, "_number", lambda value: repr(float(np.float16(value))))
    done = nnss("export", trained("linear").folder, "--to", "c", "--out", "firmware")
    assert done.code == 1
    assert done.err.startswith("nnss: C99, double: ")
    assert done.err.count("\n") == 1
    assert not Path("firmware").exists()
