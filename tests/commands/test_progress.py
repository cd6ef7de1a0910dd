"""The bar says what a run is at while it has no epochs to show."""

import io

import pytest
from rich.console import Console

from nnss_cli.commands import display
from nnss_cli.experiment.executor import Event, Serial, Task
from nnss_cli.experiment.run import RunSpec
from nnss_cli.experiment.store import Store
from nnss_cli.methods import METHODS
from nnss_cli.testing import small_dataset


def test_a_fit_says_what_it_waits_for(tmp_path, nnss) -> None:
    data = small_dataset(K=300)
    heard: list[Event] = []
    store = Store(tmp_path, data.name, data.protocol)
    changes = {"epochs": 1, "refine": 1, "initial": "feedback", "hidden": (3,), "integrator": "no", "feedthrough": "no"}
    for name, own in (("nnss", changes), ("ssest", {})):
        settings = METHODS[name].settings(data.fitting, 1, own)
        spec = RunSpec(data.name, data.protocol, name, 1, 0, settings, data.fingerprint(), "1")
        executor = Serial(data, store, heard.append)
        executor.submit(Task(spec))
        executor.wait(1)
    told = {(event.spec.method, event.waits_for, event.begun) for event in heard if event.waits_for}
    assert told >= {
        ("nnss", "compiling", False), ("nnss", "SSEST, to start from", True),
        ("nnss", "saturated feedback, to start from", True), ("ssest", "SSEST from several starts", True),
    }  # fmt: skip
    assert next(event.waits_for for event in heard if event.spec.method == "nnss") == "compiling"
    assert any(event.epoch for event in heard)


def test_the_bar_shows_it_and_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(display, "console", Console(file=screen, force_terminal=True, width=120))
    spec = RunSpec("plant", "own", "nnss", 2, 0, {"epochs": 50}, "0")
    with display.RunProgress([spec]) as bar:
        assert "starting" in bar.progress.tasks[0].fields["state"]
        bar.on_event(Event(spec, waits_for="compiling", begun=False))
        (task,) = bar.progress.tasks[1:]
        assert (task.fields["state"], task.total) == ("compiling", None)  # to and fro
        bar.progress.refresh()
        bar.on_event(Event(spec))
        bar.on_event(Event(spec, waits_for="SSEST, to start from"))
        assert task.fields["state"] == "SSEST, to start from"
        bar.on_event(Event(spec, 5, 0.25))
        assert (task.fields["state"], task.total, task.completed) == ("epoch 5, val 0.2500", 50, 5)
    assert "compiling" in screen.getvalue()
