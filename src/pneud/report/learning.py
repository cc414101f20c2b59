"""What was learnt in a run: beside what is configured, and over time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from pneud.config.learnt import Values, values_learnt
from pneud.config.models import Config
from pneud.log.files.reader import LoggedState
from pneud.replay.learning import learnt_in

_WIDTH, _HEIGHT, _POINTS = 220.0, 26.0, 200
_LEAST = 0.02  # part of what is configured that a picture is high, at least: noise is not to look like news


class Learning:
    """Follows the snapshots of a log."""

    def __init__(self, config: Config) -> None:
        self.last: Values = {}
        self.t_s: list[float] = []
        self._config = config
        self._courses: dict[str, list[float]] = {}

    def add(self, t_s: float, state: LoggedState) -> None:
        """Take the snapshot of a time."""
        learnt = learnt_in(state)
        if learnt is None:
            return
        self.last = values_learnt(learnt, self._config)
        self.t_s.append(t_s)
        for name, value in self.last.items():
            self._courses.setdefault(name, []).append(value["value"])

    def rows(self) -> Iterator[tuple[str, ...]]:
        """For each value: name, configured, learnt, its range meanwhile, what to check, and a picture."""
        for name, v in self.last.items():
            course = self._courses[name]
            check = f"at its bound: check {v['check']}" if v["check"] else ""
            yield (
                name,
                f"{v['configured']:.4g}",
                f"{v['value']:.4g}",
                f"{min(course):.4g} … {max(course):.4g}",
                check,
                _picture(self.t_s[-len(course) :], course, v["configured"]),
            )


def _picture(t_s: Sequence[float], course: Sequence[float], configured: float) -> str:
    """The course of a value as a small picture, what is configured as a thin line in it."""
    low, high = min(*course, configured), max(*course, configured)
    slack = max(0.0, 0.5 * (_LEAST * abs(configured) - (high - low)))
    low, high = low - slack, high + slack
    span_s, span = (t_s[-1] - t_s[0]) or 1.0, (high - low) or 1.0

    def height(value: float) -> float:
        return 2.0 + (_HEIGHT - 4.0) * (high - value) / span

    every = -(-len(course) // _POINTS)
    kept = [*range(0, len(course) - 1, every), len(course) - 1]
    points = " ".join(f"{_WIDTH * (t_s[i] - t_s[0]) / span_s:.1f},{height(course[i]):.1f}" for i in kept)
    at = f"{height(configured):.1f}"
    return (
        f'<svg class="small" viewBox="0 0 {_WIDTH:g} {_HEIGHT:g}">'
        f'<path d="M0,{at}H{_WIDTH:g}" stroke="#999999" stroke-dasharray="3" fill="none"/>'
        f'<polyline points="{points}" stroke="#0072b2" stroke-width="1.5" fill="none"/></svg>'
    )
