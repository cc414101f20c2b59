"""Values that make several figures small over all runs of a campaign at once, sought by Optuna.

A trial is all runs of the campaign with the values in question: the same draws for every trial, on all cores.
One trial comes after the other, and what is suggested for it depends on those before it and on the seed
alone: not on how many processes there are, nor on whether it was interrupted.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Any, NamedTuple

from pneud.campaign import unit
from pneud.campaign.draws import drawn, share
from pneud.campaign.file import Campaign, Parameter, Tune
from pneud.campaign.plan import Plan
from pneud.campaign.record import Chunk, RecordError
from pneud.campaign.unit import ERROR, Row
from pneud.campaign.workers import LocalWorkers
from pneud.config.sections import ConfigError
from pneud.rt.extras import require
from pneud.view.progress import Report

JOURNAL, STUDY = "tune.journal", "pneud"
NEVER = 1e6  # stands for a figure that a run lacks: greater than any
FIRST = 10  # trials anywhere, before what came of them tells where to look
LOST = 3  # times that processes may be killed during a trial
Value = float | int | bool | str


class Trial(NamedTuple):
    """Values that were tried."""

    number: int
    values: dict[str, Value]  # by parameter
    figures: tuple[float, ...]  # in the order of the objectives
    configured: bool = False  # those of the file

    @property
    def whole(self) -> bool:
        """Every run had every figure."""
        return all(x < NEVER for x in self.figures)

    def beats(self, other: Trial) -> bool:
        """Nothing is worse, and something better."""
        pairs = list(zip(self.figures, other.figures, strict=True))
        return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def front(trials: Sequence[Trial]) -> list[Trial]:
    """Those that no other one beats, the best by the first objective first; of equal ones the first."""
    kept: dict[tuple[float, ...], Trial] = {}
    for one in trials:
        if one.whole and not any(other.beats(one) for other in trials):
            kept.setdefault(one.figures, one)
    return sorted(kept.values(), key=lambda t: t.figures)


def statistic(values: Sequence[float], which: str) -> float:
    """The mean, the greatest, or the value that so many in a hundred do not exceed (nearest rank)."""
    if which == "mean":
        return NEVER if max(values) >= NEVER else math.fsum(values) / len(values)
    rank = len(values) if which == "max" else max(1, math.ceil(0.01 * int(which[1:]) * len(values)))
    return sorted(values)[rank - 1]


class Tuning:
    """A study in a folder.

    Args:
        c: the campaign, with what is to be tuned.
        plan: of it.
        folder: made where it is missing.

    Raises:
        ExtraError: Optuna is missing.
        ConfigError: an objective is none of the figures, or the values are none of a configuration.
        RecordError: the folder has another study, or somebody is at work in it.
        OSError: it cannot be written.
    """

    def __init__(self, c: Campaign, plan: Plan, folder: Path) -> None:
        require("--tune", "tune")
        assert c.tune is not None
        self.tune: Tune = c.tune
        plan = plan.with_all_columns()
        for column in self.tune.objectives:
            if column not in plan.figures:
                raise ConfigError(f"tune.objectives.{column}: no such figure; has {', '.join(plan.figures)}")
        self._plan = plan._replace(runs=self.tune.runs or plan.runs)
        self.runs = self._plan.total  # of a trial
        self._check()
        self._journal = folder / JOURNAL
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = (folder / f"{JOURNAL}.busy").open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise RecordError(f"{folder}: somebody is at work in it; end that, or wait for it") from None
        self._study = self._begun(folder)

    def _begun(self, folder: Path) -> Any:
        import optuna  # noqa: PLC0415 - an extra, and slow to load
        from optuna.storages.journal import JournalFileBackend  # noqa: PLC0415

        optuna.logging.set_verbosity(optuna.logging.ERROR)
        held: Any = _Held()
        told = [self._plan.digest, self._plan.runs, self.tune.model_dump(mode="json")]
        digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:32]
        self._cut()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # parts of it are said to be new
            study = optuna.create_study(
                storage=optuna.storages.JournalStorage(JournalFileBackend(str(self._journal), held)),
                study_name=STUDY,
                directions=["minimize"] * len(self.tune.objectives),
                load_if_exists=True,
            )
        if study.user_attrs.setdefault("tuning", digest) != digest:
            raise RecordError(
                f"{folder}: holds another tuning, or this one before its file was changed;"
                " name another folder with -o, or remove it"
            )
        study.set_user_attr("tuning", digest)
        return study

    def _cut(self) -> None:
        """Take the half line off that a kill has left: the next one would go on in it."""
        with self._journal.open("a+b") as file:
            file.seek(0)
            file.truncate(file.read().rfind(b"\n") + 1)

    def _check(self) -> None:
        """Make sure that the values are some that a configuration has.

        Raises:
            ConfigError: they are not.
        """
        config, _ = self._with(self._configured() or self._middle()).config_of(0)
        try:
            unit.prepared(config, drawn(config["spread"], self._plan.seed_of(0)))
        except ConfigError as e:
            raise ConfigError(f"tune.parameters: {e}") from None

    def _middle(self) -> dict[str, Value]:
        found: dict[str, Value] = {}
        for name, p in self.tune.parameters.items():
            low, high = p.uniform or p.loguniform or (0.0, 0.0)
            found[name] = (
                p.choice[0] if p.choice else math.sqrt(low * high) if p.loguniform else 0.5 * (low + high)
            )
        return found

    def close(self) -> None:
        """Let others tune."""
        self._lock.close()

    def _configured(self) -> dict[str, Value] | None:
        """The values that the file has; None where they are beyond what is looked through."""
        base = self._plan.bases[0]
        found: dict[str, Value] = {}
        for name, p in self.tune.parameters.items():
            value = 1.0 if p.times else _value(base, (p.keys or (name,))[0])
            bounds = p.uniform or p.loguniform
            if value is None or (
                not bounds[0] <= float(value) <= bounds[1] if bounds else value not in (p.choice or ())
            ):
                return None
            found[name] = value
        return found

    def go(self, total: int, jobs: int, report: Report, say: Callable[[str], None]) -> list[Trial]:
        """Try until there are so many trials.

        Args:
            total: of trials, with those that are there.
            jobs: processes; as many as there are cores if 0.
            report: told how many trials there are.
            say: told what a person should know.

        Returns:
            All of them.
        """
        trials = self.trials()
        report("tuning", len(trials), total, "trials")
        if len(trials) >= total:
            return trials
        workers = _Tryouts(self._plan, jobs)
        try:
            while len(trials) < total:
                number, values = self._next()
                rows = workers.rows_of(self._with(values), say)
                self._study.tell(number, self._figures(rows))
                trials = self.trials()
                report("tuning", len(trials), total, "trials")
        finally:
            workers.close()
        return trials

    def trials(self) -> list[Trial]:
        """Those that are done."""
        from optuna.trial import TrialState  # noqa: PLC0415

        configured = self._configured()
        found = self._study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        return [
            Trial(
                number,
                {name: t.params[name] for name in self.tune.parameters},
                tuple(t.values),
                t.params == configured,
            )
            for number, t in enumerate(found)
        ]

    def _next(self) -> tuple[int, dict[str, Value]]:
        """The trial that was interrupted, else another one."""
        from optuna.samplers import TPESampler  # noqa: PLC0415
        from optuna.trial import TrialState  # noqa: PLC0415

        found = self._study.get_trials(deepcopy=False)
        running = [t for t in found if t.state == TrialState.RUNNING]
        space = {name: _distribution(p) for name, p in self.tune.parameters.items()}
        if running and set(running[0].params) == set(space):
            return running[0].number, dict(running[0].params)
        for t in running:  # it was killed while its values were being chosen
            self._study.tell(t.number, state=TrialState.FAIL)
        number = sum(t.state == TrialState.COMPLETE for t in found)
        first = None if number or any(t.state == TrialState.WAITING for t in found) else self._configured()
        if first is not None:
            self._study.enqueue_trial(first)
        seed = int(share(self._plan.seed, f"tune {number}") * 2**31)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self._study.sampler = TPESampler(seed=seed, multivariate=True, n_startup_trials=FIRST)
            trial = self._study.ask(space)
        return trial.number, dict(trial.params)

    def _with(self, values: Mapping[str, Value]) -> Plan:
        """The runs with values in place of those of the file."""
        bases = []
        for base in self._plan.bases:
            own: dict[str, Any] = {}
            for name, p in self.tune.parameters.items():
                for key in p.keys or (name,):
                    own[key] = float(values[name]) * unit.base_of(base, key) if p.times else values[name]
            bases.append({**base, "values": {**base["values"], **own}})
        return self._plan._replace(bases=tuple(bases))

    def _figures(self, rows: Sequence[Row]) -> list[float]:
        return [
            min(NEVER, statistic([_figure(row, column) for row in rows], which))
            for column, which in self.tune.objectives.items()
        ]

    def toml_of(self, trial: Trial) -> dict[str, Value]:
        """Keys of the configuration and what they are in a trial."""
        base = self._with(trial.values).bases[0]["values"]
        keys = [key for name, p in self.tune.parameters.items() for key in p.keys or (name,)]
        return {key: base[key] for key in keys}


def _figure(row: Row, column: str) -> float:
    """A run's figure; that of one that failed, or never came to it, is greater than any."""
    value = row[column]
    if row[ERROR] or not isinstance(value, int | float) or not math.isfinite(value):
        return NEVER
    return float(value)


