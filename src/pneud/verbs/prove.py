"""Prove the whole daemon in seeded simulation: all its processes, and everything that may go wrong."""

import json as json_
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from pneud.rt.extras import require
from pneud.verbs import JsonOption, ProgressOption, VerbError
from pneud.view.progress import progress


def prove(
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="The first seed.")] = 0,
    seeds: Annotated[int, typer.Option("--seeds", metavar="COUNT", help="How many.")] = 1,
    minutes: Annotated[
        float | None, typer.Option("--minutes", metavar="M", help="Begin none after so long.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option("--steps", metavar="K", help="End each after so many steps.")
    ] = None,
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="LIST", help="Of what a seed has happen, only these: 2,5; none: -."),
    ] = None,
    keep: Annotated[
        Path | None, typer.Option("--keep", metavar="FOLDER", help="Leave logs and trace of the seed there.")
    ] = None,
    shrink: Annotated[bool, typer.Option(help="Find the fewest faults that a finding takes.")] = True,
    json: JsonOption = False,
    how: ProgressOption = "auto",
) -> int:
    """Run seeds until one fails; it is shrunk, and one line repeats it.

    Returns:
        Exit status: 0, or 1 where an oracle says no.

    Raises:
        VerbError: the options do not go together.
        ExtraError: a library is missing.
    """
    numbers = _numbers(only)
    if seeds < 1 or (minutes is not None and not minutes > 0.0) or (steps is not None and steps < 1):
        raise VerbError("prove: --seeds, --minutes and --steps are numbers above 0")
    if seeds > 1 and (keep is not None or only is not None):
        raise VerbError("prove: --keep and --only are for one seed")
    if keep is not None and keep.exists() and (not keep.is_dir() or any(keep.iterdir())):
        raise VerbError(f"prove: --keep {keep}: is no empty folder")
    require("prove", "prove")
    from pneud.prove.plan import plan_of  # noqa: PLC0415 - what not everybody has
    from pneud.prove.run import Bench, Outcome, shrunk  # noqa: PLC0415

    begun_s, cpu_s = time.monotonic(), time.process_time()
    done: list[Outcome] = []
    told: dict[str, Any] | None = None
    with tempfile.TemporaryDirectory(prefix="pneud-prove-") as folder, progress(how) as report:
        bench = Bench(Path(folder))
        for number in range(seed, seed + seeds):
            if minutes is not None and time.monotonic() - begun_s > 60.0 * minutes:
                break
            report("prove", number - seed, seeds, "seeds")
            plan = plan_of(number)
            if numbers is not None:
                plan = plan.only(_checked(numbers, len(plan.items)))
            if keep is not None:
                keep.mkdir(exist_ok=True)
            outcome = bench.run(plan, steps, keep)
            done.append(outcome)
            if keep is not None:
                (keep / "trace.txt").write_text("\n".join(outcome.trace) + "\n", encoding="utf-8")
            if outcome.found:
                left: tuple[int, ...] = numbers if numbers is not None else tuple(range(len(plan.items)))
                if shrink and numbers is None and steps is None:
                    left, outcome = shrunk(bench, outcome, lambda n: report("shrink", 0, n, "faults"))
                told = _told(number, left, outcome)
                break
    summary = _summary(done, time.process_time() - cpu_s, told)
    if json:
        print(json_.dumps(summary))
    else:
        print(_in_words(summary))
    return 1 if told is not None else 0


def _numbers(only: str | None) -> tuple[int, ...] | None:
    if only is None or only == "-":
        return None if only is None else ()
    try:
        return tuple(int(number) for number in only.split(","))
    except ValueError:
        raise VerbError(f"prove: --only {only}: is a list of numbers, such as 2,5, or -") from None


def _checked(numbers: tuple[int, ...], count: int) -> tuple[int, ...]:
    if any(not 0 <= number < count for number in numbers):
        raise VerbError(f"prove: --only: this seed has {count} things happen, from 0 to {count - 1}")
    return numbers


def _told(seed: int, left: tuple[int, ...], outcome: Any) -> dict[str, Any]:
    finding = outcome.found[0]
    return {
        "seed": seed,
        "oracle": finding.oracle,
        "words": finding.words,
        "t_s": finding.t_s,
        "step": finding.step,
        "happens": [str(item) for item in outcome.plan.items],
        "again": f"pneud prove --seed {seed} --only {','.join(map(str, left)) or '-'}",
        "trace": list(outcome.trace[-20:]),
    }


def _summary(done: list[Any], cpu_s: float, told: dict[str, Any] | None) -> dict[str, Any]:
    simulated_s = sum(one.simulated_s for one in done)
    return {
        "schema": 1,
        "seeds": len(done),
        "steps": sum(one.steps for one in done),
        "simulated_s": round(simulated_s, 3),
        "ticks": sum(one.ticks for one in done),
        "engaged_ticks": sum(one.engaged_ticks for one in done),
        "sessions": sum(one.sessions for one in done),
        "minutes_per_core_hour": round(60.0 * simulated_s / cpu_s, 1) if cpu_s > 0.0 else None,
        "digest": done[0].digest if len(done) == 1 else None,
        "finding": told,
    }


def _in_words(s: dict[str, Any]) -> str:
    lines = [
        f"{s['seeds']} seed{'' if s['seeds'] == 1 else 's'}: {s['simulated_s']:.1f} s simulated,"
        f" {s['ticks']} ticks, {s['engaged_ticks']} of them engaged, {s['sessions']} sessions,"
        f" {s['steps']} steps; {s['minutes_per_core_hour']:.0f} min in an hour of one core"
    ]
    if s["digest"]:
        lines.append(f"digest {s['digest']}")
    if (found := s["finding"]) is None:
        return "\n".join([*lines, "no finding"])
    lines += [f"seed {found['seed']}: {found['oracle']}: {found['words']}", *found["trace"], "it takes:"]
    lines += [f"  {words}" for words in found["happens"]] or ["  nothing at all"]
    return "\n".join([*lines, f"again: {found['again']}"])
