"""Runs by the thousand over parameters and distributions, on all cores or a Dask cluster, as rows."""

from __future__ import annotations

import json as json_
import sys
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.campaign import page, tables, unit
from pneud.campaign.conduct import Conducted, Conductor
from pneud.campaign.file import Campaign, load_campaign
from pneud.campaign.page import Told, report_name, scaled
from pneud.campaign.plan import RUN, Plan, plan_of
from pneud.campaign.record import Record, rows_of
from pneud.campaign.rows import Rows
from pneud.campaign.sensitivities import SHARES, spread, strongest
from pneud.campaign.unit import ERROR, SEED
from pneud.campaign.workers import DaskWorkers, LocalWorkers, Workers, make_ready
from pneud.compiled import slow
from pneud.loading import Loaded
from pneud.log.files.naming import log_path, new_log
from pneud.log.files.reader import read_log
from pneud.log.files.writer import LogWriter
from pneud.loop.summary import finite
from pneud.replay.lockstep import header_of
from pneud.report.gather import Window, gather
from pneud.report.page import page as report_page
from pneud.rt.outputs import write_whole
from pneud.verbs import JsonOption, ProgressOption, VerbError, require_suffix
from pneud.view.progress import Report, progress

_BUCKETS, _CLOSEUP = 8192, 1_900_000  # of a report
_FRONT = 12  # trials in words
_TELLING = 5  # figures and sensitivities in words