def _value(base: Mapping[str, Any], key: str) -> Value | None:
    found: Any = base["tables"]
    for step in key.split("."):
        found = found.get(step) if isinstance(found, Mapping) else None
    return found if isinstance(found, Value) else None


def _distribution(p: Parameter) -> Any:
    from optuna.distributions import CategoricalDistribution, FloatDistribution  # noqa: PLC0415

    if p.choice is not None:
        return CategoricalDistribution(p.choice)
    low, high = p.uniform or p.loguniform or (0.0, 1.0)
    return FloatDistribution(low, high, log=p.loguniform is not None)


class _Held:
    """A lock for Optuna, whose own ones outlive a kill: nobody else is in the folder as it is."""

    def acquire(self) -> bool:
        """Have it."""
        return True

    def release(self) -> None:
        """Keep it."""


class _Tryouts(LocalWorkers):
    """Processes that do all runs of one trial after another."""

    def rows_of(self, plan: Plan, say: Callable[[str], None]) -> list[Row]:
        """All of its rows, in their order."""
        self._plan = plan
        size = max(1, math.ceil(plan.total / (2 * self.width())))
        for attempt in range(LOST):
            try:
                out: list[Future[Chunk]] = [
                    self.submit((begin, min(begin + size, plan.total)))
                    for begin in range(0, plan.total, size)
                ]
                chunks = [future.result() for future in out]
            except Exception as e:
                if not self.lost(e) or attempt == LOST - 1:
                    raise
                self.renew(say)
                continue
            return [dict(zip(plan.kept, cells, strict=True)) for chunk in chunks for cells in chunk.rows]
        raise AssertionError("unreachable")
