"""What the software rig has besides the plain model, as plain numbers."""

from __future__ import annotations

from pneud.config.flow import L_MIN
from pneud.config.models import Config
from pneud.physics.plant import Detail
from pneud.physics.ratings import DENSITY_ANR_KG_M3


def detail_of(c: Config, u_max_v: float, gas_constant: float, temperature_k: float) -> Detail:
    """The plant's details; off where there are none.

    Args:
        c: the configuration.
        u_max_v: the true valve's greatest command.
        gas_constant: of the true gas.
        temperature_k: of the true supply.
    """
    p = c.plant
    v, s, f = p.valve, p.sensors, p.friction
    supply_pa_kg = gas_constant * temperature_k / p.supply.receiver_m3 if p.supply.receiver_m3 else 0.0
    leak_out = v.leakage if v.leakage_exhaust is None else v.leakage_exhaust
    found = Detail(
        play_v=0.5 * v.hysteresis_v,
        leak_in_v=v.leakage * u_max_v,
        leak_out_v=leak_out * u_max_v,
        wall_s=p.wall_time_s,
        receiver_pa_kg=supply_pa_kg,
        regulator_kg_s_pa=DENSITY_ANR_KG_M3 * L_MIN * p.supply.regulator_l_min_bar * 1e-5,
        slips=f.model == "gms",
        rise_1_pa=f.pressure_share_bar * 1e-5,
        forward_share=f.forward_share,
        pressure_lag_s=s.pressure_lag_s,
        encoder_lag_s=s.encoder_lag_s,
        encoder_noise_m=s.encoder_noise_m,
        encoder_offset_m=s.encoder_offset_m,
        p1_offset_pa=s.p1_offset_pa,
        p2_offset_pa=s.p2_offset_pa,
        supply_offset_pa=s.supply_offset_pa,
        hose_s=p.hoses.delay_s,
        contact_n_m=p.contact.stiffness_n_m,
        contact_m=contact_m(c) if p.contact.stiffness_n_m else 0.0,
        contact_n_s_m=p.contact.damping_n_s_m if p.contact.stiffness_n_m else 0.0,
        contact_side=-1.0 if p.contact.stiffness_n_m and p.contact.side == "rear" else 1.0,
    )
    plain = Detail(regulator_kg_s_pa=found.regulator_kg_s_pa)
    return Detail() if found == plain else found._replace(on=True)


def contact_m(c: Config) -> float:
    """Where what the load runs against begins, in the true cylinder's effective coordinate."""
    p, k = c.plant, c.cylinder
    rear_m = p.cylinder.dead_length_1_m or k.dead_length_1_m
    return rear_m + p.hoses.volume_1_m3 / k.piston_area_1_m2 + p.contact.position_m
