"""Another software rig, of other physics than pneud's own, which the controller meets over the bus only.

    python -m hil.second_rig --bus unixcan:demo --size cyl25x200 --seed 2 --json

Equations, frames and parameters are its own, and it knows nothing of pneud. Valve: ISO 6358 (sonic
conductance, critical ratio), four soft edges, leaking overlap, play, a second order with a limited rate.
Chambers: mass and internal energy, heat from the wall, a leaking piston. Friction: Maxwell slip elements.
Sensors: offset, gain, lag, noise, steps, a sine. A seed draws what a rig has of each, within the
tolerances of `drawn`; `--json` prints it. A period takes 150 to 300 µs of computing, with numba 3 µs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import signal
import struct
import sys
import time
from array import array
from collections import namedtuple
from collections.abc import MutableSequence
from pathlib import Path
from typing import NamedTuple

import can

R, CV, CP = 287.05, 717.6, 1004.65  # of air [J/(kg K)]
ROOM_K, ROOM_PA = 293.15, 101_000.0
DENSITY = 1.185  # of ISO 6358's reference, at room temperature [kg/m³]
STEP_S = 1.25e-4
ELEMENTS = 6  # of friction
X, V, M1, U1, M2, U2, SPOOL, SPOOL_RATE, PLAY, P1, P2, LOST, Z = range(13)  # of the state; P1, P2: as sensed
STATE = Z + ELEMENTS

SYNC, ENCODER, PRESSURE, COMMAND, STATUS = 0x080, 0x181, 0x182, 0x203, 0x183
BOOT, CENTRED, ENABLED, TIMED_OUT = range(4)
U_MAX, DAC_V = 5.0, 10.0 / 4096
NEVER_NS, IDLE_S = 1 << 62, 0.02


class Size(NamedTuple):
    """What a catalogue says, in its units."""

    bore_mm: float
    rod_mm: float
    stroke_mm: float
    mass_kg: float
    flow_l_min: float  # nominal: from 6 to 5 bar (gauge)
    valve_hz: float
    encoder_um: float
    friction: tuple[float, float, float]  # Coulomb, static [N], viscous [N s/m]
    pressure_step_pa: float = 20.0
    pressure_noise_pa: float = 100.0
    upright: bool = False


SIZES = {
    "virtual": Size(40.0, 16.0, 1000.0, 15.0, 1430.0, 100.0, 1.0, (40.0, 55.0, 60.0)),
    "cyl16x100": Size(16.0, 6.0, 100.0, 0.8, 100.0, 100.0, 10.0, (6.0, 9.0, 6.0)),
    "cyl25x200": Size(25.0, 10.0, 200.0, 3.0, 350.0, 125.0, 5.0, (14.7, 22.1, 14.7)),
    "vert32x300": Size(32.0, 12.0, 300.0, 8.0, 350.0, 125.0, 5.0, (24.0, 36.0, 24.0), upright=True),
    "cyl63x600": Size(63.0, 20.0, 600.0, 60.0, 700.0, 100.0, 10.0, (93.5, 140.0, 93.5), 244.14, 250.0),
}


# What a rig is, and what its sensors make of it, in SI units; volts of the command for the spool.
Physics = namedtuple(
    "Physics",
    "area1 area2 stroke mass weight"  # weight: backwards
    " dead1 dead2"  # volumes at the ends, hoses included
    " conductance critical edges soft"  # of an edge that is wholly open; supply→1, 1→air, supply→2, 2→air
    " centre play seep piston_seep"  # play: half the hysteresis; seep: of a closed edge, relative
    " omega damping rate"  # of the spool; rate: at most
    " supply wall cushion"  # wall: heat from it [W/(m² K)]; cushion: length at each end
    " coulomb static stribeck viscous"
    " by_pressure by_direction"  # shares that a bar of mean pressure beyond 3, and going forwards, add
    " stiffness shares element_damping",  # of each element; shares: of friction that each holds at the most
)
Sensors = namedtuple("Sensors", "step_m noise_m sine_m pitch_m offsets_pa gains lag_s noise_pa step_pa")


def drawn(size: Size, seed: int) -> tuple[Physics, Sensors]:
    """A rig of a size, as the seed has it: nominal values within tolerances."""
    chance = random.Random(seed)

    def about(nominal: float, tolerance: float) -> float:
        return nominal * (1.0 + tolerance * chance.uniform(-1.0, 1.0))

    coulomb, static, viscous = size.friction
    area1 = math.pi / 4e6 * size.bore_mm**2
    area2 = area1 - math.pi / 4e6 * size.rod_mm**2
    mass, level = about(size.mass_kg, 0.1), about(1.0, 0.25)
    reach = about(4e-6 * size.bore_mm, 0.4)  # way on which the last element begins to slip
    # elements slip one after another, each at 1.5 times the way of the one before
    shares = (1.0 / ELEMENTS,) * ELEMENTS
    ways = [reach * 1.5 ** (i + 1 - ELEMENTS) for i in range(ELEMENTS)]
    stiffness = tuple(level * static * s / w for s, w in zip(shares, ways, strict=True))
    physics = Physics(
        area1, area2, size.stroke_mm * 1e-3, mass, 9.81 * mass * size.upright,
        about(0.02 * area1, 0.3) + 4e-6, about(0.02 * area2, 0.3) + 4e-6,
        about(size.flow_l_min / 254.4 * 1e-8, 0.15), about(0.3, 0.15),
        (about(0.1, 0.25), about(0.1, 0.25), about(0.1, 0.25), about(0.1, 0.25)), about(0.012, 0.3),
        chance.uniform(-0.03, 0.03), about(0.012, 0.5), about(4e-4, 0.5), about(1e-4, 0.5),
        2.0 * math.pi * about(size.valve_hz, 0.2), about(0.75, 0.1), about(2000.0, 0.2),
        about(600_000.0, 0.02), about(60.0, 0.5), 1e-5 * size.stroke_mm,
        level * coulomb, level * static, about(0.02, 0.3), about(viscous, 0.3),
        about(0.03, 0.5), chance.uniform(-0.05, 0.05),
        stiffness, shares, 0.2 * math.sqrt(sum(stiffness) * mass),
    )  # fmt: skip
    offsets = (chance.uniform(-1e3, 1e3), chance.uniform(-1e3, 1e3), chance.uniform(-1e3, 1e3))
    step_m = size.encoder_um * 1e-6
    return physics, Sensors(
        step_m, 0.2 * step_m, about(0.3 * step_m, 0.5), about(100.0 * step_m, 0.2),
        offsets, (about(1.0, 3e-3), about(1.0, 3e-3), about(1.0, 3e-3)),
        about(1e-3, 0.5), size.pressure_noise_pa, size.pressure_step_pa,
    )  # fmt: skip


def at_rest(p: Physics, position_m: float, pressure2_pa: float = 3e5) -> list[float]:
    """The state at rest, chamber 1 in balance, all at room temperature, the valve closed."""
    s = [0.0] * STATE
    s[X], s[P2] = position_m, pressure2_pa
    s[P1] = (pressure2_pa * p.area2 + ROOM_PA * (p.area1 - p.area2) + p.weight) / p.area1
    s[M1] = s[P1] * (p.dead1 + p.area1 * position_m) / (R * ROOM_K)
    s[M2] = s[P2] * (p.dead2 + p.area2 * (p.stroke - position_m)) / (R * ROOM_K)
    s[U1], s[U2] = s[M1] * CV * ROOM_K, s[M2] * CV * ROOM_K
    return s


def flow(p_a: float, t_a: float, p_b: float, t_b: float, c: float, critical: float) -> float:
    """Mass flow from a to b by ISO 6358 [kg/s], laminar where the pressures are nearly the same."""
    forwards = p_a >= p_b
    high, low, t = (p_a, p_b, t_a) if forwards else (p_b, p_a, t_b)
    r, factor = low / high, 1.0
    if r > critical:
        q = (min(r, 0.995) - critical) / (1.0 - critical)
        factor = math.sqrt(1.0 - q * q) * min(1.0, (1.0 - r) / 0.005)
    m = c * DENSITY * high * factor * math.sqrt(ROOM_K / t)
    return m if forwards else -m


def opened(way: float, edge: float, soft: float, seep: float) -> float:
    """How far an edge is open (1: wholly), for a spool that is so far on its side."""
    z = (way - edge) / soft
    wide = way - edge if z > 30.0 else (0.0 if z < -30.0 else soft * math.log1p(math.exp(z)))
    return min(1.0, seep + wide / (U_MAX - edge))


def friction(s: MutableSequence[float], mean_pa: float, h: float, p: Physics) -> float:
    """Force [N] against the motion, and of the elements what they have become after `h` [s]."""
    v = s[V]
    level = p.coulomb + (p.static - p.coulomb) * math.exp(-((v / p.stribeck) ** 2))
    level *= 1.0 + p.by_pressure * (mean_pa * 1e-5 - 3.0) + (p.by_direction if v > 0.0 else -p.by_direction)
    force: float = p.viscous * v
    for i in range(ELEMENTS):
        most = p.shares[i] * level / p.stiffness[i]
        z = s[Z + i] + v * h
        if -most < z < most:
            force += p.element_damping / ELEMENTS * v
        else:
            z = most if z > 0.0 else -most
        s[Z + i] = z
        force += p.stiffness[i] * z
    return force


def cushion(inside: float, outwards: float, p: Physics) -> float:
    """Force [N] inwards at an end, for a load so far from it, with that speed towards it."""
    if inside >= p.cushion:
        return 0.0
    force: float = max(0.0, outwards) * 20.0 * p.mass * (1.0 - max(inside, 0.0) / p.cushion)
    return force + (max(0.0, p.mass * (-1e6 * inside + 400.0 * outwards)) if inside < 0.0 else 0.0)


def advance(s: MutableSequence[float], u: float, lag_s: float, h: float, count: int, p: Physics) -> None:
    """Carry the state `count` steps of `h` [s] on, with `u` [V] at the valve."""
    for _ in range(count):
        rate = s[SPOOL_RATE] + h * p.omega * (p.omega * (u - s[SPOOL]) - 2.0 * p.damping * s[SPOOL_RATE])
        s[SPOOL_RATE] = max(-p.rate, min(p.rate, rate))
        s[SPOOL] += h * s[SPOOL_RATE]
        s[PLAY] = max(s[SPOOL] - p.play, min(s[SPOOL] + p.play, s[PLAY]))
        way, c, b = s[PLAY] - p.centre, p.conductance, p.critical
        v1, v2 = p.dead1 + p.area1 * s[X], p.dead2 + p.area2 * (p.stroke - s[X])
        t1, t2 = s[U1] / (CV * s[M1]), s[U2] / (CV * s[M2])
        p1, p2 = s[M1] * R * t1 / v1, s[M2] * R * t2 / v2
        in1 = flow(p.supply, ROOM_K, p1, t1, c * opened(way, p.edges[0], p.soft, p.seep), b)
        out1 = flow(p1, t1, ROOM_PA, ROOM_K, c * opened(-way, p.edges[1], p.soft, p.seep), b)
        in2 = flow(p.supply, ROOM_K, p2, t2, c * opened(-way, p.edges[2], p.soft, p.seep), b)
        out2 = flow(p2, t2, ROOM_PA, ROOM_K, c * opened(way, p.edges[3], p.soft, p.seep), b)
        over = flow(p1, t1, p2, t2, c * p.piston_seep, b)
        # enthalpy comes with the temperature of where the air comes from
        e1 = in1 * (ROOM_K if in1 > 0.0 else t1) - out1 * (t1 if out1 > 0.0 else ROOM_K)
        e2 = in2 * (ROOM_K if in2 > 0.0 else t2) - out2 * (t2 if out2 > 0.0 else ROOM_K)
        across = over * (t1 if over > 0.0 else t2)
        wall1 = 2.0 * p.area1 + 2.0 * math.sqrt(math.pi / p.area1) * v1
        wall2 = 2.0 * p.area2 + 2.0 * math.sqrt(math.pi / p.area1) * v2
        s[M1] += h * (in1 - out1 - over)
        s[M2] += h * (in2 - out2 + over)
        s[U1] += h * (CP * (e1 - across) + p.wall * wall1 * (ROOM_K - t1))
        s[U2] += h * (CP * (e2 + across) + p.wall * wall2 * (ROOM_K - t2))
        p1, p2 = s[U1] * R / (CV * v1), s[U2] * R / (CV * v2)
        against = friction(s, 0.5 * (p1 + p2), h, p)
        force = p1 * p.area1 - p2 * p.area2 - ROOM_PA * (p.area1 - p.area2) - p.weight
        force += cushion(s[X], -s[V], p) - cushion(p.stroke - s[X], s[V], p)
        s[LOST] += h * against * s[V]
        s[V] += h * (force - against) / p.mass
        s[X] += h * s[V]
        s[U1] -= h * p1 * p.area1 * s[V]
        s[U2] += h * p2 * p.area2 * s[V]
        s[P1] += min(1.0, h / lag_s) * (p1 - s[P1])
        s[P2] += min(1.0, h / lag_s) * (p2 - s[P2])


def hasten() -> bool:
    """Have numba compile what takes the time, where there is one."""
    try:
        from numba import njit  # noqa: PLC0415 - not everybody has it
    except ImportError:
        return False
    for name in ("flow", "opened", "friction", "cushion", "advance"):
        globals()[name] = njit(cache=True)(globals()[name])
    return True


def crc8(can_id: int, data: bytes) -> int:
    """CRC-8 SAE J1850 over the identifier's low and high byte and the data."""
    crc = 0xFF
    for byte in (can_id & 0xFF, can_id >> 8, *data):
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
    return crc ^ 0xFF


