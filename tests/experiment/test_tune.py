"""The search: what it tries is what it prints, given options stay, validation decides."""

import json
import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nnss_cli.commands.options import as_command_line
from nnss_cli.errors import InputError
from nnss_cli.experiment.tune import Trial, draw, settings_of, tune
from nnss_cli.methods import METHODS, Fit

optuna = pytest.importorskip("optuna")


class Pretending:
    """A method whose validation errors are made up; it keeps the settings it was asked for."""

    def __init__(self, errors: list[float]) -> None:
        self.errors = errors
        self.tried: list[dict] = []

    def fit(self, data: object, order: int, seed: int, settings: dict, on_epoch: Callable) -> Fit:
        self.tried.append(settings)
        for epoch, error in enumerate(self.errors, start=1):
            on_epoch(epoch, 0.0, error)
        return Fit(None, len(self.errors))


def search(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, data: object, overrides: dict, errors: list[float], trials: int = 3
) -> tuple[list[Trial], Pretending]:
    pretending = Pretending(errors)
    monkeypatch.setattr(type(METHODS["nnss"]), "fit", lambda _, *args: pretending.fit(*args))
    monkeypatch.setattr(type(METHODS["nnss"]), "prepare", lambda *_: None)
    found = tune(data, 2, trials, "tpe", 0, overrides, tmp_path / "study.db", lambda _: None)  # type: ignore[arg-type]
    return found, pretending


def test_a_trial_is_worth_its_best_epoch(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable) -> None:
    found, _ = search(monkeypatch, tmp_path, small_data().fitting, {}, [3.0, 1.0, 2.0])
    assert [trial.val_rmse for trial in found] == [1.0] * 3


def test_a_trial_is_worth_the_candidate_taken_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable
) -> None:
    """Epochs of what was tried and not taken are reported, too."""
    fit, history = Pretending.fit, {"val_rmse": [3.0, 2.0], "val_rmse, as it is": [1.0]}
    monkeypatch.setattr(Pretending, "fit", lambda *args: replace(fit(*args), history=history))
    found, _ = search(monkeypatch, tmp_path, small_data().fitting, {}, [3.0, 2.0, 1.0])
    assert [trial.val_rmse for trial in found] == [2.0] * 3


def test_trials_are_not_judged_by_blocks(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable) -> None:
    """Their epochs are of models trained on other parts, judged on what the trial itself trains on."""
    with pytest.raises(InputError, match="judge: tune compares trials epoch by epoch on validation, found blocks"):
        search(monkeypatch, tmp_path, small_data().fitting, {"judge": "blocks"}, [1.0])
    assert not (tmp_path / "study.db").exists()


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"hidden": (7,), "window": 40},
        {"encoder": (5, 5), "consistency": 0.5, "learning_rate": 0.01, "batch": 4},
        {"optimiser": "gauss-newton", "dtype": "float64", "epochs": 3},
        {"window": 30, "stride": 7, "recipe": "paper"},
    ],
)
def test_what_is_given_is_kept_and_what_was_tried_is_what_is_printed(
    given: dict, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable
) -> None:
    data = small_data(K=300).fitting
    found, pretending = search(monkeypatch, tmp_path, data, given, [1.0])
    by_number = sorted(found, key=lambda trial: trial.number)
    for trial, tried in zip(by_number, pretending.tried, strict=True):
        assert {name: trial.settings[name] for name in given} == given
        assert METHODS["nnss"].settings(data, 2, trial.settings) == tried


def test_gauss_newton_is_tried_with_small_generators_alone() -> None:
    """Six layers of 200 units would take it more than ten minutes a trial."""

    def largest(given: dict) -> int:
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        widths = [settings_of(draw(study.ask(), 200, given), given)["hidden"] for _ in range(50)]
        return max(math.prod(hidden) for hidden in widths)

    assert largest({"optimiser": "gauss-newton"}) <= 16**2
    assert largest({}) > 100**4


def test_with_everything_given_there_is_nothing_to_search(small_data: Callable, tmp_path: Path) -> None:
    widths = {"hidden": (7,), "encoder": (3,), "window": 9, "consistency": 0.1}
    for all_of_it in (widths | {"learning_rate": 0.1, "batch": 3}, widths | {"optimiser": "lbfgs"}):
        with pytest.raises(InputError, match="every option that it searches is given"):
            tune(small_data().fitting, 2, 1, "tpe", 0, all_of_it, tmp_path / "study.db", lambda _: None)
    assert not (tmp_path / "study.db").exists()


