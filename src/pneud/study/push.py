"""Does a controller come back from a large error, and what does it do afterwards?"""

from __future__ import annotations

from typing import NamedTuple

from pneud.axis.state import AxisParameters
from pneud.control.reference import still
from pneud.physics.plant import PlantParameters
from pneud.study import trial

SETTLE_S, JUDGE_S = 5.0, 2.0


class Pushed(NamedTuple):
    """A run's last seconds."""

    rms_m: float
    max_m: float
    chatter_v: float  # mean |Δu|
    saturated: float  # part of the samples at the greatest command

    def recovered(self, undisturbed: Pushed) -> bool:
        """Whether this is as good as an undisturbed run, within what one run differs from the next."""
        return self.rms_m < 1.5 * undisturbed.rms_m + 1e-5 and self.saturated <= undisturbed.saturated + 0.01


def service(axis: AxisParameters, plant: PlantParameters, start_error_m: float, seed: int = 1) -> Pushed:
    """Track the reference for seven seconds from a start error; judge the last two.

    Args:
        axis: controller, reference and limits.
        plant: the plant.
        start_error_m: from the reference's centre, kept within the travel [m].
        seed: of the pressures' noise.
    """
    p, limits, centre_m = axis.controller, axis.limits, axis.reference.centre_m
    x = max(limits.travel_min_m, min(limits.travel_max_m, centre_m + start_error_m))
    settled, judged = round(SETTLE_S / p.h), round(JUDGE_S / p.h)
    _, v = trial.compiled()[0](
        trial.begin(x, p, plant, seed), True, settled + judged, settled, 0.0,
        trial.Errand(still(centre_m), axis.reference), p, plant, trial.step_v(p, plant),
    )  # fmt: skip
    return Pushed(v.rms_m, v.max_m, v.step_v, v.saturated / judged)
