"""The running loop: read, cycle, write, record; one tick at a time, by the clock.

One thread. Between frames readable and command sent there is no lock, no blocking call but the waits, and
nothing that formats text.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import signal
import time
from typing import NamedTuple

from pneud.axis.cycle import FOLLOWING, Axis
from pneud.bus.codec import Codecs
from pneud.bus.inbox import Inbox
from pneud.bus.link import Link
from pneud.config.models import Config
from pneud.console.handoff import LoopEnd
from pneud.crew import gone
from pneud.log.format.header import SNAPSHOT_S
from pneud.log.live.ring import Ring
from pneud.loop.answers import Answers
from pneud.loop.pacer import Pacer
from pneud.loop.summary import Tracking
from pneud.rig.truth import TruthReader
from pneud.rt.histogram import Histogram
from pneud.rt.notify import Service
from pneud.safety.faults import BLOCKS_ARM, FAULT_NAMES, NO_SENSORS, F
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Host, Record, Request, RequestKind, State, Tick, Timing

SYNC_COUNTERS = 240
END_TICKS = 20  # times that the valve is told to centre before the loop ends
FAULT_S = 0.1  # how long a run that ends on a fault goes on telling the valve to centre
CHECKS_S = 0.5  # how often the recorder is looked at
SNAPSHOT_PIECES = 128  # of a profile; the state with a longer one would take too long to hand over
FOREIGN_S = 1.0  # how long another controller counts as present after its last frame
NAN = float("nan")
# plain numbers: an operation on a flag of the enum module costs ten times as much
LINK_DOWN, SEND_FAILED, RECEIVE_OVERFLOW = (
    int(Host.LINK_DOWN),
    int(Host.SEND_FAILED),
    int(Host.RECEIVE_OVERFLOW),
)
CLOCK_STEP, OTHER_CONTROLLER = int(Host.CLOCK_STEP), int(Host.OTHER_CONTROLLER)
RECORDER_LOST, DISK_FULL, CONFIG_CHANGED = (
    int(Host.RECORDER_LOST),
    int(Host.DISK_FULL),
    int(Host.CONFIG_CHANGED),
)
ARM, DISARMED, FAULT = int(RequestKind.ARM), int(State.DISARMED), int(State.FAULT)


class Options(NamedTuple):
    """How a run goes."""

    rate_hz: float
    set_deadline: float  # part of the period to wait for a complete set
    spin_us: float
    auto_arm: bool  # arm once, as soon as everything allows it
    duration_s: float | None  # None runs until it is told to stop
    end_on_fault: bool
    no_realtime: bool  # real-time scheduling is required and was refused


class Loop:
    """The loop of one axis; `run` returns when it has been told to stop and the valve is centred."""

    def __init__(
        self,
        axis: Axis,
        codecs: Codecs,
        inbox: Inbox,
        link: Link,
        ring: Ring,
        options: Options,
        truth: TruthReader | None = None,
        recorder: int = 0,
        console: LoopEnd | None = None,
    ) -> None:
        """A loop that is ready to run.

        Args:
            axis: what decides.
            codecs: of the frames.
            inbox: collects the answers; counts what is wrong with them.
            link: the bus.
            ring: to the recorder.
            options: how the run goes.
            truth: true positions of a software plant.
            recorder: process id of the recorder, 0 for none.
            console: where operators' requests come from.
        """
        self.axis = axis
        self.inbox = inbox
        self.link = link
        self.ring = ring
        self.options = options
        self.truth = truth
        self.period_ns = round(1e9 / options.rate_hz)
        self.lateness = Histogram()
        self.latency = Histogram()
        self.tracking = Tracking(truth is not None)
        self.ticks = 0
        self.skipped = 0
        self.state = int(State.STARTING)
        self.ever_latched = 0
        self.ever_present = 0
        self.present = 0
        self.refused = 0  # faults that showed only when the axis was asked to arm
        self.recorder_lost = False
        self.operated = False  # an operator has asked something of the axis
        self._console = console
        self._codecs = codecs
        self._recorder = recorder
        self._recorder_gone = False
        self._recorder_flags = 0  # bits of Host
        self._stop = False
        self._armed = not options.auto_arm
        self._shut = False  # shutdown has been requested of the axis
        self._service = Service(options.rate_hz, [state.label for state in State], FAULT_NAMES)
        self._counter_mask = codecs.valve_command.counter_mask
        self._count = 0

    def stop(self) -> None:
        """Ask for a controlled stop and the end of the run; safe in a signal handler."""
        self._stop = True

    def handle_signals(self, console_pid: int = 0) -> None:
        """Let Ctrl-C, a closed terminal and a kill stop the run in good order.

        Args:
            console_pid: process that a SIGHUP is handed on to, unless it says that the terminal has gone.
        """
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT):
            signal.signal(number, lambda *_: self.stop())
        had_terminal = _has_terminal()

        def hang_up(*_: object) -> None:
            if not console_pid or (had_terminal and not _has_terminal()):
                self.stop()
            else:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(console_pid, signal.SIGHUP)

        signal.signal(signal.SIGHUP, hang_up)
        # stopped from the keyboard, the axis would be gone but not centred, and the screen in the way
        signal.signal(signal.SIGTSTP, signal.SIG_IGN)

    def run(self) -> None:
        """Tick until told to stop; an exception that gets here is passed on after the valve is centred."""
        try:
            self._run()
        except BaseException:
            command = self._codecs.valve_command
            for count in range(self._count, self._count + END_TICKS):
                self.link.send(command.can_id, command.encode(0.0, 0, 1, counter=count & self._counter_mask))
            raise

    def _run(self) -> None:
        o, link, inbox, axis, console = self.options, self.link, self.inbox, self.axis, self._console
        truth = self.truth
        period_ns, ring, clock = self.period_ns, self.ring, time.monotonic_ns
        pacer = Pacer(period_ns, round(o.spin_us * 1e3))
        wait_ns = round(period_ns * o.set_deadline)
        sync_id, command_id = self._codecs.sync.can_id, self._codecs.valve_command.can_id
        sync_frames = [self._codecs.sync.encode(counter=n) for n in range(1, SYNC_COUNTERS + 1)]
        encode = self._codecs.valve_command.encode
        host = int(Host.NO_REALTIME) if o.no_realtime else 0
        check_ticks = max(1, round(CHECKS_S * o.rate_hz))
        snapshot_ticks = max(1, round(SNAPSHOT_S * o.rate_hz))
        fault_ticks = max(END_TICKS, round(FAULT_S * o.rate_hz))
        total = None if o.duration_s is None else max(1, round(o.duration_s * o.rate_hz))
        frames: list[Frame] = []
        count = 0
        idle_ticks = 0
        failed_before = link.tx_failed
        dropped_before = link.rx_dropped
        foreign_before = foreign_until = 0
        foreign_ticks = max(1, round(FOREIGN_S * o.rate_hz))
        record_ns = -1
        answers = Answers(wait_ns)
        tick: Tick | None = None
        service, behind = self._service, 0

        while True:
            _, late_ns, skipped = pacer.next()
            lateness_ns = late_ns + skipped * period_ns  # since the first of the grid points it missed
            step_ns = link.watch_clock()
            frames.clear()
            link.drain(frames)
            for frame in frames:
                inbox.feed(frame)
            before = len(frames)

            index = count % SYNC_COUNTERS
            sync_data = sync_frames[index]
            t_ns = clock()
            inbox.begin(t_ns)
            sync_sent_ns = link.send(sync_id, sync_data)
            limit_ns = t_ns + wait_ns
            # while the nodes answer
            if count % check_ticks == check_ticks - 1:
                self._check()
            request = self._request(tick, total)
            asked = False
            if request is None and console is not None:
                request = console.take()
                asked = request is not None
            doze_ns = answers.doze_ns(clock() - t_ns)
            if doze_ns > 0:
                time.sleep(doze_ns * 1e-9)
            look_until_ns = clock() + answers.look_ns()
            truth_m = truth.get(t_ns, sync_sent_ns) if truth is not None else NAN
            while not inbox.complete:
                now_ns = clock()
                if now_ns >= limit_ns:
                    break
                looks = now_ns < look_until_ns
                seen = len(frames)
                if link.drain(frames, 0 if looks else limit_ns - now_ns):
                    for frame in frames[seen:]:
                        inbox.feed(frame)
                elif link.down and not looks:
                    # a dead interface is always readable: sleep, or this would spin at high priority
                    time.sleep(max(0.0, (limit_ns - clock()) * 1e-9))
            set_ns = clock()
            if inbox.complete and inbox.sync and len(frames) > before:
                answers.came(frames[-1].stamp_ns - t_ns, in_vain=look_until_ns < frames[-1].stamp_ns)
            else:
                answers.missing()

            flags = host | inbox.conditions
            if link.down:
                flags |= LINK_DOWN
                inbox.bus_restarted()
                if count % check_ticks == 0:
                    link.reopen()
            if link.tx_failed != failed_before:
                failed_before = link.tx_failed
                flags |= SEND_FAILED
            if link.rx_dropped != dropped_before:
                dropped_before = link.rx_dropped
                flags |= RECEIVE_OVERFLOW
            if step_ns:
                flags |= CLOCK_STEP
            if inbox.foreign != foreign_before:
                foreign_before = inbox.foreign
                foreign_until = count + foreign_ticks
            if count < foreign_until:
                flags |= OTHER_CONTROLLER
            flags |= self._recorder_flags
            measurement = inbox.measurement(skipped, flags)
            tick = axis.cycle(measurement, request, t_ns)
            cycle_ns = clock()
            command = tick.command
            data = encode(command.voltage_v, command.enable, index + 1, counter=count & self._counter_mask)
            sent_ns = link.send(command_id, data)
            inbox.commanded_ns = sent_ns

            newest_ns = frames[-1].stamp_ns if len(frames) > before else 0
            latency_ns = sent_ns - newest_ns if newest_ns and sent_ns > 0 else -1
            if truth is not None and math.isnan(truth_m):  # the plant had not seen SYNC before
                truth_m = truth.get(t_ns, sync_sent_ns)
            end_ns = clock()
            ring.put(
                Record(
                    tick,
                    Timing(
                        lateness_ns,
                        set_ns - t_ns,
                        cycle_ns - set_ns,
                        end_ns - cycle_ns,
                        latency_ns,
                        record_ns,
                    ),
                    tuple(frames),
                    before,
                    (
                        Frame(sync_sent_ns, sync_id, sync_data),
                        Frame(sent_ns, command_id, data),
                    ),
                    truth_m,
                )
            )
            if count % snapshot_ticks == snapshot_ticks - 1:
                state = {"axis": axis.freeze(), "inbox": inbox.freeze()}
                ring.put_state(t_ns, state if len(axis.state.profile) <= SNAPSHOT_PIECES else None)
            record_ns = clock() - end_ns
            if asked and console is not None:
                self.operated = True
                console.answer(tick)

            count += 1
            self._count = count
            if request is not None and not asked and request.kind == ARM:
                # what shows only now would show again; anything else may pass, and arming is tried again
                self.refused = 0 if is_engaged(tick.state) else tick.present & BLOCKS_ARM
                self._armed = is_engaged(tick.state) or bool(tick.present & 1 << F.UNREACHABLE)
            behind += skipped
            if service.every and count % service.every == 0:
                # without its sensors an axis lacks much else; that says nothing
                present = tick.present & NO_SENSORS or tick.present & BLOCKS_ARM
                service.report(t_ns, behind, tick.state, tick.latched or present)
                behind = 0
            self.ever_latched |= tick.latched
            self.ever_present |= tick.present
            if not self._shut:
                self.ticks += 1
                self.skipped += skipped
                self.state = tick.state
                self.present = tick.present
                self.lateness.add(lateness_ns)
                if latency_ns >= 0:
                    self.latency.add(latency_ns)
                if axis.state.phase == FOLLOWING:
                    self.tracking.add(tick, axis.state.phase_ns, truth_m)
            if is_engaged(tick.state):
                idle_ticks = 0
            else:
                idle_ticks += 1
                if self._shut and idle_ticks >= END_TICKS:
                    break
                if (
                    o.end_on_fault
                    and not self.operated  # whoever commands is there to clear it
                    and tick.state == FAULT
                    and idle_ticks >= fault_ticks
                ):
                    break

    def _request(self, last: Tick | None, total: int | None) -> Request | None:
        """What the run itself asks of the axis in this tick."""
        if not self._shut and (self._stop or (total is not None and self.ticks + self.skipped >= total)):
            self._shut = True
            self._service.stopping()
            return Request(RequestKind.SHUTDOWN)
        if self._armed or last is None or last.state != DISARMED or last.present & BLOCKS_ARM:
            return None
        if self._is_recorded():
            return Request(RequestKind.ARM, (1.0,))
        return None

    def _is_recorded(self) -> bool:
        """Whether the recorder has begun, or never will: the run itself starts no motion without its log."""
        return not self._recorder or self.recorder_lost or self.ring.status().heartbeat > 0

    def _check(self) -> None:
        """Look at what changes slowly: the recorder."""
        if self._recorder and not self._recorder_gone:
            status = self.ring.status()
            disk_full = status.failing != 0 and status.error == errno.ENOSPC
            self._recorder_gone = gone(self._recorder)
            self.recorder_lost = (status.failing != 0 and not disk_full) or self._recorder_gone
            self._recorder_flags = (
                (RECORDER_LOST if self.recorder_lost else 0)
                | (DISK_FULL if disk_full else 0)
                | (CONFIG_CHANGED if status.config_changed else 0)
            )


def _has_terminal() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


def options_of(
    c: Config,
    *,
    auto_arm: bool,
    duration_s: float | None,
    end_on_fault: bool,
    no_realtime: bool,
) -> Options:
    """Options from a configuration and the command line."""
    return Options(
        c.loop.rate_hz, c.loop.set_deadline, c.loop.spin_us, auto_arm, duration_s, end_on_fault, no_realtime
    )
