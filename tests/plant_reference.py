"""The rig's equations written straight down for a general solver, and a feedback that keeps runs together."""

from __future__ import annotations

import math

from scipy.integrate import solve_ivp

from pneud.config.conversions import plant_of
from pneud.config.reading import load_config
from pneud.physics.gas import signed_flow
from pneud.physics.plant import PlantParameters
from pneud.rig.dynamics import PlantState, disturbances

REALISTIC = plant_of(load_config("virtual.toml"))
IDEAL = REALISTIC._replace(
    cylinder=REALISTIC.cylinder._replace(rod_force_n=0.0),
    valve=REALISTIC.valve._replace(omega_rad_s=0.0, dead_zone_v=0.0),
    friction=REALISTIC.friction._replace(
        coulomb_n=0.0, static_n=0.0, viscous_n_s_m=0.0, sigma0_n_m=0.0, sigma1_n_s_m=0.0
    ),
    polytropic_exponent=1.4,
    reverse_flow=False,
    disturbance=2,
    dac_bits=0,
    encoder_resolution_m=0.0,
    pressure_resolution_pa=0.0,
    pressure_noise_pa=0.0,
)


def feedback(t_s: float, s: PlantState, p: PlantParameters) -> float:
    """Linear state feedback that follows the paper's reference."""
    w = math.pi
    position = 0.5 + 0.05 * math.sin(w * t_s) - s.x1
    velocity = 0.05 * w * math.cos(w * t_s) - s.v
    force = s.p1 * p.cylinder.A1 - s.p2 * p.cylinder.A2 - p.cylinder.rod_force_n
    acceleration = -0.05 * w * w * math.sin(w * t_s) - force / p.cylinder.M
    return max(-5.0, min(5.0, 43.0 * position + 6.0 * velocity + 0.33 * acceleration))


def solve(
    s: PlantState, u: float, force_ext_n: float, t0: float, t1: float, p: PlantParameters
) -> PlantState:
    """The state at t1, to ten digits."""
    if p.valve.omega_rad_s == 0.0:
        s = s._replace(y=u)
    solution = solve_ivp(
        _rates, (t0, t1), s[:7], method="DOP853", args=(u, force_ext_n, p), first_step=1e-5,
        rtol=1e-10, atol=(1e-11, 1e-9, 1e-4, 1e-4, 1e-12, 1e-8, 1e-6),
    )  # fmt: skip
    x1, v, p1, p2, z, y, ydot = (float(value) for value in solution.y[:, -1])
    return PlantState(x1, v, p1, p2, z, y, ydot, 0.0)


def _rates(t: float, s: list[float], u: float, force_ext_n: float, p: PlantParameters) -> list[float]:
    x, v, p1, p2, z, y, ydot = s
    c, g, f, n = p.cylinder, p.gas, p.friction, p.polytropic_exponent
    omega, zone, full = p.valve.omega_rad_s, p.valve.dead_zone_v, p.valve.u_max_v
    yddot = omega * omega * (u - y) - 2.0 * p.valve.zeta * omega * ydot
    opening = min(max(abs(y) - zone, 0.0) * full / (full - zone), full)

    def flow(upstream: float, downstream: float) -> float:
        value = signed_flow(upstream, downstream, g)
        return value if p.reverse_flow else max(value, 0.0)

    if y > 0.0:
        into1, into2 = flow(g.supply_pa, p1), -flow(p2, g.atmosphere_pa)
    else:
        into1, into2 = -flow(p1, g.atmosphere_pa), flow(g.supply_pa, p2)
    d1, d2 = disturbances(t, p)
    rate = n / g.k * c.c1 * opening
    zdot, friction = 0.0, f.viscous_n_s_m * v
    if f.sigma0_n_m > 0.0:
        dry = f.coulomb_n + (f.static_n - f.coulomb_n) * math.exp(-((v / f.stribeck_m_s) ** 2))
        zdot = v - f.sigma0_n_m * abs(v) * z / dry
        friction += f.sigma0_n_m * z + f.sigma1_n_s_m * zdot
    return [
        v,
        (p1 * c.A1 - p2 * c.A2 - c.rod_force_n - friction - force_ext_n) / c.M,
        -n * p1 * v / x + rate * into1 / (c.A1 * x) + d1,
        n * p2 * v / (c.L - x) + rate * into2 / (c.A2 * (c.L - x)) + d2,
        zdot,
        ydot,
        yddot,
    ]