class Nodes:
    """Encoder, pressures and valve on the bus, the cylinder between them; times are the frames' stamps."""

    def __init__(self, physics: Physics, sensors: Sensors, seed: int, timeout_ms: float = 50.0) -> None:
        self.timeout_ns = round(timeout_ms * 1e6)
        self.p, self.sensors = physics, sensors
        self.state: MutableSequence[float] = at_rest(physics, 0.45 * physics.stroke)
        self.chance = random.Random(seed + 1)
        self.applied_v, self.valve = 0.0, BOOT
        self.heard, self.counter = -1, 0  # heard: counter of the last valid command
        self.now_ns, self.deadline_ns = 0, NEVER_NS
        self.truth, self.offset_ns = array("d"), time.time_ns() - time.monotonic_ns()

    def to(self, t_ns: int) -> None:
        """Let time go on until then; a valve without commands closes."""
        while self.now_ns < t_ns:
            if self.deadline_ns <= self.now_ns:
                self.valve, self.applied_v, self.deadline_ns = TIMED_OUT, 0.0, NEVER_NS
            until_ns = min(t_ns, self.deadline_ns)
            span_s = (until_ns - self.now_ns) * 1e-9 if self.now_ns else STEP_S
            count = max(1, math.ceil(span_s / STEP_S - 1e-3))
            advance(self.state, self.applied_v, self.sensors.lag_s, span_s / count, count, self.p)
            self.now_ns = until_ns

    def hear(self, can_id: int, data: bytes, t_ns: int) -> list[tuple[int, bytes]]:
        """What the nodes answer to a frame."""
        self.to(t_ns)
        if can_id == SYNC:
            return self.sampled()
        sound = can_id == COMMAND and len(data) == 8 and data[7] == crc8(can_id, data[:7])
        if sound and data[6] != self.heard and data[2] < 2:
            self.heard, self.deadline_ns = data[6], t_ns + self.timeout_ns
            if not data[2]:
                self.valve, self.applied_v = CENTRED, 0.0
            elif self.valve != TIMED_OUT:
                code = round(struct.unpack_from("<h", data)[0] * 0.5e-3 / DAC_V)
                self.valve, self.applied_v = ENABLED, max(-2048, min(2047, code)) * DAC_V
        return []

    def sampled(self) -> list[tuple[int, bytes]]:
        """The three answers to SYNC."""
        s, e, gauss = self.state, self.sensors, self.chance.gauss
        x = s[X] + e.sine_m * math.sin(2.0 * math.pi * s[X] / e.pitch_m) + gauss(0.0, e.noise_m)
        shown = []
        for pa, gain, offset in zip((s[P1], s[P2], self.p.supply), e.gains, e.offsets_pa, strict=True):
            step = round(((pa + gauss(0.0, e.noise_pa)) * gain + offset) / e.step_pa)
            shown.append(max(0, min(65535, round(step * e.step_pa / 20.0))))
        self.truth.extend((self.now_ns - self.offset_ns, s[X]))
        self.valve = CENTRED if self.valve == BOOT else self.valve
        self.counter = (self.counter + 1) & 0xFF
        um = round(round(x / e.step_m) * e.step_m * 1e6)
        age = max(0, min(255, (time.time_ns() - self.now_ns) // 10_000))  # never more than it is
        bodies = (
            (ENCODER, struct.pack("<iBBB", um, 1, age, self.counter)),
            (PRESSURE, struct.pack("<HHHB", *shown, self.counter)),
            (STATUS, struct.pack("<hB3xB", round(self.applied_v / 0.5e-3), self.valve, self.counter)),
        )
        return [(can_id, body + bytes((crc8(can_id, body),))) for can_id, body in bodies]


def serve(nodes: Nodes, bus: can.BusABC) -> None:
    """Be on the bus until SIGTERM or SIGINT."""
    going = [True]
    signal.signal(signal.SIGTERM, lambda *_: going.clear())
    signal.signal(signal.SIGINT, lambda *_: going.clear())
    with contextlib.suppress(OSError):  # not everybody may
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(40))
    print(f"second rig on {bus.channel_info}", file=sys.stderr, flush=True)
    while going:
        before_ns = time.time_ns()
        message = bus.recv(IDLE_S)
        if message is None:
            nodes.to(before_ns if nodes.now_ns else 0)  # in small portions
            continue
        stamp_ns = round(message.timestamp * 1e9)
        for can_id, data in nodes.hear(message.arbitration_id, bytes(message.data), stamp_ns):
            bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False, check=False))
    bus.shutdown()


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description="An independent software rig.")
    parser.add_argument("--bus", required=True, help="unixcan:NAME or socketcan:vcan0")
    parser.add_argument("--size", choices=SIZES, default="virtual")
    parser.add_argument("--seed", type=int, default=1, help="of the deviations")
    parser.add_argument("--timeout-ms", type=float, default=50.0, help="of the valve's commands")
    parser.add_argument("--truth", type=Path, help="file for the true positions: pairs of monotonic ns, m")
    parser.add_argument("--json", action="store_true", help="print what was drawn")
    given = parser.parse_args()
    physics, sensors = drawn(SIZES[given.size], given.seed)
    if given.json:
        print(json.dumps({"physics": physics._asdict(), "sensors": sensors._asdict()}), flush=True)
    nodes = Nodes(physics, sensors, given.seed, given.timeout_ms)
    if hasten():
        import numpy as np  # noqa: PLC0415 - comes with numba

        nodes.state = np.array(nodes.state)  # type: ignore[assignment] # plain Python is faster with a list
        advance(np.array(nodes.state), 0.0, 1e-3, STEP_S, 1, physics)  # type: ignore[arg-type]
    interface, _, channel = given.bus.partition(":")
    if interface == "socketcan" and Path(f"/sys/class/net/{channel}/device").exists():
        parser.error(f"{channel} is no virtual interface")
    serve(nodes, can.Bus(interface=interface, channel=channel))
    if given.truth:
        given.truth.write_bytes(nodes.truth.tobytes())
    return 0


if __name__ == "__main__":
    sys.exit(main())
