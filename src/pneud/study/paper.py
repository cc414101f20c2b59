"""The whole reproduction as one object, and as JSON."""

from __future__ import annotations

from itertools import chain
from typing import Any, NamedTuple

from pneud.loop.summary import finite
from pneud.study import reproduction as r
from pneud.study.claims import Bound, Claim, bounds, claims
from pneud.study.convergence import Convergence, converge
from pneud.view.progress import Report, each, silent

PICTURED = ((0.01, "implicit"), (0.001, "implicit"), (0.01, "explicit"))


class Reproduction(NamedTuple):
    """Everything `pneud reproduce` found out."""

    start: str  # the initial state, in words
    main: tuple[r.PaperRow, ...]
    ablation: tuple[r.PaperRow, ...]
    orifice: tuple[r.PaperRow, ...]
    convergence: Convergence
    claims: tuple[Claim, ...]
    bounds: tuple[Bound, ...]
    traces: dict[r.Setting, r.Trace]  # of the runs with PICTURED sample times and forms, without reverse flow

    @property
    def good(self) -> bool:
        """Whether every bound is met."""
        return all(b.met for b in self.bounds)


def reproduce(report: Report = silent) -> Reproduction:
    """Run everything: half a minute with numba, some minutes without.

    Args:
        report: told how many runs are done.
    """
    known: dict[r.Setting, r.PaperRun] = {}
    settings = [tuple(found()) for found in (r.main_settings, r.ablation_settings, r.orifice_settings)]
    wanted = list(dict.fromkeys(chain(*settings)))
    for s in each(wanted, report, "the paper's runs", len(wanted), "runs"):
        known[s] = r.run(s)
    main, ablation, orifice = (tuple(known[s].row for s in found) for found in settings)
    convergence = converge(report)
    plant = r.paper_loop(1).plant
    return Reproduction(
        start=f"x1(0) = {plant.initial_x1:g} m, at rest, P2(0) = {plant.initial_p2_pa / 1e5:g} bar,"
        " P1(0) by force balance",
        main=main,
        ablation=ablation,
        orifice=orifice,
        convergence=convergence,
        claims=tuple(claims(main, ablation, convergence)),
        bounds=tuple(bounds(main, convergence)),
        traces={
            row.setting: known[row.setting].trace
            for row in main
            if not row.setting.reverse_flow
            and (row.setting.h_s, row.setting.form) in PICTURED
            and row.setting.form == row.setting.observer
        },
    )


def as_json(found: Reproduction) -> dict[str, Any]:
    """One object with all tables and verdicts; what is no number is null."""
    c = found.convergence
    whole: dict[str, Any] = {
        "schema": 1,
        "start": found.start,
        "duration_s": r.DURATION_S,
        "steady_from_s": r.STEADY_FROM_S,
        "plant_step_s": r.PLANT_STEP_S,
        "bands": {
            "coarse_m": r.COARSE_M,
            "fine_m": r.FINE_M,
            "e3_n": r.OBSERVER_N,
            "e_d_n_s": r.OBSERVER_N_S,
        },
        "runs": [_row(x) for x in found.main],
        "ablation": [_row(x) for x in found.ablation],
        "orifice": [_row(x) for x in found.orifice],
        "settling": [x._asdict() for x in c.settling],
        "limit_cycles": [x._asdict() for x in c.limit_cycles],
        "starts": [x._asdict() for x in c.starts],
        "unmatched": [x._asdict() for x in c.unmatched],
        "claims": [x._asdict() for x in found.claims],
        "bounds": [x._asdict() | {"met": x.met} for x in found.bounds],
        "good": found.good,
    }
    cleaned: dict[str, Any] = finite(whole)
    return cleaned


def _row(row: r.PaperRow) -> dict[str, Any]:
    values = row._asdict()
    del values["setting"]
    return row.setting._asdict() | values