def campaign(
    file: Annotated[str, typer.Argument(metavar="FILE", help="The campaign, a TOML file.")],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="PATH", help="Folder; default the campaign's name. Of one run, its log."
        ),
    ] = None,
    runs: Annotated[
        int | None, typer.Option("--runs", metavar="N", help="Draws, in place of the file's.")
    ] = None,
    jobs: Annotated[
        int, typer.Option("--jobs", metavar="N", help="Processes; as many as there are cores if 0.")
    ] = 0,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler", metavar="ADDRESS", help="Of a Dask cluster, such as tcp://10.0.0.1:8786."
        ),
    ] = None,
    run: Annotated[
        int | None, typer.Option("--run", metavar="K", help="Do this run alone, and show its row.")
    ] = None,
    tune: Annotated[
        int | None,
        typer.Option("--tune", metavar="N", help="Seek what its [tune] says, in so many trials."),
    ] = None,
    reports: Annotated[
        int, typer.Option("--reports", metavar="N", help="Reports of so many of the worst runs.")
    ] = 0,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Do the runs that are missing, and write all of them as a table and a page.

    Returns:
        Exit status: 0; 1 where a run failed, or no values were found with which none does.

    Raises:
        ConfigError: the campaign cannot be run.
        DatabaseError: a DBC cannot be used.
        RecordError: the folder has another campaign, or somebody is at work in it.
        ClusterError: there is no cluster, or nobody in it.
        ExtraError: a library is missing.
        VerbError: an option makes no sense.
    """
    c, text, path = load_campaign(file)
    if runs is not None:
        if not 1 <= runs < 1 << 32:
            raise VerbError(f"--runs {runs}: must be at least 1")
        c = c.model_copy(update={"runs": runs})
    if jobs < 0 or reports < 0:
        raise VerbError("--jobs, --reports: must not be negative")
    if scheduler is not None and jobs:
        raise VerbError("--jobs: a cluster has as many as it has; leave it out beside --scheduler")
    plan = plan_of(c, text, path)
    if tune is not None:
        if scheduler is not None or run is not None or reports:
            raise VerbError("--tune: is done here; leave out --scheduler, --run, --reports")
        if c.tune is None or tune < 1:
            raise VerbError(f"--tune {tune}: needs a table [tune] in {path}, and at least one trial")
        return _tuned(c, plan, (output or Path(c.name)) / "tune", tune, jobs, json, how)
    if run is not None:
        if scheduler is not None or jobs or reports:
            raise VerbError("--run: is done here and alone; leave out --scheduler, --jobs, --reports")
        return _one(plan, run, output, json, how)
    folder = Path(c.name) if output is None else output
    if folder.exists() and not folder.is_dir():
        raise VerbError(f"{folder}: is no folder")
    worst = c.worst or next(iter(plan.figures), "")
    with closing(Record(folder, plan.digest, plan.kept)) as record:
        found, rows = _conducted(plan, record, folder, scheduler, jobs, how)
    told = Told(c.name, file, folder, worst, found.kinds)
    _reports(plan, rows.greatest(worst, reports), folder, how)
    table = tables.write(folder, rows)
    if not tables.parquet():
        print(f"pneud: {tables.LACKS}", file=sys.stderr)
    write_whole(folder / page.NAME, page.page(plan, rows, told))
    summary = _summary(c, plan, rows, found, told, table)
    print(json_.dumps(finite(summary)) if json else _in_words(plan, rows, summary, told))
    return 1 if summary["failed"] else 0


def _tuned(c: Campaign, plan: Plan, folder: Path, total: int, jobs: int, json: bool, how: str) -> int:
    """Trials until there are so many, then the table and the page of all."""
    from pneud.campaign import tune_page  # noqa: PLC0415 - with an extra
    from pneud.campaign.tuning import Tuning, front  # noqa: PLC0415

    assert c.tune is not None
    with closing(Tuning(c, plan, folder)) as tuning:
        try:
            with progress(how) as report:
                trials = tuning.go(total, jobs, report, _say)
        except KeyboardInterrupt:
            _say(f"what is done is kept in {folder}; the same command goes on from there")
            raise
        best = front(trials)
        texts = {t.number: tuning.toml_of(t) for t in tune_page.told(trials)}
        told = tune_page.Tuned(c.name, folder, c.tune.objectives, trials, tuning.runs, texts)
    table = tables.write(folder, told.rows)
    if not tables.parquet():
        print(f"pneud: {tables.LACKS}", file=sys.stderr)
    write_whole(folder / tune_page.NAME, tune_page.page(told))
    better = [t.number for t in tune_page.better(trials)]
    if json:
        found = [{"trial": t.number, "figures": t.figures, "values": texts[t.number]} for t in best]
        result = {"objectives": c.tune.objectives, "trials": len(trials), "runs": told.runs, "front": found}
        places = {"rows": str(table), "page": str(folder / tune_page.NAME)}
        told_so = {"schema": 1, "name": c.name, **result, "better": better, **places, **slow.field()}
        print(json_.dumps(finite(told_so)))
        return 0 if best else 1
    print(f"{c.name}: {len(trials)} trials of {told.runs} runs; {len(best)} on the front")
    print(f"{len(better)} of them better in everything than what is configured")
    titles = tune_page.titles(c.tune.objectives)
    for t in tune_page.told(trials)[:_FRONT]:
        figures = ", ".join(
            f"{title} {tune_page.shown(column, x)}"
            for column, title, x in zip(c.tune.objectives, titles, t.figures, strict=True)
        )
        print(f"trial {t.number}{' (configured)' if t.configured else ''}: {figures}")
    print(table, folder / tune_page.NAME, sep="\n")
    return 0 if best else 1


def _conducted(
    plan: Plan, record: Record, folder: Path, scheduler: str | None, jobs: int, how: str
) -> tuple[Conducted, Rows]:
    """What is missing is done; an end before that says how to go on."""
    workers: Workers | None = None
    try:
        with progress(how) as report:
            begun: Workers = (
                LocalWorkers(plan, jobs) if scheduler is None else DaskWorkers(plan, scheduler, _say)
            )
            workers = begun
            found = Conductor(plan, record, workers, report, _say).go()
    except KeyboardInterrupt:
        _say(f"what is done is kept in {folder}; the same command goes on from there")
        raise
    finally:
        if workers is not None:
            workers.close()
    return found, rows_of(record, plan.columns, plan.total)


def _say(text: str) -> None:
    print(f"pneud: {text}", file=sys.stderr)


def _one(plan: Plan, number: int, output: Path | None, json: bool, how: str) -> int:
    """One run, and with a log where one is wanted."""
    if not 0 <= number < plan.total:
        raise VerbError(f"--run {number}: there are runs 0 … {plan.total - 1}")
    make_ready(plan)
    row = plan.run(number)
    if output is not None:
        if output.suffix and not output.is_dir():
            require_suffix(output, ".mcap", "a log is an MCAP file")
        with progress(how) as report:
            row["log"] = str(_logged(plan, number, output, report))
    if json:
        print(json_.dumps({"schema": 1, **finite(row), **slow.field()}))
    else:
        print("\n".join(f"{name} = {_shown(value)}" for name, value in row.items()))
    return 1 if row[ERROR] else 0


def _logged(plan: Plan, number: int, output: Path, report: Report) -> Path:
    """The log of a run, played by the whole axis."""
    config, _ = plan.config_of(number)
    seed = plan.seed_of(number)
    path = log_path(str(output), "run") if not output.suffix else output
    with new_log(path) as descriptor:
        writers: list[LogWriter] = []

        def begin(loaded: Loaded) -> LogWriter:
            writers.append(LogWriter(descriptor, header_of(loaded, seed=str(seed), campaign_run=str(number))))
            return writers[0]

        def look(done_s: float, of_s: float) -> None:
            report(f"run {number}", done_s, of_s, "s")

        unit.logged(config, seed, begin, look)
        if not writers[0].close() or writers[0].unwritten:
            _say(f"{path}: could not be written whole")
    return path


def _reports(plan: Plan, worst: list[int], folder: Path, how: str) -> None:
    """A log and a report of each run, beside the page; those that are there stay."""
    with progress(how) as report:
        for number in worst:
            html, log = folder / report_name(number), folder / f"run-{number}.mcap"
            if html.exists():
                continue
            log.unlink(missing_ok=True)  # without its report it was cut off
            try:
                path = _logged(plan, number, log, report)
            except Exception as e:
                if not hasattr(e, "exit_code"):
                    raise
                _say(f"run {number}: no report: {e}")
                continue
            gathered = gather(read_log(str(path)), Window(), _BUCKETS, _CLOSEUP)
            write_whole(html, report_page([gathered], None))


def _summary(
    c: Campaign, plan: Plan, rows: Rows, found: Conducted, told: Told, table: Path
) -> dict[str, Any]:
    worst = rows.ordered(told.worst)
    spreads = {name: spread(rows.ordered(name)) for name in plan.figures}
    return {
        "schema": 1,
        "name": c.name,
        "folder": str(told.folder),
        "rows": str(table),
        "page": str(told.folder / page.NAME),
        "runs": len(rows),
        "failed": len(rows.where(ERROR)),
        "failures": [
            {"run": row[RUN], "seed": row[SEED], "error": row[ERROR], "command": page.command(told, row[RUN])}
            for row in map(rows.row, rows.where(ERROR)[: page.FAILED])
        ],
        "done_now": found.runs,
        "took_s": found.took_s,
        "cost_s": found.cost_s,
        "fingerprints": list(found.kinds),
        "figures": {
            name: None
            if s is None
            else {"min": s.least, "max": s.most, "none": s.none}
            | {f"p{share:g}": x for share, x in zip(SHARES, s.shares, strict=True)}
            for name, s in spreads.items()
        },
        "worst": [
            {"run": number, told.worst: float(worst[number])}
            for number in rows.greatest(told.worst, page.WORST)
        ],
        "sensitivities": [r._asdict() for r in strongest(rows, plan.figures, plan.inputs)],
        **slow.field(),
    }


def _in_words(plan: Plan, rows: Rows, s: dict[str, Any], told: Told) -> str:
    rate = f", {s['done_now'] / s['took_s']:.3g} a second" if s["done_now"] and s["took_s"] > 0.0 else ""
    lines = [f"{s['name']}: {s['runs']} runs, {s['done_now']} of them now{rate}; {s['failed']} failed"]
    for name in plan.figures[:_TELLING]:
        words, factor = scaled(name)
        if found := s["figures"][name]:
            low, middle, high = (page.in_words(factor * found[key]) for key in ("min", "p50", "max"))
            lines.append(f"{words}: {low} … {high}, median {middle}")
    for rank in s["sensitivities"][:_TELLING]:
        lines.append(f"{scaled(rank['figure'])[0]} goes with {rank['given']}: {rank['correlation']:+.2f}")
    lines += [f"run {one['run']} is the worst: {page.command(told, one['run'])}" for one in s["worst"][:1]]
    for row in map(rows.row, rows.where(ERROR)[:_TELLING]):
        lines.append(f"failed: {row[ERROR]}: {page.command(told, row[RUN])}")
    return "\n".join([*lines, s["rows"], s["page"]])


def _shown(value: object) -> str:
    return "–" if value is None or value == "" else f"{value:.6g}" if isinstance(value, float) else str(value)
