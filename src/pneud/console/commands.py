"""What the console makes of well-formed requests: status, or requests to the axis in its units."""

from __future__ import annotations

from functools import partial
from typing import Any

from pneud.axis.requests import STEERED
from pneud.config.conversions import cylinder_of, pressing_of, shunned_of
from pneud.config.learnt import start_of, values_learnt
from pneud.console import programs, protocol, together
from pneud.console.facts import RunFacts
from pneud.console.handoff import RequestOutcome
from pneud.console.memory import Memory
from pneud.console.orders import Orders
from pneud.console.processes import Processes
from pneud.console.protocol import Error, ProtocolError
from pneud.console.records import ProgramError
from pneud.console.status_reply import StatusWatch, faults
from pneud.console.tuning import Tuning
from pneud.control.reference import Bounds, unhurried
from pneud.log.live.ring import Ring
from pneud.rt.processes import counters_of
from pneud.safety.faults import CENTRES, STOPS, F
from pneud.safety.supervisor import BLOCKS, is_engaged
from pneud.signals import Answer, Hold, Request, RequestKind, State

_MM = 1e-3
_UNPROVEN = "arm --unproven"
_BLOCKS = {  # faults, by what they forbid
    "arm": BLOCKS[RequestKind.ARM],
    _UNPROVEN: BLOCKS[RequestKind.ARM] & ~(1 << F.UNPROVEN),
    "home": BLOCKS[RequestKind.HOME],
}
_EMPTY = Request(RequestKind.PIECE)  # the profile
_RESUME = Request(RequestKind.RUN, (0.0, 0.0, 0.0))
_URGENT = ("disarm", "stop")
_STEERED = tuple(State(state).label for state in STEERED)
_LEADS = ("goto", "jog", "hold", "track", "force", "run")
_FIRST = {State.DISARMED.label: "; pneud arm", State.FAULT.label: "; pneud clear, and pneud arm"}
_MOVING = tuple(state for state in STEERED if state != State.HOLDING)
_PLAIN = {verb: RequestKind[verb.upper()] for verb in ("clear", "hold", "home", *_URGENT)}


