"""Write the page."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import Table, agreeing
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store, stores
from nnss_cli.files import write_text
from nnss_cli.report.aggregate import methods_of
from nnss_cli.report.evidence import QUIRKS
from nnss_cli.report.html.looks import LINES, Look, looks_of, variables
from nnss_cli.report.html.overview import Chart, Standing, chart_of, standings
from nnss_cli.report.html.pictures import glyph, key, symbols
from nnss_cli.report.html.record import COLUMNS, LARGEST, section_of
from nnss_cli.report.standing import MEANING, missing_runs, no_ranking, pair_rows, record_table, unscored
from nnss_cli.report.statistics import LEVEL, MIN_RECORDS, mean_ranks, paired_tests
from nnss_cli.report.studies import CHANGES
from nnss_cli.report.tables import FREE, number
from nnss_cli.version import __version__

NAME = "report.html"


@dataclass(frozen=True)
class Overview:
    """The methods over all records of a protocol."""

    protocol: str
    """Split and statistics."""
    standings: list[Standing]
    """On test, by record and order."""
    chart: Chart
    """The same as a chart."""
    quirks: list[str]
    """What a reader must know of the protocol."""
    gaps: list[str]
    """Records that are not in it, runs that are missing."""
    too_few: str
    """Why there is no ranking over records; "" where there is one."""
    ranks: list[tuple[str, float]]
    """Mean rank of each method over records, the lowest first; none where there are too few records."""
    pairs: list[dict[str, str]]
    """Paired tests of every two methods over records; none where there are too few."""


def write_html(out: Path) -> Path:
    """Write report.html of all runs under `out`: one file, with all that it needs in it.

    Raises:
        InputError: there are no finished runs, or a run's file is damaged.
    """
    tables = {store: agreeing(store, store.read()) for store in stores(out)}
    found = {store: table for store, table in tables.items() if table.results}
    if not found:
        raise InputError(f"no finished runs under '{out}': run 'nnss compare DATASET' first, or give --out")
    path = out / NAME
    write_text(path, render(found))
    return path


def render(found: dict[Store, Table]) -> str:
    """The page of these runs."""
    everything = [result for table in found.values() for result in table.results]
    looks = looks_of(methods_of(everything))
    protocols = sorted({store.protocol for store in found})
    script = _file("report.js")
    environment = _environment()
    page = environment.get_template("report.html.j2")
    return page.render(
        version=__version__, script=script, policy=_policy(script), style=_style(environment, list(looks.values())),
        looks=list(looks.values()), symbols=symbols(list(looks.values())), columns=COLUMNS,
        meaning=" ".join(MEANING.replace("*", "").split()),
        overviews=[
            _overview([r for s, t in found.items() if s.protocol == protocol for r in t.results], protocol, looks)
            for protocol in protocols
        ],
        sections=[
            section_of(store, table, looks, f"s{index}")
            for index, (store, table) in enumerate(sorted(found.items(), key=lambda one: one[0].protocol))
        ],
        runs=len(everything), failed=sum(result.status != "ok" for result in everything), largest=LARGEST, free=FREE,
        changes_note=CHANGES.replace("`", ""),
    )  # fmt: skip


def _overview(results: Sequence[RunResult], protocol: str, looks: dict[str, Look]) -> Overview:
    on_test = standings(results, "test", looks)
    table, left_out = record_table(results)
    ranked = len(table) >= MIN_RECORDS and table.shape[1] >= 2
    return Overview(
        protocol, on_test, chart_of(on_test), _items(QUIRKS) if protocol == "paper" else [],
        list(dict.fromkeys([*unscored(results, "test"), *missing_runs(results), *left_out])),
        "" if ranked else no_ranking(*table.shape),
        [(looks[str(name)].label, float(rank)) for name, rank in mean_ranks(table).items()] if ranked else [],
        pair_rows(paired_tests(table)) if ranked else [],
    )  # fmt: skip


def _items(text: str) -> list[str]:
    """The items of a list in Markdown."""
    _, *items = f"\n{text.partition(chr(10) * 2)[2]}".split("\n- ")
    return [" ".join(item.replace("`", "").split()) for item in items]


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("nnss_cli.report.html"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"number": number, "key": key, "glyph": glyph}
    environment.globals["LEVEL"] = LEVEL
    return environment


def _style(environment: Environment, looks: Sequence[Look]) -> Markup:
    themes: dict[str, Any] = {name: variables(looks, dark) for name, dark in (("light", False), ("dark", True))}
    return Markup(environment.get_template("style.css.j2").render(**themes, looks=looks, lines=list(LINES)))


def _file(name: str) -> Markup:
    return Markup((Path(__file__).parent / "templates" / name).read_text(encoding="utf-8"))


def _policy(script: str) -> str:
    """Nothing is loaded, and no script runs but this one: what a name of a run's file smuggles in does neither."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )
