"""What the commands show: progress, tables, one line a finished run."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import typer
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

from nnss_cli.commands.events import emit, emitting
from nnss_cli.commands.layout import lines_of
from nnss_cli.errors import InputError
from nnss_cli.experiment.estimate import Estimate, is_combined
from nnss_cli.experiment.executor import Event
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.report.cells import Cell, plain, whole

# names and units are the user's: '[cm]' is no style and ':up:' no picture
console = Console(markup=False, emoji=False)


class _Csv:
    """What `--csv` prints: the first table of a command, and further ones of the same columns."""

    def __init__(self) -> None:
        self.columns: list[str] | None = None

    def write(self, rows: Sequence[dict[str, Any]]) -> None:
        names = list(dict.fromkeys(name for row in rows for name in row))
        if self.columns not in (None, names):
            return
        text = io.StringIO()
        writer = csv.DictWriter(text, names, lineterminator="\n")
        if self.columns is None:
            writer.writeheader()
            self.columns = names
        writer.writerows(rows)
        typer.echo(text.getvalue(), nl=False)


_CSV: ContextVar[_Csv | None] = ContextVar("csv", default=None)


def print_rows(
    rows: Sequence[Mapping[str, str]], title: str, text_columns: int = 2, heads: Mapping[str, str] | None = None,
    about: Mapping[str, str] | None = None,
) -> None:  # fmt: skip
    """A table: lines for people, an event or CSV for machines, who get numbers in full precision.

    Args:
        rows: cells by name, the same names in each.
        title: stands above it.
        text_columns: so many columns say what a row is; the others are its numbers, to the right.
        heads: name → header, where it is another one, with a unit as its second line.
        about: what machines are told of all rows, and people in the title.
    """
    told = [dict(about or {}) | row for row in plain(rows)]
    if (table := _CSV.get()) is not None:
        table.write(told)
    emit("table", title=title, rows=told)
    if console.quiet:
        return
    console.print(title, style="italic", highlight=False)
    header, *body = lines_of(rows, heads or {}, text_columns, console.width)
    console.print(header, style="bold", highlight=False, soft_wrap=True)
    for line in body:
        console.print(line, highlight=False, soft_wrap=True)
    console.print()


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
        self.overall = self.progress.add_task("all runs", total=work, state=f"0/{self.total}, starting")
        self.tasks: dict[str, Any] = {}
        self.shown: dict[str, int] = {}  # epochs of a run that count; candidates and stages may take more

    def __enter__(self) -> RunProgress:
        self.progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.progress.stop()

    def on_event(self, event: Event) -> None:
        """Show a run's epoch, or what it is at before there is one."""
        label = event.spec.label
        if event.epoch:
            emit("epoch", run=event.spec.name, epoch=event.epoch, val_rmse=event.val_rmse)
        elif not event.waits_for:
            emit("start", run=event.spec.name)
        if label not in self.tasks:  # without a total the bar moves to and fro
            self.tasks[label] = self.progress.add_task(f"  {describe(event.spec)}", total=None, state="")
            self.progress.update(self.overall, state=f"{self.finished}/{self.total}")
        if event.waits_for:
            self.progress.update(self.tasks[label], total=None, state=event.waits_for)
        elif event.epoch:
            self.progress.update(
                self.tasks[label],
                total=_work(event.spec),
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
            "result", run=result.spec.name, status=result.status, reason=result.reason,
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
        took = f"{result.fit_seconds:.1f} s{', with its members' * is_combined(result.spec)}"
        line = f"[{self.finished}/{self.total}] {describe(result.spec)}: {outcome} ({took})"
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
            "method": group.method, "order": whole(group.order), "runs": whole(group.runs),
            "each": Cell("–" if group.seconds is None else f"{group.seconds:.3g} s", group.seconds),
        }
        for group in expected.groups
    ]  # fmt: skip


@contextlib.contextmanager
def output(quiet: bool, as_json: bool, as_csv: bool = False) -> Iterator[None]:
    """Within it commands say nothing to people on stdout where they are to be quiet, or to tell machines.

    Raises:
        InputError: both forms are asked for.
    """
    if as_json and as_csv:
        raise InputError("expected --json or --csv, found both: leave one out")
    before = console.quiet
    console.quiet = quiet or as_json or as_csv
    token = _CSV.set(_Csv() if as_csv else None)
    try:
        with emitting(as_json):
            yield
    finally:
        console.quiet = before
        _CSV.reset(token)


def tell_files(files: Iterable[Path], **about: Any) -> None:
    """The files that a command wrote, which end it: their names for people, an event for machines."""
    names = [str(path) for path in files]
    for name in names:
        console.print(name, soft_wrap=True, highlight=False)
    emit("end", files=names, **about)


def tell_left_out(lines: Iterable[str]) -> None:
    """Name on stderr what is damaged or disagrees, and so in no table."""
    for line in dict.fromkeys(lines):
        typer.echo(f"nnss: left out: {line}", err=True)


def describe(spec: RunSpec) -> str:
    """A run in words."""
    return f"{spec.dataset} {spec.method} n={spec.order} seed {spec.seed}"


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