class AxisDesk:
    """The desk of one axis."""

    def __init__(
        self,
        run: RunFacts,
        ring: Ring,
        watch: StatusWatch,
        memory: Memory | None = None,
        processes: Processes | None = None,
    ) -> None:
        """The desk of an axis that runs.

        Args:
            run: what runs.
            ring: where its records are.
            watch: follows them.
            memory: what the console before has left.
            processes: of the daemon; of several axes, the first one has them.
        """
        self.name = run.config.name
        follow = run.config.reference.follow
        carried = follow is not None and follow.skew_m is not None and not follow.leads
        self.carried_by = follow.axis if follow is not None and carried else ""
        self._run = run
        self._ring = ring
        self._watch = watch
        self._memory = memory
        self._processes = processes
        self._rod_force_n = cylinder_of(run.config).rod_force_n
        self._tuning = Tuning(run.config, run.path, run.text, memory, run.own)
        self._program: programs.Compiled | None = None  # that the axis has taken
        if memory is not None and (kept := (memory.kept() or {}).get("program")) is not None:
            self._program = programs.Compiled(kept["name"], tuple(kept["records"]), tuple(kept["axes"]), ())

    def read(self) -> None:
        """Read the axis's file, for the next `status` or `tune_reload`."""
        self._tuning.read()

    def status(self) -> dict[str, Any]:
        """The fields of the reply to `status`."""
        r = self._run
        recorder = self._ring.status()
        return {
            "schema": 1,
            "name": r.config.name,
            **(told := self._watch.fields(self._rod_force_n)),
            "program": self._of_program(told["program"]),
            "station": self._of_station(told["station"]),
            "learnt": values_learnt(self._watch.learnt or start_of(r.config), r.config) or None,
            "learnt_from": r.config.control.adaptation.start.log or None,
            "rate_hz": r.config.loop.rate_hz,
            "limits": self._limits(),
            "bus": r.bus,
            "log": r.log_path,
            "log_written": recorder.written,
            "log_dropped": recorder.lost,
            "log_error": recorder.error_text or None,
            "log_bytes": recorder.file_bytes,
            "config": str(r.path),
            "config_changed": self._tuning.changed_on_disk(),
            "processes": self._counters(recorder.pid),
        }

    def _counters(self, recorder: int) -> list[dict[str, Any]]:
        """What the daemon's processes have used of the machine, the axis's own recorder among them."""
        found = [] if self._processes is None else self._processes.counters()
        own = counters_of(recorder) if recorder else None
        return [*found, own] if own is not None else found

    def _limits(self) -> dict[str, float]:
        """What may be asked for."""
        limits = self._run.config.limits
        motion = limits.motion
        found = {
            "min_mm": max(limits.travel_min_m, 0.0) + motion.margin_m,
            "max_mm": min(limits.travel_max_m, self._run.config.cylinder.stroke_m) - motion.margin_m,
            "speed_mm_s": motion.speed_m_s,
            "acceleration_mm_s2": motion.acceleration_m_s2,
            "jerk_mm_s3": motion.jerk_m_s3,
        }
        return {name: round(value / _MM, 6) for name, value in found.items()}

    def attach(self) -> tuple[dict[str, Any], int]:
        """The fields of the reply to `attach`, and the descriptor that goes with it."""
        return {
            "layout": Ring.layout(),
            "slots": self._ring.slots,
            "slot_bytes": self._ring.slot_bytes,
            **self._run.page(),
        }, self._ring.open_for_reading()

    def gains(self) -> dict[str, Any]:
        """The fields of the reply to `tune_get`."""
        return {"gains": self._tuning.running, "config": str(self._run.path)}

    def plan(self, message: protocol.Request) -> Orders:
        """What to ask of the loop.

        Raises:
            ProtocolError: what is asked for cannot be done.
        """
        if message.verb in _PLAIN:
            return Orders(message.verb, (Request(_PLAIN[message.verb]),), urgent=message.verb in _URGENT)
        match message:
            case protocol.Arm(unproven=unproven):
                words, values = (_UNPROVEN, (2.0,)) if unproven else ("arm", ())
                return Orders(words, (Request(RequestKind.ARM, values),))
            case protocol.Plain(verb="restart"):
                return self._restart()
            case protocol.Goto():
                return self._goto(message)
            case protocol.GotoAll():
                return together.goto([self], message)
            case protocol.Jog(velocity_mm_s=v, lease_s=lease_s):
                self._check_speed(v)
                ticks = max(1, round(lease_s * self._run.config.loop.rate_hz))
                request = Request(RequestKind.JOG, (v * _MM, float(ticks)))
                return Orders(f"jog {v:g} mm/s", (request,), attended=True)
            case protocol.Probe():
                return self._probe(message)
            case protocol.Force():
                return self._force(message)
            case protocol.Track(what=what, attended=attended):
                request = Request(RequestKind.TRACK, (float(what == "profile"),))
                return Orders(f"track {what}", (request,), attended=attended)
            case protocol.Run():
                return self._go_through(message)
            case protocol.Upload(first=first, last=last, pieces=pieces):
                requests = [_EMPTY] if first else []
                requests += [Request(RequestKind.PIECE, tuple(piece)) for piece in pieces]
                words = f"upload of {len(pieces)} pieces"
                return Orders(words, tuple(requests), undo=_EMPTY, unfinished=not last, follows=not first)
            case protocol.TuneSet(gains=values):
                return self._tuning.set(values)
            case protocol.TuneReload():
                return self._tuning.reload()
            case protocol.Mark(text=text):
                shown = "".join(c if c.isprintable() else "?" for c in text)
                return Orders(f"mark {shown}", (Request(RequestKind.MARK),), free=True)
        raise AssertionError(message)

    def engaged_in(self) -> str:
        """The axis's state, where it is engaged; empty where it is not."""
        last = self._ring.reader().latest()
        return State(last.tick.state).label if last is not None and is_engaged(last.tick.state) else ""

    def moves(self) -> bool:
        """Whether the axis is in a motion that a hold would bring to rest."""
        last = self._ring.reader().latest()
        return last is not None and last.tick.state in _MOVING

    def stands_m(self) -> float:
        """Where the axis holds.

        Raises:
            ProtocolError: it does not hold.
        """
        last = self._ring.reader().latest()
        if last is None or last.tick.state != State.HOLDING:
            state = State.STARTING if last is None else State(last.tick.state)
            words = f"goto: {self.name} is {state.label}; axes set out together from where they hold"
            raise ProtocolError(Answer.WRONG_STATE.name.lower(), words, state=state.label)
        return last.tick.reference.position_m

    def bounds(self, distance_m: float) -> Bounds:
        """What a move of so much from rest would keep to, if it went alone."""
        limits, motion = self._run.config.limits, self._run.config.limits.motion
        speed_m_s = min(motion.speed_m_s, limits.speed_m_s)
        bounds = Bounds(speed_m_s, motion.acceleration_m_s2, motion.jerk_m_s3)
        return unhurried(bounds, distance_m, shunned_of(self._run.config))

    def _restart(self) -> Orders:
        """A run that would not begin is not left for."""
        if self._run.log_is_given:
            raise ProtocolError(
                Error.INVALID, f"restart: {self._run.log_path} is this run's log; give --log a folder"
            )
        hindrance = self._run.hindrance()
        if hindrance:
            raise ProtocolError(Error.CONFIGURATION, f"restart: {hindrance}")
        return Orders("restart", (Request(RequestKind.RESTART),))

    def _probe(self, m: protocol.Probe) -> Orders:
        ticks = max(1, round(m.lease_s * self._run.config.loop.rate_hz))
        bounds = (m.travel_mm * _MM, m.speed_mm_s * _MM, m.force_n)
        request = Request(RequestKind.PROBE, (m.voltage_v, m.rate_v_s, *bounds, float(ticks)))
        return Orders(f"probe {m.voltage_v:+g} V within {m.travel_mm:g} mm and {m.force_n:g} N", (request,))

    def facts(self) -> programs.AxisFacts:
        """What a program has to know of the axis."""
        return programs.facts_of(self._run.config)

    def taken(self, found: programs.Compiled) -> dict[str, Any]:
        """The axis has a program; fields for the reply."""
        self._program = found
        if self._memory is not None:
            self._memory.keep(program={"name": found.name, "records": found.records, "axes": found.axes})
        return {"records": len(found.records)}

    def shares(self) -> tuple[str, ...]:
        """Names of the axes that go through its program."""
        return self._program.axes if self._program is not None else ()

    def _go_through(self, m: protocol.Run) -> Orders:
        if m.program is None:
            if len(axes := self.shares()) > 1:
                words = f"run: {' and '.join(axes)} go through their program together: leave out the axis"
                raise ProtocolError(Error.INVALID, words)
            return Orders("run, from where it was stopped", (_RESUME,), attended=m.attended)
        try:
            found = programs.compiled(m.program, [self.facts()])
            (asked,) = programs.requests_to_begin(found, m.record, m.cycles)
        except ProgramError as e:
            raise ProtocolError(Error.PROGRAM, f"run: {e}") from None
        words = programs.run_in_words(found, m.record, m.cycles)
        if m.load:
            if self._run.config.io.start != "program":
                raise ProtocolError(
                    Error.INVALID,
                    'run: no input begins a program here; bus.inputs.start does, with io.start = "program"',
                )
            words = f"load {found.name}"
            asked = programs.requests(found, load=True)
            return Orders(words, tuple(asked), undo=programs.EMPTY, done=lambda: self.taken(found))
        done = partial(self.taken, found)
        return Orders(words, tuple(asked), undo=programs.EMPTY, attended=m.attended, done=done)

    def _of_program(self, told: dict[str, Any] | None) -> dict[str, Any] | None:
        """What `status` says of a program: of the ticks, and of its file."""
        if told is None:
            return None
        found, record = self._program, told["record"]
        if found is None or not record <= len(found.records):
            return {"name": None, **told, "of": None, "label": None, "words": None}
        one = found.records[record - 1] if record else {}
        words = programs.in_words(one) if one else None
        return {
            "name": found.name,
            **told,
            "of": len(found.records),
            "label": one.get("label"),
            "words": words,
        }

    def _of_station(self, told: dict[str, int] | None) -> dict[str, Any] | None:
        """What `status` says of inputs, outputs and the brake, by their names."""
        if told is None:
            return None
        bus = self._run.config.bus
        brake = Hold(told["brake"])
        return {
            "inputs": {name: bool(told["inputs"] >> bit & 1) for bit, name in enumerate(bus.inputs)},
            "outputs": {name: bool(told["outputs"] >> bit & 1) for bit, name in enumerate(bus.outputs)},
            "brake": brake.label if brake else None,
        }

    def _goto(self, m: protocol.Goto) -> Orders:
        allowed = self._limits()
        low_mm, high_mm = allowed["min_mm"], allowed["max_mm"]
        nearest_mm = min(max(m.x_mm, low_mm), high_mm)
        if nearest_mm != m.x_mm:
            raise ProtocolError(
                Error.OUT_OF_TRAVEL,
                f"{m.x_mm:g} mm lies outside the travel {low_mm:g} … {high_mm:g} mm;"
                f" the nearest allowed is {nearest_mm:g} mm",
                nearest_mm=nearest_mm,
            )
        if m.speed_mm_s is not None:
            self._check_speed(m.speed_mm_s)
        bounds = (m.speed_mm_s, m.acceleration_mm_s2, m.jerk_mm_s3)
        words = f"goto {m.x_mm:g} mm"
        for name, bound in zip(("speed", "acceleration", "jerk"), bounds, strict=True):
            words += f" {name} {bound:g}" if bound is not None else ""
        values = (m.x_mm * _MM, *((bound or 0.0) * _MM for bound in bounds))
        return Orders(words, (Request(RequestKind.GOTO, values),), attended=m.attended)

    def _force(self, m: protocol.Force) -> Orders:
        pressing, allowed = pressing_of(self._run.config), self._limits()
        most_n = pressing.out_n if m.force_n > 0.0 else -pressing.in_n
        if abs(m.force_n) > abs(most_n):
            raise ProtocolError(
                Error.BEYOND_LIMITS,
                f"{m.force_n:g} N are more than limits.force and the supply allow; at most {most_n:.4g} N",
                nearest_n=most_n,
            )
        window = (m.low_mm, m.high_mm)
        if (m.low_mm is None) != (m.high_mm is None):
            raise ProtocolError(Error.INVALID, "force: low_mm and high_mm go together")
        if m.low_mm is not None and m.high_mm is not None:
            low_mm, high_mm = allowed["min_mm"], allowed["max_mm"]
            if not low_mm <= m.low_mm < m.high_mm <= high_mm:
                raise ProtocolError(
                    Error.OUT_OF_TRAVEL,
                    f"force: the window {m.low_mm:g} … {m.high_mm:g} mm has to lie within the travel"
                    f" {low_mm:g} … {high_mm:g} mm",
                )
        if m.speed_mm_s is not None and m.speed_mm_s * _MM > self._run.config.limits.speed_m_s:
            raise ProtocolError(
                Error.BEYOND_LIMITS,
                f"force: {m.speed_mm_s:g} mm/s is faster than limits.speed_m_s,"
                f" {self._run.config.limits.speed_m_s / _MM:g} mm/s",
            )
        words = f"force {m.force_n:g} N"
        more = (m.rate_n_s, *((x or 0.0) * _MM for x in (*window, m.speed_mm_s)), m.timeout_s)
        values = (m.force_n, *(x or 0.0 for x in more))
        return Orders(words, (Request(RequestKind.FORCE, values),), attended=m.attended)

    def _check_speed(self, speed_mm_s: float) -> None:
        highest_mm_s = self._limits()["speed_mm_s"]
        if abs(speed_mm_s) > highest_mm_s:
            raise ProtocolError(
                Error.BEYOND_LIMITS,
                f"{speed_mm_s:g} mm/s is faster than limits.motion.speed_m_s; at most {highest_mm_s:g} mm/s",
                nearest_mm_s=highest_mm_s,
            )

    def refused(self, answer: int, words: str, outcome: RequestOutcome) -> ProtocolError:
        """What to tell a client about the axis's refusal."""
        try:
            kind = Answer(answer)
        except ValueError:
            return ProtocolError(Error.MALFORMED, f"the axis answered {answer}")
        state = State(outcome.state).label
        more: dict[str, Any] = {"state": state}
        match kind:
            case Answer.WRONG_STATE:
                text = f"{words}: not while the axis is {'in fault' if state == State.FAULT.label else state}"
                if words.partition(" ")[0].rstrip(",") in _LEADS:
                    text += _FIRST.get(state, "")
                if words.startswith("run") and state in _STEERED:
                    text = f"{words}: a program is under way; pneud hold ends it"
            case Answer.BLOCKED:
                blocking = _BLOCKS.get(words, CENTRES | STOPS)
                found = faults(outcome.present & blocking, outcome.latched)
                more["faults"] = [f for f in found if f["present"]]
                text = f"{words}: blocked by " + (
                    "; ".join(f"{f['name']}: {f['cure']}" for f in more["faults"]) or "a fault"
                )
            case Answer.OUT_OF_TRAVEL:
                limits = self._run.config.limits
                text = (
                    f"{words}: the way leaves the travel"
                    f" {limits.travel_min_m / _MM:g} … {limits.travel_max_m / _MM:g} mm"
                )
                if words.startswith("force "):
                    allowed = self._limits()
                    text = (
                        f"{words}: the load stands outside the window, which is the travel"
                        f" {allowed['min_mm']:g} … {allowed['max_mm']:g} mm unless another is asked for;"
                        " lead it there: pneud goto"
                    )
            case Answer.BEYOND_LIMITS:
                text = f"{words}: faster or harder than the configuration's limits"
            case Answer.UNSTABLE:
                text = f"{words}: the loop would not be stable with these gains"
            case Answer.NOT_REFERENCED:
                text = f"{words}: the encoder has no reference; home the axis: pneud home"
            case Answer.NO_PROFILE:
                text = f"{words}: there is no profile that could be followed"
                if words.startswith("run"):
                    text = f"{words}: there is no program that was stopped; give one: pneud run PROGRAM"
            case Answer.MALFORMED:
                text = f"{words}: a value is too small, too large, or of the wrong sign"
                if words.startswith("upload "):
                    text = (
                        f"{words}: one of them does not meet the one before it,"
                        " is too short or too long, or is one too many"
                    )
            case Answer.CLOSING:
                text = f"{words}: the daemon is shutting down"
            case _:
                text = f"{words}: {kind.name.lower()}"
        return ProtocolError(kind.name.lower(), text, **more)

    def half_done(self, undo: Request | None) -> None:
        """A profile, a program or a change of gains has begun, or is whole or undone."""
        if self._memory is not None:
            self._memory.half_done = 0 if undo is None else int(undo.kind)

    def left_half_done(self) -> Orders | None:
        """What undoes the upload, or tuning, in which the console before this one has ended."""
        if self._memory is None or not (kind := self._memory.half_done):
            return None
        back = self._tuning.as_known() if kind == RequestKind.GAINS else Request(kind)
        return Orders("what a console that is gone has begun", (back,), undo=back)
