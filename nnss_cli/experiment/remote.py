"""What a worker of a cluster does with a run. It loads nothing heavy before `prepare` has had its say."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from nnss_cli.machine import prepare

if TYPE_CHECKING:
    from nnss_cli.datasets.record import Dataset
    from nnss_cli.experiment.executor import Event, Limits, Task
    from nnss_cli.plugins import Source

CHATTER = 0.5  # seconds between epochs that are told

_ONE = threading.Lock()  # runs set seeds and plug-ins of their process: a worker of several threads does one at a time
_LATE = "numpy" in sys.modules  # too late for what `prepare` sets
prepare()


def given(dataset: Dataset) -> Dataset:
    """A dataset as a task: whichever worker has it, or computes it again, has the same."""
    return dataset


def executed(
    task: Task,
    dataset: Dataset,
    limits: Limits,
    plugins: tuple[Source, ...],
    version: str,
    topic: str,
    threads: dict[str, str],
) -> dict[str, bytes] | str:
    """Execute a run in a folder that goes with it, as a sweep on this machine does.

    Args:
        task: which run.
        dataset: what is fitted.
        limits: of the run, which has a process of its own then.
        plugins: files in use where it was asked for.
        version: of nnss there.
        topic: under which it tells of its epochs.
        threads: settings of the numerical libraries there.

    Returns:
        The files of its folder by name; or, in a line, why this worker can execute no run.
    """
    from distributed import get_worker

    from nnss_cli.errors import InputError
    from nnss_cli.experiment.executor import NO_LIMITS, Executor, Serial, seldom
    from nnss_cli.experiment.outcomes import results
    from nnss_cli.experiment.processes import Processes
    from nnss_cli.experiment.store import Store
    from nnss_cli.plugins import in_use, use
    from nnss_cli.version import __version__

    if version != __version__:
        return f"it has nnss {__version__}, expected {version}: install that one there"
    here = {name: os.environ.get(name, "") for name in threads}
    if here != threads or (_LATE and not _started_with(threads)):
        wanted = " ".join(f"{name}={value}" for name, value in threads.items())
        return f"it computes with other threads, which changes last digits: start it with {wanted}"
    worker = get_worker()

    def tell(event: Event) -> None:
        content = {"label": event.spec.label, "epoch": event.epoch, "val_rmse": event.val_rmse}
        content |= {"waits_for": event.waits_for, "begun": event.begun}
        worker.log_event(topic, content)

    heard = seldom(tell, CHATTER)
    with _ONE, tempfile.TemporaryDirectory(prefix="nnss-") as folder:
        store = Store(Path(folder), task.spec.dataset, task.spec.protocol)
        try:
            if in_use() != plugins:
                use(plugins)
            executor: Executor
            if limits == NO_LIMITS:
                executor = Serial(dataset, store, heard)
            else:
                executor = Processes(1, dataset, store, limits, heard)
            with contextlib.closing(executor):
                list(results([task], executor, dataset, store, {}))
        except InputError as error:
            return str(error)
        files = store.run_folder(task.spec).iterdir()
        return {path.name: path.read_bytes() for path in files if path.is_file()}


def _started_with(threads: dict[str, str]) -> bool:
    """Whether this process was started with these settings, so that numpy has heeded them."""
    try:
        started = Path("/proc/self/environ").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return False
    return all(f"{name}={value}" in started for name, value in threads.items())