@given(
    st.integers(1, 6),
    st.integers(8, 200),
    st.integers(20, 400),
    st.floats(1e-4, 1),
    st.floats(1e-4, 1e-2),
    st.booleans(),
)
def test_the_printed_line_gives_the_same_settings_to_the_last_digit(
    depth: int, width: int, window: int, consistency: float, rate: float, fixed: bool
) -> None:
    settings = settings_of(
        {"depth": depth, "width": width, "window": window, "consistency": consistency, "learning_rate": rate},
        {"fixed_encoder": True} if fixed else {},
    )
    assert parsed(as_command_line(settings)) == settings


def parsed(line: str) -> dict:
    """What `nnss train` makes of a line of options."""
    import typer
    from typer.testing import CliRunner

    from nnss_cli.commands.options import with_fit_options
    from nnss_cli.commands.variadic import VariadicCommand

    kept: dict = {}

    @with_fit_options
    def command(changes: dict | None = None) -> None:
        kept.update(changes or {})

    app = typer.Typer()
    app.command(cls=VariadicCommand)(command)
    outcome = CliRunner().invoke(app, shlex.split(line))
    assert outcome.exit_code == 0, outcome.output
    return kept


@pytest.mark.system
def test_the_printed_command_trains_the_trial(nnss: Callable) -> None:
    """`--hidden 7 --window 40` given, it printed 79 79 79 79 and 70."""
    given = ("--hidden", "7", "--window", "40", "--epochs", "2", "--encoder", "3", "--protocol", "strict")
    outcome = nnss("tune", "twotank-sim", "--order", "2", "--trials", "2", *given)
    assert outcome.code == 0, outcome.err
    line = next(line for line in outcome.out.splitlines() if "nnss train" in line)
    trained = nnss(*shlex.split(line.partition("nnss ")[2]))
    assert trained.code == 0, trained.err
    settings = json.loads(Path("results/twotank-sim/strict/runs/nnss-n2-s0/run.json").read_text())["spec"]["settings"]
    assert (settings["hidden"], settings["window"], settings["stride"]) == ([7], 40, 2)
    assert (settings["epochs"], settings["encoder"], settings["optimiser"]) == (2, [3], "adam")


def test_a_study_goes_on_with_the_same_data_and_versions_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable
) -> None:
    search(monkeypatch, tmp_path, small_data(seed=1).fitting, {}, [1.0], trials=1)
    with pytest.raises(InputError, match="holds a study with data [0-9a-f]+ instead of [0-9a-f]+:"):
        search(monkeypatch, tmp_path, small_data(seed=2).fitting, {}, [1.0], trials=1)
    monkeypatch.setattr("nnss_cli.experiment.tune.__version__", "0.0")
    with pytest.raises(InputError, match=r"holds a study with nnss \S+ instead of 0\.0:"):
        search(monkeypatch, tmp_path, small_data(seed=1).fitting, {}, [1.0], trials=1)


def test_a_file_without_a_study_gets_one_and_a_file_of_something_else_is_kept(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable
) -> None:
    """A command that was killed as it began leaves the first."""
    (tmp_path / "study.db").touch()
    found, _ = search(monkeypatch, tmp_path, small_data().fitting, {}, [1.0], trials=1)
    assert [trial.state for trial in found] == ["complete"]
    (tmp_path / "study.db").write_text("my notes\n" * 100)
    with pytest.raises(InputError, match="study.db' is no file of a search: remove it"):
        search(monkeypatch, tmp_path, small_data().fitting, {}, [1.0], trials=1)
    assert (tmp_path / "study.db").read_text() == "my notes\n" * 100


def test_a_trial_that_torch_refuses_is_a_failed_trial(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_data: Callable
) -> None:
    import torch

    def fails(*_: object) -> Fit:
        raise torch.linalg.LinAlgError("singular")

    monkeypatch.setattr(type(METHODS["nnss"]), "fit", fails)
    found = tune(small_data().fitting, 2, 2, "tpe", 0, {}, tmp_path / "study.db", lambda _: None)
    assert [trial.state for trial in found] == ["fail", "fail"]
