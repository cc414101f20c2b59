"""The link: what the control loop and the plant hold of a bus, whatever carries it.

Nothing here blocks but `wait`, and `drain` where it is asked to. Kernel stamps are CLOCK_REALTIME; they leave
as CLOCK_MONOTONIC, with an offset measured when the link is opened and on request.
"""

from __future__ import annotations

import errno
import os
import select
import time
from collections.abc import Callable, Iterable
from typing import Protocol

from pneud.bus import interfaces, wire
from pneud.bus.socketcan import NotVirtualError, SocketCan, SocketCanError
from pneud.bus.transport import Party, UnixCanError, channels
from pneud.signals import Frame

USAGE, MACHINE = 2, 3  # exit codes
_DOWN = frozenset((errno.ENETDOWN, errno.ENODEV, errno.ENXIO))
_AUTO_INTERFACE = "vcan0"
_IDLE_S = 0.05
_CLOCK_NOISE_NS = 50_000


class LinkError(Exception):
    """A bus cannot be used; the text is one line for a person."""

    def __init__(self, text: str, exit_code: int = MACHINE) -> None:
        super().__init__(text)
        self.exit_code = exit_code


class Carrier(Protocol):
    """What a link needs of the thing that carries frames."""

    def fileno(self) -> int: ...  # noqa: D102
    def drain(self, offset_ns: int, into: list[Frame], wait_ns: int = 0) -> int: ...  # noqa: D102
    def send(self, can_id: int, data: bytes) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102
    @property
    def dropped(self) -> int: ...  # noqa: D102


class Link:
    """An open bus, for one thread.

    Attributes:
        name: such as unixcan:x, as it can be given to `--bus`.
        note: one line on why this bus was chosen; empty where it was asked for by name.
        realtime_offset_ns: CLOCK_REALTIME minus CLOCK_MONOTONIC, as `watch_clock` last found it.
        tx: frames sent.
        tx_failed: frames that could not be sent; they are never sent again.
        down: the interface was down or gone when last used, and no frame has been sent since.
    """

    def __init__(self, name: str, carrier: Carrier, note: str = "", fd: wire.Fd | None = None) -> None:
        self.name = name
        self.note = note
        self.realtime_offset_ns = wire.realtime_offset_ns()
        self.tx = 0
        self.tx_failed = 0
        self.down = False
        self._carrier = carrier
        self._descriptors = [carrier.fileno()]
        self._drain = carrier.drain
        self._transmit = carrier.send if fd is None else _marking(carrier.send, fd)
        self._socketcan = carrier if isinstance(carrier, SocketCan) else None

    def __enter__(self) -> Link:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def rx_dropped(self) -> int:
        """Frames lost because this link was not drained in time, where the kernel counts them (SocketCAN)."""
        return self._socketcan.dropped if self._socketcan is not None else 0

    @property
    def peers_dropped(self) -> int:
        """Frames that other parties lost because they did not read (unixcan)."""
        return self._carrier.dropped if isinstance(self._carrier, Party) else 0

    def fileno(self) -> int:
        """One descriptor that is readable when there is something to drain."""
        return self._descriptors[0]

    def drain(self, into: list[Frame], wait_ns: int = 0) -> int:
        """Append everything that has arrived, in order of its CLOCK_MONOTONIC stamps.

        Args:
            into: where to.
            wait_ns: how long to wait for something to happen; 0 never waits. What happens may be no frame:
                parties that come and go end it, too.

        Returns:
            How many frames came.
        """
        before = len(into)
        try:
            return self._drain(self.realtime_offset_ns, into, wait_ns)
        except OSError as e:
            if e.errno in _DOWN:
                self.down = True
            return len(into) - before

    def send(self, can_id: int, data: bytes) -> int:
        """Send one frame now or never.

        Returns:
            CLOCK_MONOTONIC [ns] right after it was handed to the kernel, or −1 when it could not be.
        """
        try:
            self._transmit(can_id, data)
        except OSError as e:
            self.tx_failed += 1
            if e.errno in _DOWN:
                self.down = True
            return -1
        sent = time.monotonic_ns()
        self.tx += 1
        self.down = False
        return sent

    def wait(self, timeout_s: float) -> bool:
        """Wait until there is something to drain, with microseconds of resolution (epoll has milliseconds).

        True does not promise a frame: parties that come and go wake it, too.
        """
        return bool(select.select(self._descriptors, (), (), timeout_s)[0])

    def watch_clock(self) -> int:
        """Follow a step of the wall clock, which stamps what arrives; to be called before every drain.

        Returns:
            The step [ns], 0 for none.
        """
        before = time.monotonic_ns()
        now = time.time_ns()
        after = time.monotonic_ns()
        step = now - (before + after) // 2 - self.realtime_offset_ns
        # interrupted between the readings, they say nothing; what is smaller is their own noise
        if after - before > _CLOCK_NOISE_NS or -_CLOCK_NOISE_NS < step < _CLOCK_NOISE_NS:
            return 0
        self.realtime_offset_ns += step
        return step

    def reopen(self) -> bool:
        """Find the interface of a link that is down again: one made anew has nothing but its name in common.

        An interface that only went down and up needs none of this. It asks the kernel, so not in every tick.

        Returns:
            Whether the link leads to an interface.
        """
        return self._socketcan is None or self._socketcan.bind()

    def close(self) -> None:
        """Leave the bus; in a forked copy of the process only the copy's descriptors."""
        self._carrier.close()


