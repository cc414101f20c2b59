"""Law and plant led from part to part, without a break: what is learnt in one is there in the next."""

from __future__ import annotations

from pneud.control.reference import Sine, Way
from pneud.control.step import Controller
from pneud.physics.plant import PlantParameters
from pneud.study import trial
from pneud.study.trial import Errand, Pair, Verdict, begin

STANDS = Sine(0.0, 0.0, 0.0)  # behind a way: rest


class Going:
    """A load that begins at rest, and where it is by now.

    Args:
        at_m: where it begins, in the stroke coordinate.
        p: the controller.
        plant: the plant.
        tolerance_m: error that counts as in position.
        seed: of the sensors' noise.
    """

    def __init__(
        self, at_m: float, p: Controller, plant: PlantParameters, tolerance_m: float, seed: int = 1
    ) -> None:
        self._pair: Pair = begin(at_m, p, plant, seed)
        self._p, self._plant, self._tolerance_m = p, plant, tolerance_m
        self._joins = True

    def go(
        self,
        way: Way,
        after_s: float,
        judged_s: float | None = None,
        sine: Sine = STANDS,
        force_n: float = 0.0,
    ) -> Verdict:
        """Along a way and on for a time; judged from so long behind the way, or all of it.

        What it returns as `outside` are ticks behind the way, −1 where there is no end to them.

        Args:
            way: where the load is led.
            after_s: how long it goes on behind that.
            judged_s: what comes before this time behind the way does not count; None: all does.
            sine: what is followed behind the way; rest without.
            force_n: external, against positive motion.
        """
        p, plant = self._p, self._plant
        before = round(way.T / p.h)
        ticks = before + round(after_s / p.h)
        self._pair, found = trial.compiled()[0](
            self._pair,
            self._joins,
            ticks,
            0 if judged_s is None else before + round(judged_s / p.h),
            self._tolerance_m,
            Errand(way, sine, force_n),
            p,
            plant,
            trial.step_v(p, plant),
        )
        self._joins = False
        outside = -1 if found.outside >= ticks - 1 else max(0, found.outside + 1 - before)
        verdict: Verdict = found._replace(outside=outside)
        return verdict
