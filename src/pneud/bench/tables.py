"""The report of a benchmark: one object, and the same as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pneud.bench.sample import Samples, ratio_of_turns
from pneud.loop.summary import finite

COMPARED = ("wakeup", "lateness", "latency", "own")
OURS, KERNEL = "pneud", "cyclictest"
_LEGEND = (
    "wake-up: after the ideal grid, of ticks that slept until it. sensor to command: kernel stamp of the",
    "newest sensor frame to command sent. own work: the same with the record handed over and without",
    "deliberate sleeps; the kernel's waking of the process is in it. CPU: all of the process for each tick.",
)


def as_object(
    series: Mapping[str, Samples],
    missing: Mapping[str, str],
    machine: Mapping[str, Any],
    setting: Mapping[str, Any],
) -> dict[str, Any]:
    """Everything that was found."""
    ours = series.get(OURS)
    ratios = {}
    if ours is not None:
        for name, other in series.items():
            if name != OURS:
                found = {quantity: ratio_of_turns(ours, other, quantity) for quantity in COMPARED}
                ratios[name] = {quantity: ratio for quantity, ratio in found.items() if ratio is not None}
    result = {
        "schema": 1,
        "machine": dict(machine),
        "setting": dict(setting),
        "contestants": {name: one.as_object() for name, one in series.items()},
        "pneud_over": ratios,
        "missing": dict(missing),
        "wakeup_histograms_ns": {
            name: [list(bucket) for bucket in one.histograms["wakeup"].counts()]
            for name, one in series.items()
            if "wakeup" in one.histograms
        },
    }
    cleaned: dict[str, Any] = finite(result)
    return cleaned


def disturbances_in_words(found: Mapping[str, Any]) -> str:
    """What disturbances came to, as text."""
    lines = [f"{'':10}{'own work p99, quiet':>22}{'disturbed':>12}{'ratio':>24}{'skipped':>16}"]
    for name, one in found.items():
        quiet, disturbed, ratio = one["quiet"], one["disturbed"], one["own_over_quiet"]
        shown = _ratio(ratio["p99"]) if ratio else "–"
        p99s = [_cell(side["own_us"]["p99"] if side["own_us"] else None, 12) for side in (quiet, disturbed)]
        skips = f"{quiet['skipped']} → {disturbed['skipped']}"
        lines.append(f"{name:10}{p99s[0]:>19} µs{p99s[1]:>9} µs{shown:>24}{skips:>16}")
    lines += ["", *(f"{name}: {one['what']}" for name, one in found.items())]
    return "\n".join(lines)


def in_words(report: Mapping[str, Any]) -> str:
    """The report as text."""
    m, s = report["machine"], report["setting"]
    lines = [
        f"{m['kernel']}, {m['cpu_model']}, {len(m['cpus'])} CPUs"
        + (f", {m['hypervisor']}" if m["hypervisor"] else "")
        + (f", load {m['load']:g}" if m["load"] is not None else ""),
        f"{s['rate_hz']:g} Hz, {s['scheduling']}, {s['bus']}; {s['pairs']} turns of {s['turn_s']:g} s"
        " each, one after another",
        "",
    ]
    lines += _table(report["contestants"])
    lines += ["", *(f"{name}: {one['what']}" for name, one in report["contestants"].items())]
    lines += ["", *_ours(report)]
    shown = ", ".join(f"{name} {one['skipped']}" for name, one in report["contestants"].items())
    lines.append(f"ticks skipped: {shown}")
    lines += [f"without {name}: {why}" for name, why in report["missing"].items()]
    for name, one in report["contestants"].items():
        lines += [f"{name}: {note}" for note in one["notes"]]
    return "\n".join([*lines, "", *_LEGEND])


def _table(contestants: Mapping[str, Any]) -> list[str]:
    heads = [
        ("", 12),
        ("wake-up", 26),
        ("sensor to command", 20),
        ("own work", 20),
        ("per tick", 9),
        ("highest", 8),
    ]
    rows = ["".join(f"{title:>{width}}" for title, width in heads).rstrip()]
    quantiles = f"{'p50':>6}{'p99':>6}{'p99.9':>7}{'max':>7}"
    short = f"{'p50':>7}{'p99':>6}{'max':>7}"
    rows.append(f"{'µs':12}{quantiles}{short}{short}{'CPU':>9}{'Hz':>8}")
    for name, c in contestants.items():
        row = f"{name:12}{_cells(c['wakeup_us'], (6, 6, 7, 7), ('p50', 'p99', 'p999', 'max'))}"
        for quantity in ("latency_us", "own_us"):
            row += _cells(c[quantity], (7, 6, 7), ("p50", "p99", "max"))
        rate = c["highest_rate_hz"]
        row += _cell(c["cpu_us_per_tick"], 9) + _cell(rate, 8)
        rows.append(row.rstrip())
    return rows


def _cells(figures: Mapping[str, float] | None, widths: Sequence[int], keys: Sequence[str]) -> str:
    return "".join(
        _cell(figures[key] if figures else None, width) for key, width in zip(keys, widths, strict=True)
    )


def _cell(value: float | None, width: int) -> str:
    return f"{'–' if value is None else format(value, '.0f'):>{width}}"


def _ours(report: Mapping[str, Any]) -> list[str]:
    ours = report["contestants"].get(OURS)
    if ours is None:
        return []
    lines = []
    parts = [(name, ours[f"{name}_us"]) for name in ("read", "cycle", "write", "record")]
    if all(figures for _, figures in parts):
        shown = ", ".join(f"{name} {f['p50']:.0f}/{f['p99']:.0f}" for name, f in parts)
        lines.append(f"pneud's tick, µs p50/p99: {shown}")
    if ours["first_tick_ms"] is not None:
        start = ours["first_tick_ms"]
        lines.append(
            f"pneud's first tick: {start['median']:.0f} ms after the start of its process"
            f" ({start['least']:.0f} … {start['greatest']:.0f})"
        )
    if ours["cpu_percent"]:
        shown = ", ".join(f"{name} {percent:.1f} %" for name, percent in ours["cpu_percent"].items())
        lines.append(f"pneud's processes: {shown} of a CPU")
    if ours["switches_per_tick"] is not None:
        switches = ours["switches_per_tick"]
        lines.append(
            f"in pneud's loop: {ours['page_faults']} page faults,"
            f" {switches['voluntary']:.2f} voluntary and {switches['involuntary']:.3f} other switches a tick"
        )
    lines.append(
        f"pneud's ticks: {ours['ticks']}, {ours['skipped']} skipped, {ours['incomplete']} without a whole set"
    )
    late = ours["lateness_us"]
    if late:
        lines.append(
            f"lateness of all ticks of pneud, µs: {late['p50']:.0f} p50, {late['p99']:.0f} p99,"
            f" {late['max']:.0f} max; {ours['overrun']} of them followed one that took too long"
        )
    for name, found in report["pneud_over"].items():
        for quantity, words in (("wakeup", "wake-up"), ("own", "own work")):
            if quantity in found:
                p50, p99 = found[quantity]["p50"], found[quantity]["p99"]
                lines.append(
                    f"pneud over {name}, {words}: p50 {_ratio(p50)}, p99 {_ratio(p99)}"
                    f" ({found[quantity]['pairs']} pairs)"
                )
    return lines


def _ratio(r: Mapping[str, float]) -> str:
    return f"{r['median']:.2f} [{r['lower_quartile']:.2f} … {r['upper_quartile']:.2f}]"
