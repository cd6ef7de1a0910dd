"""`nnss compare`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from nnss_cli.commands import options as opt
from nnss_cli.commands.record_options import with_record_options

if TYPE_CHECKING:
    from nnss_cli.experiment.run import RunResult


@with_record_options
@opt.with_fit_options
def command(
    dataset: opt.DatasetName,
    orders: opt.Orders = None,
    seeds: opt.Seeds = 10,
    methods: opt.MethodNames = None,
    protocol: opt.ProtocolName = "",
    out: opt.Out = Path("results"),
    jobs: opt.Jobs = None,
    mirror: opt.Mirror = None,
    offline: opt.Offline = False,
    force: opt.Force = False,
    retry_failed: opt.RetryFailed = False,
    fail_fast: opt.FailFast = False,
    time_limit: opt.TimeLimit = None,
    memory_limit: opt.MemoryLimit = None,
    executor: opt.ExecutorName = "local",
    scheduler: opt.Scheduler = "",
    dry_run: opt.DryRun = False,
    yes: opt.Yes = False,
    formats: opt.Formats = None,
    columns: opt.Columns = None,
    changes: dict[str, Any] | None = None,
    own: dict[str, Any] | None = None,
) -> None:
    """Run methods × orders × seeds, keep every run, and write the table and the figures.

    Finished runs are not repeated: after an interruption the same command goes on. Several commands may share
    a folder and its work. Exit code: 0 every run has a result, 1 some have none (the table counts them), 2 wrong
    input or nowhere to write, 130 interrupted.
    """
    from nnss_cli.commands.data import ready
    from nnss_cli.commands.display import RunProgress, console, plan_rows, print_rows, tell_files, tell_left_out
    from nnss_cli.commands.events import emit
    from nnss_cli.errors import InputError
    from nnss_cli.experiment.agreement import agreeing
    from nnss_cli.experiment.estimate import DAY, Forecast, amount, duration, estimate
    from nnss_cli.experiment.executor import Limits
    from nnss_cli.experiment.store import Store
    from nnss_cli.experiment.sweep import AGAIN, plan, sweep
    from nnss_cli.files import require_writable
    from nnss_cli.methods import select
    from nnss_cli.report.comparison import write_comparison
    from nnss_cli.report.style import Look
    from nnss_cli.report.tables import error_tables, failures, options_apart, remarks

    look = Look(tuple(formats or ()), columns)
    workers = opt.check_counts(seeds, jobs)
    if scheduler:
        workers = 1  # how many a cluster has is not ours to know: times are those of one
    limits = Limits(time_limit, None if memory_limit is None else memory_limit * 1e9)
    opt.check_executor(executor, scheduler)
    chosen = select(methods or [])
    ready_data = ready(dataset, protocol, mirror, offline, own or {})
    data = ready_data.dataset
    store = Store(out, data.name, data.protocol)
    todo = plan(
        store, data, chosen, ready_data.orders_or(orders), range(seeds), ready_data.settings | (changes or {}),
        force, retry_failed, dry_run,
    )  # fmt: skip
    engines = {spec.settings["engine"] for spec in todo.todo if "engine" in spec.settings}
    console.print(
        f"{data.name}, protocol {data.protocol}: {len(todo.todo)} runs to do, {len(todo.done)} done already"
        + (f" (NN-SS engine: {', '.join(engines)})" if engines else ""),
        highlight=False,
    )
    for line in todo.made_elsewhere():
        console.print(f"Note: {line}", soft_wrap=True, highlight=False)
    again = sorted(result.status for result in todo.done if result.status in AGAIN)
    if again:
        statuses = ", ".join(dict.fromkeys(again))
        console.print(f"Note: {len(again)} of the finished runs: {statuses}; --retry-failed tries them again")
    expected = estimate(todo.todo, todo.found.results, workers)
    if todo.todo:
        if expected.unknown:
            console.print(f"Planned: {amount(todo.todo)}", soft_wrap=True, highlight=False)
        more = f", and what {', '.join(expected.unknown)} takes: no earlier run tells" if expected.unknown else ""
        console.print(
            f"Expected: about {duration(expected.seconds)}{' of one worker' * bool(scheduler)}{more}",
            soft_wrap=True,
            highlight=False,
        )
    emit(
        "plan", dataset=data.name, protocol=data.protocol, runs=len(todo.todo), done=len(todo.done),
        expected_seconds=expected.seconds, unknown=expected.unknown, left_out=list(todo.faults.values()),
    )  # fmt: skip
    if dry_run:
        if todo.todo:
            print_rows(plan_rows(expected), "To do, if nothing stops early")
        return
    if expected.seconds > DAY and not yes:
        raise InputError(f"this will take about {duration(expected.seconds)}: --yes starts it all the same")
    require_writable(store.folder)
    forecast = Forecast(todo.todo, todo.found.results, workers)

    def on_result(result: RunResult) -> None:
        progress.on_result(result)
        left = forecast.after(result)
        if left is not None and left.groups:
            long = "; Ctrl-C keeps the finished runs" if left.seconds > DAY else ""
            progress.tell(f"Expected, as the first runs tell: about {duration(left.seconds)} more{long}")
            emit("forecast", expected_seconds=left.seconds)

    with RunProgress(todo.todo) as progress:
        try:
            sweep(todo.todo, data, store, workers, progress.on_event, on_result, limits, fail_fast, scheduler)
        except KeyboardInterrupt:
            progress.progress.stop()
            left = len(todo.todo) - progress.finished
            raise InterruptedError(
                f"interrupted: finished runs are kept in '{store.folder}', {left} are left; "
                "the same command goes on from here"
            ) from None
    left = len(todo.todo) - progress.finished
    if left:
        console.print(f"Stopped at the first run without a result (--fail-fast): {left} are left", highlight=False)
    table = agreeing(store, store.read(todo.found) if todo.todo else todo.found, todo.faults)
    tell_left_out(table.left_out)
    asked = [result for result in table.results if result.spec.label in todo.labels]
    if not asked:
        emit("end", files=[], left_out=table.left_out)
        raise typer.Exit(1)
    files = write_comparison(store, table=table, look=look)
    for shown in error_tables(asked):
        print_rows(shown.rows, shown.title, heads=shown.heads, about=shown.about)
    for shown in error_tables(asked, apart=True):
        title = f"{shown.title}; made of runs of this folder, so no independent competitor"
        print_rows(shown.rows, title, heads=shown.heads, about=shown.about)
    others = len(table.results) - len(asked)
    if others:
        console.print(f"{others} other runs in this folder are in its files, not in this table.", highlight=False)
    notes = [*data.notes, *options_apart(asked)]
    for line in [*(f"Note: {note}" for note in notes), *failures(asked), *remarks(asked)]:
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    tell_files(files, left_out=table.left_out)
    if table.left_out or any(result.status != "ok" for result in asked):
        raise typer.Exit(1)
