"""What the commands show: progress, tables, one line a finished run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import typer
from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from nnss_cli.commands.events import emit, emitting
from nnss_cli.experiment.estimate import Estimate
from nnss_cli.experiment.executor import Event
from nnss_cli.experiment.run import RunResult, RunSpec

# names and units are the user's: '[cm]' is no style and ':up:' no picture
console = Console(markup=False, emoji=False)


def print_rows(rows: Sequence[dict[str, str]], title: str, text_columns: int = 2) -> None:
    """A table of text cells: the first `text_columns` to the left, numbers to the right."""
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for index, name in enumerate(rows[0]):
        table.add_column(
            name, justify="left" if index < text_columns else "right", no_wrap=index < text_columns, overflow="fold"
        )
    for row in rows:
        table.add_row(*row.values())
    console.print(table)


class RunProgress:
    """A bar over all runs with the time to go, and a line for each run that is under way.

    Work is counted in epochs, since runs differ widely; early stopping makes the time to go an
    upper estimate. Where the output is no terminal, each finished run is one line.
    """

    def __init__(self, specs: Sequence[RunSpec]) -> None:
        self.total = len(specs)
        self.finished = 0
        self.progress = Progress(
            SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=24),
            TextColumn("{task.fields[state]}"), TimeElapsedColumn(), TextColumn("to go"), TimeRemainingColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        work = sum(_work(spec) for spec in specs)
        self.overall = self.progress.add_task("all runs", total=work, state=f"0/{self.total}")
        self.tasks: dict[str, Any] = {}
        self.shown: dict[str, int] = {}  # epochs of a run that count; candidates and stages may take more

    def __enter__(self) -> RunProgress:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def on_event(self, event: Event) -> None:
        """Show a run's epoch."""
        label = event.spec.label
        if event.epoch:
            emit("epoch", run=name_of(event.spec), epoch=event.epoch, val_rmse=event.val_rmse)
        else:
            emit("start", run=name_of(event.spec))
        if label not in self.tasks:
            self.tasks[label] = self.progress.add_task(f"  {describe(event.spec)}", total=_work(event.spec), state="")
        if event.epoch:
            self.progress.update(
                self.tasks[label],
                completed=event.epoch,
                state=f"epoch {event.epoch}, val {event.val_rmse:.4f}",
            )
            counted = min(event.epoch, _work(event.spec))
            self.progress.advance(self.overall, counted - self.shown.get(label, 0))
            self.shown[label] = counted

    def on_result(self, result: RunResult) -> None:
        """Count a finished run."""
        self.finished += 1
        emit(
            "result", run=name_of(result.spec), status=result.status, reason=result.reason,
            fit_seconds=result.fit_seconds, scores=[vars(score) for score in result.scores],
            finished=self.finished, of=self.total,
        )  # fmt: skip
        task = self.tasks.pop(result.spec.label, None)
        if task is not None:
            self.progress.remove_task(task)
        self.progress.update(
            self.overall,
            advance=_work(result.spec) - self.shown.pop(result.spec.label, 0),
            state=f"{self.finished}/{self.total}",
        )
        outcome = result.status if result.status == "ok" else f"{result.status}: {result.reason}"
        line = f"[{self.finished}/{self.total}] {describe(result.spec)}: {outcome} ({result.fit_seconds:.1f} s)"
        if not console.is_terminal:
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif result.status != "ok":
            self.progress.console.print(line, markup=False, style="yellow")

    def tell(self, line: str) -> None:
        """A line beside the bar."""
        self.progress.console.print(line, soft_wrap=True, highlight=False)


def plan_rows(expected: Estimate) -> list[dict[str, str]]:
    """What there is to do, by method and order."""
    return [
        {
            "method": group.method, "order": str(group.order), "runs": str(group.runs),
            "each": "–" if group.seconds is None else f"{group.seconds:.3g} s",
        }
        for group in expected.groups
    ]  # fmt: skip


@contextlib.contextmanager
def output(quiet: bool, as_json: bool) -> Iterator[None]:
    """Within it commands say nothing to people on stdout where they are to be quiet, or to print events."""
    before = console.quiet
    console.quiet = quiet or as_json
    try:
        with emitting(as_json):
            yield
    finally:
        console.quiet = before


def tell_left_out(lines: Iterable[str]) -> None:
    """Name on stderr what is damaged or disagrees, and so in no table."""
    for line in dict.fromkeys(lines):
        typer.echo(f"nnss: left out: {line}", err=True)


def describe(spec: RunSpec) -> str:
    """A run in words."""
    return f"{spec.dataset} {spec.method} n={spec.order} seed {spec.seed}"


def name_of(spec: RunSpec) -> str:
    """A run's name, as `nnss results` takes it."""
    return f"{spec.dataset}/{spec.protocol}/{spec.label}"


def _work(spec: RunSpec) -> int:
    return int(spec.settings.get("epochs", 1))


class DownloadProgress:
    """The progress-bar object that pooch asks for, drawn by rich."""

    def __init__(self, name: str) -> None:
        self.progress = Progress(
            TextColumn("{task.description}"), BarColumn(), DownloadColumn(), console=console, transient=True,
            disable=not console.is_terminal,
        )  # fmt: skip
        self.task = self.progress.add_task(name, total=None)
        self.progress.start()

    @property
    def total(self) -> float | None:
        """Bytes expected."""
        return self.progress.tasks[0].total

    @total.setter
    def total(self, value: float) -> None:
        self.progress.update(self.task, total=value or None)

    def update(self, count: int) -> None:
        """Bytes more."""
        self.progress.advance(self.task, count)

    def reset(self) -> None:
        """Back to zero."""
        self.progress.reset(self.task)

    def close(self) -> None:
        """Take the bar away."""
        self.progress.stop()