def _marking(send: Callable[[int, bytes], None], fd: wire.Fd) -> Callable[[int, bytes], None]:
    """What sends frames of CAN FD where the identifier or the length asks for one."""
    ids, flags = fd.ids, wire.FD_FLAG | (wire.SWITCH_FLAG if fd.switches else 0)

    def transmit(can_id: int, data: bytes) -> None:
        send(can_id | flags if can_id in ids or len(data) > 8 else can_id, data)

    return transmit


def open_link(
    channel: str,
    *,
    virtual: bool = False,
    listens: bool = False,
    by: wire.Carriage = wire.CARRIAGE,
    fd: wire.Fd | None = None,
) -> Link:
    """Open a bus.

    Args:
        channel: "socketcan:IF", "unixcan:NAME", or "auto": vcan0 if it is up and idle, else a new unixcan.
        virtual: refuse what might lead to real devices.
        listens: it will send nothing.
        by: how frames are taken and given.
        fd: what is sent as frames of CAN FD; without, there are none on it.

    Raises:
        LinkError: with `exit_code` 3 where the machine lacks something, 2 for a channel that may not be used.
    """
    if channel == "auto":
        return _open_auto(by, fd)
    kind, _, name = channel.partition(":")
    marks = wire.CLASSIC if fd is None else 0
    try:
        if kind == "socketcan" and name:
            return Link(channel, SocketCan(name, virtual=virtual, by=by, fd=marks), fd=fd)
        if kind == "unixcan" and name:
            return Link(channel, Party(name, answers=not listens, by=by, fd=marks), fd=fd)
    except NotVirtualError as e:
        raise LinkError(str(e), USAGE) from None
    except (SocketCanError, UnixCanError) as e:
        raise LinkError(str(e), MACHINE) from None
    raise LinkError(f"bus {channel!r} is none of auto, socketcan:IF, unixcan:NAME", USAGE)


def refuse_if_driven(
    link: Link, ids: Iterable[int], listen_s: float = 0.1, what: str = "another controller drives it"
) -> None:
    """Make sure that nobody else plays a part on this bus; drops what arrives meanwhile.

    Args:
        link: the bus.
        ids: identifiers that only that part sends.
        listen_s: for how long to listen.
        what: what it means to hear one.

    Raises:
        LinkError: with `exit_code` 2 as soon as one of them comes.
    """
    wanted = frozenset(ids)
    deadline = time.monotonic() + listen_s
    while (left := deadline - time.monotonic()) > 0.0:
        if not link.wait(left):
            return
        frames: list[Frame] = []
        link.drain(frames)
        for frame in frames:
            if frame.can_id in wanted:
                raise LinkError(
                    f"{link.name}: 0x{frame.can_id:03X} is on this bus already, so {what};"
                    " stop that one or use another bus",
                    USAGE,
                )


def _open_auto(by: wire.Carriage, fd: wire.Fd | None) -> Link:
    reason = _why_not(_AUTO_INTERFACE)
    if not reason:
        try:
            link = open_link(f"socketcan:{_AUTO_INTERFACE}", virtual=True, by=by, fd=fd)
        except LinkError as e:
            reason = str(e).partition(": ")[2].partition(";")[0]
        else:
            if not (link.wait(_IDLE_S) and link.drain([])):
                link.note = f"bus {link.name} (it is there and idle)"
                return link
            link.close()
            reason = f"{_AUTO_INTERFACE} carries traffic"
    channels()  # which removes what dead ones have left
    link = open_link(f"unixcan:auto-{os.getpid()}-{os.urandom(2).hex()}", by=by, fd=fd)
    link.note = f"bus {link.name} ({reason})"
    return link


def _why_not(name: str) -> str:
    """Why an interface is no candidate for a virtual bus; empty if it is one."""
    try:
        found = interfaces.query(name)
    except OSError as e:
        return f"cannot ask for {name}: {e.strerror or e}"
    if found is None:
        return f"there is no {name}"
    if found.kind != "vcan":
        return f"{name} is no vcan"
    return "" if found.up else f"{name} is down"
