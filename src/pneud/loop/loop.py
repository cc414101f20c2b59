"""The running loop: read, cycle, write, record; one tick at a time, by the clock.

One thread. Between frames readable and command sent there is no lock, no blocking call but the waits, and
nothing that formats text.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Protocol

from pneud.bus.codec import Codecs
from pneud.bus.link import Link
from pneud.loading import SYNC_COUNTERS
from pneud.log.format.header import SNAPSHOT_S
from pneud.loop.answers import Answers
from pneud.loop.company import Company
from pneud.loop.following import Following
from pneud.loop.lane import Lane
from pneud.loop.options import Options
from pneud.loop.pacer import Pacer
from pneud.loop.phase import Phase
from pneud.loop.routes import Routes
from pneud.loop.turn import END_TICKS
from pneud.rt.notify import Service, restarting
from pneud.safety.faults import BLOCKS_ARM, FAULT_NAMES, LOG_LOST, NO_SENSORS
from pneud.safety.supervisor import is_engaged
from pneud.signals import Frame, Host, State

CHECKS_S = 0.5  # how often the recorder is looked at
CLOCK_STEP = int(Host.CLOCK_STEP)  # a plain number costs a tenth of a flag
SYNC_LOST = int(Host.SYNC_LOST)
UNREADY = int(Host.HEARTBEAT_LOST)  # nodes that have yet to be configured are not operational


class Nodes(Protocol):
    """What the loop and whoever configures the nodes of its bus tell each other."""

    quiet: bool  # no SYNC is sent, so that they can be configured
    lost: bool  # who configures them has died

    @property
    def ready(self) -> bool:
        """They are configured; until then nothing is armed."""

    def is_ready(self, axis: int) -> bool:
        """Whether those of an axis are, by its place."""

    def look(self) -> None:
        """See whether that has died; it costs a system call."""


class Loop:
    """The loop of one axis or more on one bus; `run` returns when it was told to stop and they are centred.

    In every tick: wake, drain what is left, SYNC, wait for all answers, decide and send, record, account.
    Where another controller sends SYNC, that is what wakes it.
    """

    def __init__(
        self,
        lanes: Sequence[Lane],
        codecs: Codecs,
        link: Link,
        options: Options,
        nodes: Nodes | None = None,
        company: Company | None = None,
    ) -> None:
        """A loop that has not begun.

        Args:
            lanes: one for each axis.
            codecs: of any of them; all have the same SYNC.
            link: to the bus.
            options: of the run.
            nodes: whether they are ready; None where they just are.
            company: what several axes are to each other; None for one alone.
        """
        self.lanes = lanes
        self._company = company
        self._turns = [lane.turn for lane in lanes]
        self._routes = Routes(lanes)
        self._link = link
        self._nodes = nodes
        self._hushed = False  # no SYNC is sent
        self._period_ns = round(1e9 / options.rate_hz)
        self._pacer = Pacer(self._period_ns, round(options.spin_us * 1e3))
        self._wait_ns = round(self._period_ns * options.set_deadline)
        self._answers = Answers(self._wait_ns)
        self._arrived_ns = 0  # when this tick's set came, after SYNC; 0 for none
        self._in_vain = False
        self._answered = all(turn.inbox.sync for turn in self._turns)  # else frames come by themselves
        self._phase = None if self._answered else Phase(self._period_ns)
        self._following: Following | None = None
        if options.follow_s is not None:
            patience_ns = round(options.follow_s * 1e9)
            self._following = Following(link, codecs.sync, self._period_ns, patience_ns)
        self._makes_sync = self._answered and self._following is None
        self._sync_id = codecs.sync.can_id
        self._syncs = [codecs.sync.encode(counter=n) for n in range(1, SYNC_COUNTERS + 1)]
        self._check_ticks = options.ticks(CHECKS_S)
        self._snapshot_ticks = options.ticks(SNAPSHOT_S)
        self._total = None if options.duration_s is None else options.ticks(options.duration_s)
        self._host = int(Host.NO_REALTIME) if options.no_realtime else 0
        self._service = Service(options.rate_hz, [state.label for state in State], FAULT_NAMES)
        self._came: list[Frame] = []  # and not handed on yet
        self._count = 0
        self._passed = 0  # ticks with those that were skipped
        self._behind = 0  # skipped since the service was told
        self._stop = False
        self._ending = False

    def stop(self) -> None:
        """Ask for a controlled stop and the end of the run; safe in a signal handler."""
        self._stop = True

    def run(self) -> None:
        """Tick until told to stop; an exception that gets here is passed on after the valves are centred."""
        try:
            while not self._tick():
                pass
            if not self._ending:
                self._say_end()
        except BaseException:
            for count in range(self._count, self._count + END_TICKS):
                for turn in self._turns:
                    self._link.send(turn.command_id, turn.centre(count))
            raise

    def _say_end(self) -> None:
        """Tell the service's manager why no more is heard of the loop; its crew may take long to end."""
        if any(lane.again for lane in self.lanes):
            restarting()
        else:
            self._service.stopping()

    def _tick(self) -> bool:
        """One tick; whether it was the last one."""
        link, lanes, turns = self._link, self.lanes, self._turns
        count, clock, following = self._count, time.monotonic_ns, self._following
        index = count % SYNC_COUNTERS
        # wake
        if following is None:
            _, late_ns, skipped = self._pacer.next()
        host = self._host if link.watch_clock() == 0 else self._host | CLOCK_STEP
        if self._nodes is not None:
            self._give_way(self._nodes)
        # drain
        if following is None:
            link.drain(self._came)
            t_ns = 0
        else:
            t_ns, late_ns, skipped, sequence, lost = following.next(self._came)
            host = host | SYNC_LOST if lost else host
            index = sequence - 1 if 0 < sequence <= SYNC_COUNTERS else index
        self._routes.open(self._came)
        # SYNC, and wait
        t_ns = t_ns or clock()
        sync_data = self._syncs[index]
        for turn in turns:
            turn.begin(t_ns)
        sync_ns = t_ns
        if self._hushed:
            sync_ns = -1
        elif self._makes_sync:
            sync_ns = link.send(self._sync_id, sync_data)
        elif following is not None:
            self._routes.feed(following.rest)
        sync = Frame(sync_ns, self._sync_id, sync_data)
        set_ns = self._wait(t_ns, sync.stamp_ns, host)
        # decide and send
        if link.down and count % self._check_ticks == 0:
            link.reopen()
        for lane in lanes:
            turn = lane.turn
            turn.decide(skipped, lane.conditions.host(lane.early), lane.request, lane.told)
            lane.decided_ns = clock()
            turn.sent(link.send(turn.command_id, turn.command(index + 1, count)))
            lane.done_ns = clock()
            if turn.speaks:
                turn.speak(link.send)
        # record
        lateness_ns = late_ns + skipped * self._period_ns  # since the first of the grid points missed
        freeze = count % self._snapshot_ticks == self._snapshot_ticks - 1
        report = self._ending or count % self._check_ticks == 0
        called_ns = set_ns
        for lane in lanes:
            lane.record(sync, lateness_ns, set_ns, called_ns, freeze=freeze, report=report)
            called_ns = lane.done_ns
        # account
        if self._phase is not None and (frames := turns[0].frames):
            self._pacer.put_off(self._phase.shift_ns(frames[-1].stamp_ns - t_ns))
        return self._account(t_ns, skipped)

    def _give_way(self, nodes: Nodes) -> None:
        """Send no SYNC while nodes have yet to be configured, as far as no axis needs it."""
        ready = nodes.ready
        engaged = self._count and any(is_engaged(turn.tick.state) for turn in self._turns)
        self._hushed = not ready and not engaged and not nodes.lost
        if nodes.quiet != self._hushed:
            nodes.quiet = self._hushed

    def _lacking(self, nodes: Nodes, axis: int) -> int:
        """What the host lacks of an axis whose nodes are not configured yet, or whose bus is given away."""
        return UNREADY if self._hushed or not nodes.is_ready(axis) else 0

    def _wait(self, t_ns: int, sync_ns: int, host: int) -> int:
        """Wait until every axis has its set, or for as long as there is time.

        Returns:
            When the waiting ended.
        """
        link, came, clock, answers = self._link, self._came, time.monotonic_ns, self._answers
        limit_ns = t_ns + self._wait_ns
        self._meanwhile(host)
        doze_ns = answers.doze_ns(clock() - t_ns)
        if doze_ns > 0:
            time.sleep(doze_ns * 1e-9)
            for turn in self._turns:
                turn.rehearse()
        look_until_ns = clock() + answers.look_ns()
        for lane in self.lanes:
            lane.see_truth(sync_ns)
        newest_ns = 0
        complete = self._complete()
        while not complete:
            now_ns = clock()
            if now_ns >= limit_ns:
                break
            looks = now_ns < look_until_ns
            if link.drain(came, 0 if looks else limit_ns - now_ns):
                if self._following is not None and self._following.keep(came):
                    limit_ns = now_ns  # the next SYNC is there: nothing more answers this one
                newest_ns = came[-1].stamp_ns if came else newest_ns
                self._routes.feed(came)
                complete = self._complete()
            elif link.down and not looks:
                # a dead interface is always readable: sleep, or this would spin at high priority
                time.sleep(max(0.0, (limit_ns - clock()) * 1e-9))
        set_ns = clock()
        self._arrived_ns = newest_ns - t_ns if complete and newest_ns else 0
        self._in_vain = look_until_ns < newest_ns
        return set_ns

    def _meanwhile(self, host: int) -> None:
        """What there is time for while the nodes answer."""
        if self._count % self._check_ticks == self._check_ticks - 1:
            for lane in self.lanes:
                lane.recorder.look()
            if self._nodes is not None:
                self._nodes.look()
        if not self._ending and (self._stop or (self._total is not None and self._passed >= self._total)):
            self._ending = True
            self._service.stopping()
        company = self._company
        may_arm = company is None or company.look()
        nodes = self._nodes
        for place, lane in enumerate(self.lanes):
            lacking = 0 if nodes is None else self._lacking(nodes, place)
            lane.prepare(host | lacking, self._ending, may_arm)

    def _complete(self) -> bool:
        for turn in self._turns:  # noqa: SIM110 - a generator would take longer than all of it
            if not turn.inbox.complete:
                return False
        return True

    def _account(self, t_ns: int, skipped: int) -> bool:
        """Count the tick; whether it was the last one."""
        if self._arrived_ns and self._answered:
            self._answers.came(self._arrived_ns, self._in_vain)
        else:
            self._answers.missing()
        self._count += 1
        self._passed += 1 + skipped
        self._behind += skipped
        service = self._service
        if service.every and self._count % service.every == 0:
            tick = self._turns[0].tick
            # without its sensors an axis lacks much else; that says nothing
            present = tick.present & NO_SENSORS or tick.present & BLOCKS_ARM
            faults = (tick.latched or present) | tick.present & LOG_LOST
            service.report(t_ns, self._behind, tick.state, faults)
            self._behind = 0
        if self._company is not None:
            self._company.after()
        over = True
        for lane in self.lanes:
            over = lane.over() and over
        return over
